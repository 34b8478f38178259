"""The messages of ROS 1 and ROS 2 (sqlite3) bags; damage is skipped and counted.

A ROS 1 bag (format 2.0, wiki.ros.org/Bags/Format/2.0) is records of named fields and a body. Tables of
rosbag2_storage_sqlite3 are topics, messages and, since Iron, message_definitions. rosbags refuses a damaged file.
"""

import os
import shutil
import sqlite3
import struct
import tempfile
import weakref
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.files.spilled_rows import scratch_folder
from splatctrl_cli.formats.unpacking import MAX_BLOCK, PIECE, BadBlockError, Budget, unpacked_start
from splatctrl_cli.recording.container.foxglove import add_ros_type
from splatctrl_cli.recording.container.mcap_log import ros_type_name
from splatctrl_cli.recording.container.raw_log import Damage, Part, RawLog, RawMessage, Topic
from splatctrl_cli.records import SECOND_NS

MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
_KINDS = frozenset({MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION})
_U32 = struct.Struct("<I")
_MARK = b"compression="  # of a chunk's header, behind its length and perhaps the fields `op` and `size`
_MARK_OFFSETS = (8, 16, 21, 29)

Fields = Mapping[str, bytes]


class Bag1Log(RawLog):
    """One ROS 1 bag, also without its index, which a truncated or growing bag lacks.

    Raises InputError if no record is whole.
    """

    container = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = (path,)
        self._size = path.stat().st_size
        self.channels: dict[int, Topic] = {}
        refuse_if(
            next(self.records(Damage()), None) is None,
            f"{path}: not a readable ROS 1 bag: no whole record",
            remedy="record or copy it again",
        )
        for record in self._connections():
            self._connect(record.fields, record.content, Damage())

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield in file order; skip bad chunks, read a cut chunk up to its cut."""
        budget, num_indexed, num_chunks = Budget(self._size), 0, None
        for record in self.records(damage):
            if record.opcode == BAG_HEADER:
                num_chunks = number(record.fields, "chunk_count")
                if number(record.fields, "index_pos") <= 0:
                    damage.add(f"{self.path.name}: has no index: cut, or still being written")
                    num_chunks = 0
            elif record.opcode == CHUNK_INFO:
                num_indexed += 1
            elif record.opcode == CHUNK:
                yield from self._chunk(record, budget, damage, names)
            elif not record.is_cut:
                yield from self._read(record, damage, names)
        if num_chunks is None or num_indexed < num_chunks:
            damage.add(f"{self.path.name}: its index is not whole")

    def _chunk(
        self, record: Part, budget: Budget, damage: Damage, names: Collection[str] | None
    ) -> Iterator[RawMessage]:
        compression = record.fields.get("compression", b"").decode("latin-1")
        size = number(record.fields, "size")
        try:
            unpack = unpacked_start if record.is_cut else budget.unpacked
            for each in records_in(unpack(record.content, compression, size), record.offset):
                yield from self._read(each, damage, names)
        except (BadBlockError, ValueError) as error:
            if not record.is_cut:  # the cut has been counted
                damage.add(f"{self.path.name}: the chunk at byte {record.offset} was left out: {error}")

    def _read(self, record: Part, damage: Damage, names: Collection[str] | None) -> Iterator[RawMessage]:
        if record.opcode == CONNECTION:
            self._connect(record.fields, record.content, damage)
        elif record.opcode == MESSAGE:
            topic, time = self.channels.get(number(record.fields, "conn")), record.fields.get("time", b"")
            if topic is None or len(time) != 8:
                damage.add(f"{self.path.name}: a message without a connection or time")
            elif names is None or topic.name in names:
                seconds, nanoseconds = int.from_bytes(time[:4], "little"), int.from_bytes(time[4:], "little")
                yield RawMessage(
                    topic=topic,
                    log_time_ns=seconds * SECOND_NS + nanoseconds,
                    data=record.content,
                    file=self.path.name,
                    offset=record.offset,
                )

    def _connect(self, fields: Fields, body: bytes, damage: Damage) -> None:
        connection = fields_of(body)
        if connection is None or "topic" not in fields or "type" not in connection:
            damage.add(f"{self.path.name}: a connection without topic or type")
            return
        topic = Topic(
            name=fields["topic"].decode("utf-8", "replace"),
            type_name=ros_type_name(connection["type"].decode("utf-8", "replace")),
            encoding="ros1",
            definition=connection.get("message_definition", b"").decode("utf-8", "replace"),
        )
        self.channels[number(fields, "conn")] = add_ros_type(topic)

    def records(self, damage: Damage) -> Iterator[Part]:
        """Yield records in order. Only chunks, connections and messages have content; losses go to `damage`."""
        with self.path.open("rb") as stream:
            if not stream.readline(64).startswith(b"#ROSBAG V2.0"):
                damage.add(f"{self.path.name}: is not a bag of format 2.0")
                return
            while stream.tell() < self._size:
                offset = stream.tell()
                record = self._record(stream, offset)
                if record is not None and not record.is_cut:
                    yield record
                    continue
                place = self._next_chunk(stream, offset)
                if place is None:
                    damage.add(f"{self.path.name}: cut or damaged after byte {offset}")
                    if record is not None:
                        yield record
                    return
                damage.add(f"{self.path.name}: bytes {offset} to {place} are damaged and were left out")
                stream.seek(place)

    def _connections(self) -> Iterator[Part]:
        with self.path.open("rb") as stream:
            stream.readline(64)
            first = self._record(stream, stream.tell())
            place = number(first.fields, "index_pos") if first is not None and first.opcode == BAG_HEADER else 0
            stream.seek(place if 0 < place < self._size else self._size)
            while (record := self._record(stream, stream.tell())) is not None and record.opcode == CONNECTION:
                yield record

    def _record(self, stream: BinaryIO, offset: int) -> Part | None:
        head = self._head(stream)
        if head is None:
            return None
        kind, fields, length = head
        end = stream.tell() + length
        is_cut = end > self._size
        body = stream.read(min(length, MAX_BLOCK)) if is_cut or kind in {MESSAGE, CHUNK, CONNECTION} else b""
        stream.seek(min(end, self._size))
        return Part(offset, kind, body, is_cut, fields)

    def _head(self, stream: BinaryIO) -> tuple[int, Fields, int] | None:
        length = self._length(stream)
        if length is None or length > min(1 << 20, self._size - stream.tell()):  # those of connections hold a name
            return None
        fields = fields_of(stream.read(length))
        kind = fields["op"][0] if fields is not None and len(fields.get("op", b"")) == 1 else 0
        length = self._length(stream)
        return None if fields is None or kind not in _KINDS or length is None else (kind, fields, length)

    def _next_chunk(self, stream: BinaryIO, offset: int) -> int | None:
        stream.seek(offset + 1)
        tail = b""
        while block := stream.read(PIECE):
            position = stream.tell()
            base, block = position - len(block) - len(tail), tail + block
            at = block.find(_MARK)
            while at >= 0:
                for back in _MARK_OFFSETS:
                    place = base + at - back
                    if place > offset and self._is_chunk(stream, place):
                        return place
                at = block.find(_MARK, at + 1)
            stream.seek(position)
            tail = block[-(len(_MARK) - 1) :]
        return None

    def _is_chunk(self, stream: BinaryIO, place: int) -> bool:
        stream.seek(place)
        head = self._head(stream)
        return head is not None and head[0] == CHUNK and stream.tell() + head[2] <= self._size

    @staticmethod
    def _length(stream: BinaryIO) -> int | None:
        content = stream.read(4)
        return int(_U32.unpack(content)[0]) if len(content) == 4 else None


def fields_of(header: bytes) -> dict[str, bytes] | None:
    """A header's named fields; None if invalid."""
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(header):
        length = int.from_bytes(header[at : at + 4], "little")
        at += 4 + length
        name, equals, value = header[at - length : at].partition(b"=")
        if at > len(header) or not equals:
            return None
        fields[name.decode("latin-1")] = value
    return fields


