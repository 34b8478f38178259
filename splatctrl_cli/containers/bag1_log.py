"""The messages of a ROS 1 bag, with or without its index; what is damaged is left out and counted."""

from collections.abc import Collection, Iterator
from pathlib import Path

from splatctrl_cli.containers.bag_file import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    CONNECTION,
    MESSAGE,
    BagFile,
    BagRecord,
    Fields,
    fields_of,
    number,
    records_in,
)
from splatctrl_cli.containers.foxglove import standing_in
from splatctrl_cli.containers.mcap_log import ros_type_name
from splatctrl_cli.containers.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.unpacking import BadBlockError, Budget, unpacked_start
from splatctrl_cli.records import SECOND_NS


class Bag1Log:
    """One ROS 1 bag.

    rosbags' reader (rosbags/rosbag1/reader.py) goes by the index: it refuses a bag without one, and ends at the
    first damaged chunk. Raises InputError where there is no record at all.
    """

    container = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = (path,)
        self._file = BagFile(path)
        self._topics: dict[int, Topic] = {}
        if next(self._file.records(Damage()), None) is None:
            raise InputError(f"{path}: not a readable ROS 1 bag: no whole record", remedy="record or copy it again")
        for record in self._file.connections():
            self._connect(record.fields, record.body, Damage())

    def topics(self) -> tuple[Topic, ...]:
        """The connections of the index, and those met while reading."""
        return tuple(self._topics.values())

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages in file order; a chunk that does not unpack is left out, a cut one read to its cut."""
        budget, num_indexed, num_chunks = Budget(self._file.size), 0, None
        for record in self._file.records(damage):
            if record.kind == BAG_HEADER:
                num_chunks = number(record.fields, "chunk_count")
                if number(record.fields, "index_pos") <= 0:
                    damage.add(f"{self.path.name}: has no index: cut, or still being written")
                    num_chunks = 0
            elif record.kind == CHUNK_INFO:
                num_indexed += 1
            elif record.kind == CHUNK:
                yield from self._chunk(record, budget, damage, names)
            elif not record.is_cut:
                yield from self._read(record.kind, record.fields, record.body, record.offset, damage, names)
        if num_chunks is None or num_indexed < num_chunks:
            damage.add(f"{self.path.name}: its index is not whole")

    def _chunk(
        self, record: BagRecord, budget: Budget, damage: Damage, names: Collection[str] | None
    ) -> Iterator[RawMessage]:
        compression = record.fields.get("compression", b"").decode("latin-1")
        size = number(record.fields, "size")
        try:
            if record.is_cut:
                content = unpacked_start(record.body, compression, size)
            else:
                content = budget.unpacked(record.body, compression, size)
            for kind, fields, body in records_in(content):
                yield from self._read(kind, fields, body, record.offset, damage, names)
        except (BadBlockError, ValueError) as error:
            if not record.is_cut:  # the cut has been counted
                damage.add(f"{self.path.name}: the chunk at byte {record.offset} was left out: {error}")

    def _read(
        self, kind: int, fields: Fields, body: bytes, offset: int, damage: Damage, names: Collection[str] | None
    ) -> Iterator[RawMessage]:
        if kind == CONNECTION:
            self._connect(fields, body, damage)
        elif kind == MESSAGE:
            topic, time = self._topics.get(number(fields, "conn")), fields.get("time", b"")
            if topic is None or len(time) != 8:
                damage.add(f"{self.path.name}: a message without a connection or time")
            elif names is None or topic.name in names:
                seconds, nanoseconds = int.from_bytes(time[:4], "little"), int.from_bytes(time[4:], "little")
                at = seconds * SECOND_NS + nanoseconds
                yield RawMessage(topic=topic, log_time_ns=at, data=body, file=self.path.name, offset=offset)

    def _connect(self, fields: Fields, body: bytes, damage: Damage) -> None:
        told = fields_of(body)
        if told is None or "topic" not in fields or "type" not in told:
            damage.add(f"{self.path.name}: a connection without topic or type")
            return
        topic = Topic(
            name=fields["topic"].decode("utf-8", "replace"),
            type_name=ros_type_name(told["type"].decode("utf-8", "replace")),
            encoding="ros1",
            definition=told.get("message_definition", b"").decode("utf-8", "replace"),
        )
        self._topics[number(fields, "conn")] = standing_in(topic)
