"""The messages of a ROS 2 sqlite3 bag, of any distribution's schema; pages that are damaged are passed over.

rosbags' reader (rosbags/rosbag2/storage_sqlite3.py) counts all messages when it opens a file, and so refuses one with
a single bad page. Tables as rosbag2_storage_sqlite3 creates them: topics, messages, since Iron message_definitions.
"""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from splatctrl_cli.containers.foxglove import standing_in
from splatctrl_cli.containers.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.unpacking import MAX_BLOCK

_WIDEST_HOLE = 1 << 40


class Db3Log:
    """One .db3 file. Raises InputError where its tables are not those of a bag, or cannot be read at all."""

    container = "ROS 2 bag (sqlite3)"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = (path,)
        try:
            with closing(self._opened()) as database:
                self._topics = _topics(database)
        except (sqlite3.Error, ValueError) as error:
            raise InputError(
                f"{path}: not a readable {self.container}: {error}", remedy="try 'ros2 bag reindex', or copy it again"
            ) from None

    def topics(self) -> tuple[Topic, ...]:
        """The topics table."""
        return tuple(self._topics.values())

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages in the order they were written; rows on damaged pages are passed over and counted."""
        journal = self.path.with_name(self.path.name + "-wal")
        if journal.is_file() and journal.stat().st_size > 0:
            damage.add(f"{journal.name}: holds messages that are not in the bag yet; it was not closed")
        with closing(self._opened()) as database:
            for topic_id, log_time_ns, data in self._rows(database, damage):
                topic = self._topics.get(topic_id)
                if topic is None or not isinstance(data, bytes) or not isinstance(log_time_ns, int):
                    damage.add(f"{self.path.name}: a message without topic, time or data")
                elif names is None or topic.name in names:
                    yield RawMessage(topic=topic, log_time_ns=log_time_ns, data=data, file=self.path.name)

    def _rows(self, database: sqlite3.Connection, damage: Damage) -> Iterator[tuple[object, object, object]]:
        last, hole = -(1 << 62), 1  # hole: how many rows to pass over next
        for _ in range(1000):
            try:
                query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
                for number, *row in database.execute(query, (last,)):
                    hole = min(hole, 1)
                    last = number
                    yield row[0], row[1], row[2]
            except (sqlite3.Error, OverflowError) as error:
                if hole == 1:
                    damage.add(f"{self.path.name}: damaged behind message {max(last, 0)}: {error}")
                last, hole = max(last, 0) + hole, hole * 2
                if hole > _WIDEST_HOLE:
                    return
                continue
            return

    def _opened(self) -> sqlite3.Connection:
        database = sqlite3.connect(f"file:{quote(str(self.path.absolute()))}?mode=ro&immutable=1", uri=True)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BLOCK)
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("PRAGMA writable_schema = ON")  # else sqlite refuses a file that is shorter than it says
        database.text_factory = lambda content: content.decode("utf-8", "replace")
        return database


def _topics(database: sqlite3.Connection) -> dict[object, Topic]:
    """The topics by their number. Raises ValueError where a table is missing."""
    found = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not {"topics", "messages"} <= found:
        raise ValueError("no tables named topics and messages")
    definitions = {}
    if "message_definitions" in found:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {kind: (encoding, text) for kind, encoding, text in database.execute(query)}
    topics: dict[object, Topic] = {}
    for number, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
        definition_format, text = definitions.get(kind, ("", ""))
        topic = Topic(
            name=str(name),
            type_name=str(kind),
            encoding=str(encoding),
            definition=str(text) if definition_format in {"ros2msg", "ros2idl"} else "",
            definition_format="idl" if definition_format == "ros2idl" else "msg",
        )
        topics[number] = standing_in(topic)
    return topics
