"""Containers of other recorders."""

import sqlite3
import zipfile
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from splatctrl_cli.captures.capture_header import read_capture_header
from splatctrl_cli.containers.log_formats import open_raw_log
from splatctrl_cli.containers.raw_log import RawMessage
from splatctrl_cli.logs.survey import survey
from splatctrl_cli.records import Float64
from splatctrl_cli.sources.source import open_source
from tests.cases.case import Case, Run
from tests.logs.make_log import STORE, LogRecipe, T, encoded, header, make_log, messages_of, write_raw


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


SDK_COLOR, SDK_DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
TURN = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])


def _sdk_messages(rotation: Float64, unit: float) -> list[RawMessage]:
    """A recording of the RealSense SDK of 2026; colour is `rotation` and 15 mm from depth, a count is `unit` [m]."""

    def text(topic: str, said: str, log_ns: int = 1) -> RawMessage:
        return encoded(log_ns, topic, T["std_msgs/msg/String"](data=said))

    def image(topic: str, log_ns: int, encoding: str, pixels: np.ndarray[Any, Any]) -> RawMessage:
        stamped = header(log_ns, topic.rpartition("/")[2].partition("_")[0])
        rows = np.frombuffer(pixels.tobytes(), np.uint8)
        size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": pixels.strides[0]}
        said = T["sensor_msgs/msg/Image"](header=stamped, encoding=encoding, is_bigendian=0, data=rows, **size)
        return encoded(log_ns, f"{topic}/image/data", said)

    messages = [text("/device_0/info", "Name=Intel RealSense D435;Serial Number=000000000000")]
    for topic, turned, position in ((SDK_DEPTH, np.eye(3), 0.0), (SDK_COLOR, rotation, 0.015)):
        lens = "width=64;height=48;fx=60;ppx=31.5;fy=60;ppy=23.5;model=Brown Conrady;coeffs=0,0,0,0,0"
        by_columns = ",".join(f"{value:.6f}" for value in turned.T.ravel())
        messages.append(text(f"{topic}/camera_info", lens))
        messages.append(text(f"{topic}/tf/ref_0", f"rotation={by_columns};translation={position:.6f},0.0,0.0"))
    messages.append(text("/device_0/sensor_0/option/Depth_Units/value", "0.001000"))
    rng = np.random.default_rng(0)
    for index in range(6):
        log_ns = 1_700_000_000_000_000_000 + index * 33_333_333
        counts = (rng.normal(1.2, 0.002, (48, 64)) / unit).astype(np.uint16)
        messages.append(image(SDK_DEPTH, log_ns, "mono16", counts))
        messages.append(text(f"{SDK_DEPTH}/image/metadata", f"Frame number={index};Depth Units={unit:.6f};", log_ns))
        messages.append(image(SDK_COLOR, log_ns + 1000, "rgb8", rng.integers(0, 255, (48, 64, 3), np.uint8)))
        messages.append(text(f"{SDK_COLOR}/image/metadata", f"Frame number={index};", log_ns))
    return messages


def _make_sdk(folder: Path) -> None:
    plain, turned = _sdk_messages(np.eye(3), 0.001), _sdk_messages(TURN, 0.00025)
    for name, messages, mode in (
        ("18-realsense.db3", plain, CompressionMode.NONE),
        ("zstd.db3", plain, CompressionMode.MESSAGE),
        ("turned.db3", turned, CompressionMode.NONE),
    ):
        write_db3(folder / "made", messages, mode).rename(folder / name)
        (folder / "made" / "metadata.yaml").unlink()
        (folder / "made").rmdir()
    write_raw(folder / "turned.mcap", turned)


def _examine_sdk(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.[dm]*")):
        result = run(["ingest", path, "-o", out / f"{path.name}.capture", "--camera-pose", "device_0=identity"])
        assert result.code == 0, result.text
        assert "device_0 6" in result.text
        camera = read_capture_header(out / f"{path.name}.capture")["cameras"]["device_0"]
        assert [camera[name] for name in ("fx", "fy", "cx", "cy")] == [60.0, 60.0, 31.5, 23.5]
        found = survey(open_raw_log(path)).realsense
        is_turned = path.stem == "turned"
        expected = np.eye(4)
        expected[:3, :3], expected[0, 3] = TURN if is_turned else np.eye(3), 0.015
        T_color_depth = found.T_between(f"{SDK_COLOR}/image/data", f"{SDK_DEPTH}/image/data")
        np.testing.assert_allclose(T_color_depth, expected, atol=1e-6)
        assert found.depth_unit(f"{SDK_DEPTH}/image/data") == (0.00025 if is_turned else 0.001)
        depth = next(iter(open_source(out / f"{path.name}.capture").records())).depth
        assert is_turned or abs(np.median(depth[depth > 0]) - 1.2) < 0.002


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
    Case(name="21-realsense-sdk-db3", make=_make_sdk, examine=_examine_sdk, has_shared=True),
    Case(name="23-db3-wal-all", make=_make_killed, examine=_examine_killed, has_shared=True),
    Case(name="24-message-zstd-single-db3", make=_make_message_mode, examine=_examine_message_mode, has_shared=True),
    Case(name="34-record3d-mkv", make=_make_foreign, examine=_examine_foreign, has_shared=True),
)
