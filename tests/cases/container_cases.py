"""Containers of other recorders."""

import sqlite3
import zipfile
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from splatctrl_cli.containers.raw_log import RawMessage
from tests.cases.case import Case, Run
from tests.logs.make_log import STORE, LogRecipe, make_log, messages_of


def recorded(folder: Path, recipe: LogRecipe | None = None) -> list[RawMessage]:
    """The messages of a good log of three frames, or of `recipe`."""
    path = make_log(folder / "good.mcap", recipe or LogRecipe(num_frames=3))
    messages = list(messages_of(path))
    path.unlink()
    return messages


def write_db3(folder: Path, messages: Iterable[RawMessage], mode: CompressionMode = CompressionMode.NONE) -> Path:
    """A ROS 2 bag of sqlite3 in the folder `folder`, by rosbags; its storage file."""
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    if mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for message in messages:
            name = message.topic.name
            if name not in connections:
                connections[name] = writer.add_connection(name, message.topic.type_name, typestore=STORE)
            writer.write(connections[name], message.log_time_ns, message.data)
    return next(path for path in folder.iterdir() if ".db3" in path.suffixes)


def kill_recorder(bag: Path, killed: Path, closed: int) -> None:
    """The bag as a killed recorder leaves it: all but the first `closed` messages stand in its journal alone."""
    killed.parent.mkdir(parents=True, exist_ok=True)
    written = bag.with_name(f"written-{closed}.db3")
    with closing(sqlite3.connect(bag)) as whole, closing(sqlite3.connect(written)) as database:
        assert database.execute("PRAGMA journal_mode = WAL").fetchall() == [("wal",)]
        database.execute("PRAGMA wal_autocheckpoint = 0").fetchall()
        tables = dict(whole.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall())
        for sql in tables.values():
            database.execute(sql)
        for table in sorted(tables, key="messages".__eq__):
            for number, row in enumerate(whole.execute(f"SELECT * FROM {table}")):
                database.execute(f"INSERT INTO {table} VALUES ({','.join('?' * len(row))})", row)
                if table == "messages" and number + 1 == closed:
                    database.commit()
                    database.execute("PRAGMA wal_checkpoint").fetchall()
        database.commit()
        for suffix in ("", "-wal"):
            content = written.with_name(f"{written.name}{suffix}").read_bytes()
            killed.with_name(f"{killed.name}{suffix}").write_bytes(content)


def _make_killed(folder: Path) -> None:
    bag = write_db3(folder / "made", recorded(folder))
    kill_recorder(bag, folder / "wal-all" / "bag_0.db3", closed=0)
    kill_recorder(bag, folder / "wal-part" / "bag_0.db3", closed=7)
    for path in (folder / "made").iterdir():
        path.unlink()
    (folder / "made").rmdir()


def _examine_killed(folder: Path, out: Path, run: Run) -> None:
    for bag in sorted(folder.glob("*wal*/bag_0.db3")):
        before = sorted((path.name, path.read_bytes()) for path in bag.parent.iterdir())
        for number, given in enumerate((bag, bag.parent)):
            result = run(["ingest", given, "-o", out / f"{bag.parent.name}{number}.capture"])
            assert result.code == 0, result.text
            assert "cam0 3" in result.text or "cam 3" in result.text
            assert "pages of bag_0.db3-wal were read" in result.text
        assert sorted((path.name, path.read_bytes()) for path in bag.parent.iterdir()) == before


def _make_message_mode(folder: Path) -> None:
    alone = write_db3(folder / "made", recorded(folder), CompressionMode.MESSAGE)
    alone.rename(folder / "24-msgzstd.db3")
    alone.with_name("metadata.yaml").unlink()
    (folder / "made").rmdir()
    whole = write_db3(folder / "made", recorded(folder), CompressionMode.FILE)
    whole.rename(folder / "24-file.db3.zstd")
    whole.with_name("metadata.yaml").unlink()
    (folder / "made").rmdir()


def _examine_message_mode(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.db3*")):
        result = run(["ingest", path, "-o", out / f"{path.name}.capture"])
        assert result.code == 0, result.text
        assert "cam 6" in result.text or "cam0 3" in result.text
        assert "damaged" not in result.text


def _make_foreign(folder: Path) -> None:
    (folder / "36-k4a.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + bytes(200))
    (folder / "tagged.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + bytes(4000) + b"K4A_COLOR_MODE")
    (folder / "tagged.csv").write_text("0.0\n")
    with zipfile.ZipFile(folder / "36-x.r3d", "w") as archive:
        archive.writestr("metadata", '{"fps": 30}')
        archive.writestr("rgbd/0.jpg", b"")
    (folder / "renamed.zip").write_bytes((folder / "36-x.r3d").read_bytes())


def _examine_foreign(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.[mrz]*")):
        for words in (["ingest", path, "-o", out / "x.capture"], ["info", path], ["check", path]):
            result = run(words)
            assert result.code == 4
            name, remedy = ("Azure Kinect", "azure_kinect_ros_driver (recording_file:=FILE)")
            if path.suffix != ".mkv":
                name, remedy = "a Record3D recording, which is not read", "export it in the Record3D app"
            assert name in result.text
            assert remedy in result.text
            assert "pip install" not in result.text


CASES: tuple[Case, ...] = (
    Case(name="23-db3-wal-all", make=_make_killed, examine=_examine_killed, has_shared=True),
    Case(name="24-message-zstd-single-db3", make=_make_message_mode, examine=_examine_message_mode, has_shared=True),
    Case(name="34-record3d-mkv", make=_make_foreign, examine=_examine_foreign, has_shared=True),
)
