"""Recorded messages as bytes, in file order; damage is counted, not raised."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

MAX_NOTES = 100  # a long log can be damaged in a million places


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A channel of a log.

    type_name: ``package/msg/Type`` for ROS. encoding: ``cdr``, ``ros1`` or the file's (json, protobuf, ...).
    definition: the type's text or "". definition_format: ``msg``, ``idl`` or ``protobuf`` (a FileDescriptorSet, one
    byte per character). schema: the original type if type_name stands for it in ROS, else "".
    """

    name: str
    type_name: str
    encoding: str
    definition: str = ""
    definition_format: str = "msg"
    schema: str = ""


@dataclass(frozen=True, kw_only=True)
class RawMessage:
    """A message: topic, log time [ns] and bytes, the same for every container.

    file, offset: file name, and byte where the message's record or chunk begins; -1 if unknown.
    """

    topic: Topic
    log_time_ns: int
    data: bytes
    file: str = ""
    offset: int = -1


class Part(NamedTuple):
    """A record of a file, some without content. fields: a ROS 1 bag's."""

    offset: int
    opcode: int
    content: bytes
    is_cut: bool = False
    fields: Mapping[str, bytes] = MappingProxyType({})


@dataclass(kw_only=True)
class Damage:
    """Losses of a pass over a log.

    remarks: counts of deviations without loss, such as unsupported forms. num_invalid: depth pixels that measure
    nothing.
    """

    count: int = 0
    num_invalid: int = 0
    notes: list[str] = field(default_factory=list)
    remarks: Counter[str] = field(default_factory=Counter)
    _num_unsaid: int = 0

    def add(self, note: str, num: int = 1) -> None:
        """Count and note damage; after MAX_NOTES a last note counts the rest."""
        self.count += num
        if len(self.notes) < MAX_NOTES:
            self.notes.append(note)
        else:
            self._num_unsaid += num
            self.notes[MAX_NOTES:] = [f"and {self._num_unsaid} more"]

    def remark(self, text: str) -> None:
        """Count a deviation without loss; after MAX_NOTES, new remarks share one."""
        is_room = text in self.remarks or len(self.remarks) < MAX_NOTES
        self.remarks[text if is_room else "more of this kind"] += 1

    @property
    def all_notes(self) -> list[str]:
        return [*self.notes, *(text if num == 1 else f"{text} ({num} times)" for text, num in self.remarks.items())]


class RawLog:
    """A log that can be read repeatedly.

    container: the kind of file, such as ``MCAP`` or ``ROS 1 bag``. channels: declared topics by number.
    """

    path: Path
    files: tuple[Path, ...]
    container: str
    channels: Mapping[Any, Topic]

    def topics(self) -> tuple[Topic, ...]:
        """Topics in the index, even without messages; none without an index."""
        return tuple(self.channels.values())

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages of `names` (None: all) in file order; losses go to `damage`."""
        raise NotImplementedError


class JoinedLog(RawLog):
    """Logs read one after another; `note`, a fault of all, counts as damage.

    change: edits the messages.
    """

    def __init__(
        self,
        path: Path,
        parts: Sequence[RawLog],
        container: str,
        *,
        files: tuple[Path, ...] = (),
        note: str = "",
        change: Callable[[Iterator[RawMessage], Damage], Iterator[RawMessage]] | None = None,
    ) -> None:
        self.path, self.container = path, container
        self.files = files or tuple(file for part in parts for file in part.files)
        self._parts, self._note, self._change = parts, note, change

    def topics(self) -> tuple[Topic, ...]:
        return tuple(dict.fromkeys(topic for part in self._parts for topic in part.topics()))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        if self._note:
            damage.add(self._note)
        messages = chain.from_iterable(part.messages(damage, names) for part in self._parts)
        yield from messages if self._change is None else self._change(messages, damage)
