"""Several logs of one session as one: their messages by the time of logging."""

import heapq
from collections.abc import Collection, Iterator
from pathlib import Path

from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage, Topic


class SessionLog:
    """Logs that were recorded at the same time, as cameras in one and joints in another."""

    def __init__(self, parts: tuple[RawLog, ...]) -> None:
        names = "+".join(part.path.name for part in parts)
        self.path: Path = parts[0].path.with_name(names)
        self.files = tuple(file for part in parts for file in part.files)
        self.container = " + ".join(dict.fromkeys(part.container for part in parts))
        self._parts = parts

    def topics(self) -> tuple[Topic, ...]:
        """The topics of all parts, each once."""
        return tuple(dict.fromkeys(topic for part in self._parts for topic in part.topics()))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of all parts by time of logging.

        Where two parts share a topic, leaving others out would change the order in which its messages meet; it must
        be the same in every pass, so all are read then.
        """
        pushed = None if names is None or self._share(names) else names
        parts = (part.messages(damage, pushed) for part in self._parts)
        for message in heapq.merge(*parts, key=lambda message: message.log_time_ns):
            if names is None or message.topic.name in names:
                yield message

    def _share(self, names: Collection[str]) -> bool:
        seen: set[str] = set()
        for part in self._parts:
            here = {topic.name for topic in part.topics()}
            if not here or seen & here & set(names):  # a log without index may hold anything
                return True
            seen |= here
        return False
