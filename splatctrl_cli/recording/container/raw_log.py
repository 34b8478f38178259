"""Recorded messages as bytes, in the order of the file, whatever the container; damage is counted, not raised."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

MAX_NOTES = 100  # a long log can be damaged in a million places


@dataclass(frozen=True, kw_only=True)
class Topic:
    """One channel of a log.

    type_name is ``package/msg/Type`` for ROS messages; encoding is ``cdr``, ``ros1`` or what the file says (json,
    protobuf, ...); definition is the type's text as the file holds it ("" = none), in definition_format
    ``msg``, ``idl`` or ``protobuf`` (a FileDescriptorSet, a byte a character). schema is the type's own name where
    type_name is that of the ROS message that it stands for (Foxglove's schemas), else "".
    """

    name: str
    type_name: str
    encoding: str
    definition: str = ""
    definition_format: str = "msg"
    schema: str = ""


@dataclass(frozen=True, kw_only=True)
class RawMessage:
    """One message: its topic, the time it was logged [ns] and its bytes, the same for every container.

    file and offset say where it was read: the byte at which its record, or that of its chunk, begins; -1 where the
    container has no such place.
    """

    topic: Topic
    log_time_ns: int
    data: bytes
    file: str = ""
    offset: int = -1


@dataclass(kw_only=True)
class Damage:
    """What one pass over a log could not read; remarks: how often something was met that is no damage, as messages of
    a form that is not read.
    """

    count: int = 0
    notes: list[str] = field(default_factory=list)
    remarks: Counter[str] = field(default_factory=Counter)
    _num_unsaid: int = 0

    def add(self, note: str, num: int = 1) -> None:
        """Count damaged parts and say which; behind MAX_NOTES notes, a last one says how many more."""
        self.count += num
        if len(self.notes) < MAX_NOTES:
            self.notes.append(note)
        else:
            self._num_unsaid += num
            self.notes[MAX_NOTES:] = [f"and {self._num_unsaid} more"]

    def remark(self, text: str) -> None:
        """Count what is no damage; behind MAX_NOTES remarks, new ones share one."""
        is_room = text in self.remarks or len(self.remarks) < MAX_NOTES
        self.remarks[text if is_room else "more of this kind"] += 1

    @property
    def all_notes(self) -> list[str]:
        """Damage, then each remark with how often it was met."""
        return [*self.notes, *(text if num == 1 else f"{text} ({num} times)" for text, num in self.remarks.items())]


class RawLog(Protocol):
    """A log that can be read from its start any number of times."""

    @property
    def path(self) -> Path: ...

    @property
    def files(self) -> tuple[Path, ...]:
        """The files the log consists of."""
        ...

    @property
    def container(self) -> str:
        """What the file is, in words (``MCAP``, ``ROS 1 bag``, ``ROS 2 bag (sqlite3)``)."""
        ...

    def topics(self) -> tuple[Topic, ...]:
        """The topics that the log's index names, also those without messages; empty where there is no index."""
        ...

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of topics `names` (all, if None) in file order; what is damaged goes to `damage`."""
        ...


class JoinedLog:
    """Logs as one, read one after the other; a note says what is wrong with them together, and counts as damage."""

    def __init__(
        self, path: Path, parts: Sequence[RawLog], container: str, *, files: tuple[Path, ...] = (), note: str = ""
    ) -> None:
        """files: those that the log consists of, by default those of its parts."""
        self.path, self.container = path, container
        self.files = files or tuple(file for part in parts for file in part.files)
        self._parts, self._note = parts, note

    def topics(self) -> tuple[Topic, ...]:
        """The topics of all parts, each once."""
        return tuple(dict.fromkeys(topic for part in self._parts for topic in part.topics()))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of each part in turn."""
        if self._note:
            damage.add(self._note)
        for part in self._parts:
            yield from part.messages(damage, names)