def number(fields: Fields, name: str) -> int:
    """A field of 4 or 8 bytes as a number; -1 if missing."""
    value = fields.get(name, b"")
    return int.from_bytes(value, "little") if len(value) in {4, 8} else -1


def records_in(content: bytes, offset: int) -> Iterator[Part]:
    """Yield the records of an unpacked chunk at byte `offset` of the file.

    Raises ValueError at bytes that are not a record.
    """
    at = 0
    while at < len(content):
        start = at + 4
        end = start + int.from_bytes(content[at:start], "little")
        fields = fields_of(content[start:end]) if end + 4 <= len(content) else None
        if fields is None:
            raise ValueError(f"{len(content) - at} bytes are not a record")
        body = end + 4
        at = body + _U32.unpack_from(content, end)[0]
        kind = fields.get("op", b"")
        refuse_if(
            at > len(content) or len(kind) != 1, f"{len(content) - body} bytes are not a record", error=ValueError
        )
        yield Part(offset, kind[0], content[body:at], fields=fields)


_WIDEST_HOLE = 1 << 40
_WAL = b"\2\2"  # format versions of a database that keeps what is new in a journal, "-wal"
_PAGE_SIZE, _FILE_FORMAT = slice(16, 18), slice(18, 20)  # of its header (sqlite.org/fileformat2.html)


class Db3Log(RawLog):
    """One .db3 file, with the journal ("-wal") of a recorder that did not close it.

    SQLite writes while it reads a journal, so both files are copied, a cut one up to its last whole page. Raises
    InputError for other tables, or an unreadable file.
    """

    container = "ROS 2 bag (sqlite3)"

    def __init__(self, path: Path) -> None:
        self.path = self._database = path
        self._journal, self._num_pages = path.with_name(f"{path.name}-wal"), 0
        has_journal = self._journal.is_file() and self._journal.stat().st_size > 0
        self.files = (path, self._journal) if has_journal else (path,)
        with path.open("rb") as stream:
            header = stream.read(_FILE_FORMAT.stop)
        page = int.from_bytes(header[_PAGE_SIZE], "big") if header.startswith(b"SQLite format 3") else 0
        size = path.stat().st_size
        end = size - size % (page if page > 1 else 1 << 16) if page else size  # 1 stands for 65536 bytes
        try:
            if has_journal or end < size:
                self._copy(end)
            if has_journal:
                self._merge(end)
            with closing(self._opened()) as database:
                self.channels = _topics(database)
        except (sqlite3.Error, ValueError) as error:
            remedy = "try 'ros2 bag reindex', or copy it again"
            if header[_FILE_FORMAT] == _WAL and not has_journal:
                error = ValueError(f"{error}, and {self._journal.name} is missing")
                remedy = f"copy {self._journal.name} from where the bag was recorded: a stopped recorder leaves it"
            raise InputError(f"{path}: not a readable {self.container}: {error}", remedy=remedy) from None

    def _copy(self, size: int) -> None:
        folder = Path(tempfile.mkdtemp(prefix="splatctrl-", dir=scratch_folder()))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        what = f"cannot be copied to {folder.parent} to read {' and '.join(file.name for file in self.files)}"
        with refuse_faults(
            lambda error: f"{self.path}: {what}: {error.strerror}",
            OSError,
            remedy="set TMPDIR to a folder with room for it",
        ):
            copies = [Path(shutil.copyfile(file, folder / file.name)) for file in self.files]
        self._database = copies[0]
        os.truncate(self._database, size)

    def _merge(self, size: int) -> None:
        try:
            with closing(sqlite3.connect(self._database)) as database:
                self._num_pages = database.execute("PRAGMA wal_checkpoint").fetchone()[1]
        except sqlite3.Error:
            self._copy(size)

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages in written order; rows on damaged pages are skipped and counted."""
        if self._num_pages > 0:
            damage.remark(
                f"{self.path.name}: was not closed; {self._num_pages} pages of {self._journal.name} were read"
            )
        elif len(self.files) > 1:
            damage.add(f"{self._journal.name}: holds no page that can be read; the bag was not closed")
        with closing(self._opened()) as database:
            for topic_id, log_time_ns, data in self._rows(database, damage):
                topic = self.channels.get(topic_id)
                if topic is None or not isinstance(data, bytes) or not isinstance(log_time_ns, int):
                    damage.add(f"{self.path.name}: a message without topic, time or data")
                elif names is None or topic.name in names:
                    yield RawMessage(topic=topic, log_time_ns=log_time_ns, data=data, file=self.path.name)

    def _rows(self, database: sqlite3.Connection, damage: Damage) -> Iterator[tuple[object, object, object]]:
        last, hole = -(1 << 62), 1  # hole: how many rows to pass over next
        for _ in range(1000):
            try:
                for number, *row in database.execute(
                    "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id", (last,)
                ):
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
        database = sqlite3.connect(f"file:{quote(str(self._database.absolute()))}?mode=ro&immutable=1", uri=True)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BLOCK)
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("PRAGMA writable_schema = ON")  # else sqlite refuses a file that is shorter than it says
        database.text_factory = lambda content: content.decode("utf-8", "replace")
        return database


def _topics(database: sqlite3.Connection) -> dict[object, Topic]:
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    refuse_if(not {"topics", "messages"} <= tables, "no tables named topics and messages", error=ValueError)
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    rows = database.execute(query) if "message_definitions" in tables else ()
    definitions = {kind: (encoding, text) for kind, encoding, text in rows}
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
        topics[number] = add_ros_type(topic)
    return topics
