"""Containers of other recorders."""

import re
import shutil
import sqlite3
import struct
import zipfile
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from splatctrl_cli.geometry import pose_at
from splatctrl_cli.recording.capture.capture import read_capture_header
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import RawMessage
from splatctrl_cli.recording.log.decoder import COMPRESSED_IMAGE
from splatctrl_cli.recording.log.survey import survey
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import Float32, Float64, RgbdFrame
from tests.cases.case import Case, Run, expect_result
from tests.recording.log.make_log import (
    Change,
    LogRecipe,
    broken_log,
    built,
    camera_info,
    encoded,
    image,
    make_log,
    messages_of,
    write_bag,
    write_raw,
)
from tests.recording.log.make_rvl import encoded_rvl


def recorded(folder: Path, recipe: LogRecipe | None = None) -> list[RawMessage]:
    """The messages of a good log of three frames, or of `recipe`."""
    path = make_log(folder / "good.mcap", recipe or LogRecipe(num_frames=3))
    messages = list(messages_of(path))
    path.unlink()
    return messages


def first_depth(path: Path) -> Float32:
    """The depth [m] of a recording's first frame."""
    return next(record for record in open_source(path).records() if isinstance(record, RgbdFrame)).depth


def write_db3(folder: Path, messages: Iterable[RawMessage], mode: CompressionMode = CompressionMode.NONE) -> Path:
    """A ROS 2 bag of sqlite3 in the folder `folder`, by rosbags; its storage file."""
    write_bag(folder, messages, plugin=StoragePlugin.SQLITE3, mode=mode)
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
    shutil.rmtree(folder / "made")


def _examine_killed(folder: Path, out: Path, run: Run) -> None:
    for bag in sorted(folder.glob("*wal*/bag_0.db3")):
        before = sorted((path.name, path.read_bytes()) for path in bag.parent.iterdir())
        for number, given in enumerate((bag, bag.parent)):
            words = ["ingest", given, "-o", out / f"{bag.parent.name}{number}.capture"]
            result = expect_result(run, words, "pages of bag_0.db3-wal were read")
            assert "cam0 3" in result.text or "cam 3" in result.text
        assert sorted((path.name, path.read_bytes()) for path in bag.parent.iterdir()) == before


def as_file(path: Path, messages: Iterable[RawMessage], mode: CompressionMode) -> None:
    """A ROS 2 bag of sqlite3 as a file alone."""
    write_db3(path.with_name("made"), messages, mode).rename(path)
    shutil.rmtree(path.with_name("made"))


def _make_message_mode(folder: Path) -> None:
    as_file(folder / "24-msgzstd.db3", recorded(folder), CompressionMode.MESSAGE)
    as_file(folder / "24-file.db3.zstd", recorded(folder), CompressionMode.FILE)


def _examine_message_mode(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.db3*")):
        result = expect_result(run, ["ingest", path, "-o", out / f"{path.name}.capture"])
        assert "cam 6" in result.text or "cam0 3" in result.text
        assert "damaged" not in result.text


SDK_COLOR, SDK_DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"

TURN = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])


def _sdk_messages(rotation: Float64, unit: float) -> list[RawMessage]:
    """A recording of the RealSense SDK of 2026; colour is `rotation` and 15 mm from depth, a count is `unit` [m]."""

    def text(topic: str, said: str, log_ns: int = 1) -> RawMessage:
        return encoded(log_ns, topic, built("std_msgs/msg/String", data=said))

    def seen(topic: str, log_ns: int, encoding: str, pixels: np.ndarray[Any, Any]) -> RawMessage:
        frame = topic.rpartition("/")[2].partition("_")[0]
        return encoded(log_ns, f"{topic}/image/data", image(log_ns, frame, encoding, pixels))

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
        messages.append(seen(SDK_DEPTH, log_ns, "mono16", counts))
        messages.append(text(f"{SDK_DEPTH}/image/metadata", f"Frame number={index};Depth Units={unit:.6f};", log_ns))
        messages.append(seen(SDK_COLOR, log_ns + 1000, "rgb8", rng.integers(0, 255, (48, 64, 3), np.uint8)))
        messages.append(text(f"{SDK_COLOR}/image/metadata", f"Frame number={index};", log_ns))
    return messages


def _make_sdk(folder: Path) -> None:
    plain, turned = _sdk_messages(np.eye(3), 0.001), _sdk_messages(TURN, 0.00025)
    as_file(folder / "18-realsense.db3", plain, CompressionMode.NONE)
    as_file(folder / "zstd.db3", plain, CompressionMode.MESSAGE)
    as_file(folder / "turned.db3", turned, CompressionMode.NONE)
    write_raw(folder / "turned.mcap", turned)


def _examine_sdk(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.[dm]*")):
        capture = out / f"{path.name}.capture"
        expect_result(run, ["ingest", path, "-o", capture, "--camera-pose", "device_0=identity"], "device_0 6")
        camera = read_capture_header(capture)["cameras"]["device_0"]
        assert [camera[name] for name in ("fx", "fy", "cx", "cy")] == [60.0, 60.0, 31.5, 23.5]
        found, is_turned = survey(open_raw_log(path)).realsense, path.stem == "turned"
        T_color_depth = found.T_between(f"{SDK_COLOR}/image/data", f"{SDK_DEPTH}/image/data")
        np.testing.assert_allclose(T_color_depth, pose_at([0.015, 0, 0], TURN if is_turned else np.eye(3)), atol=1e-6)
        assert found.depth_unit(f"{SDK_DEPTH}/image/data") == (0.00025 if is_turned else 0.001)
        depth = first_depth(capture)
        assert is_turned or abs(np.median(depth[depth > 0]) - 1.2) < 0.002


def _changed(folder: Path, name: str, change: Change, **recipe: Any) -> None:
    """A good log of six frames whose messages are what `change` makes of them."""
    broken_log(folder / f"{name}.mcap", change, LogRecipe(num_frames=6, **recipe))
    (folder / f"{name}.good.mcap").unlink()


def _change_depth(folder: Path, name: str, change: Callable[[Any], Any], encoding: str = "16UC1") -> None:
    """A good log of six frames whose depth messages are what `change` makes of them, under their topic or another."""

    def changed(log_ns: int, topic: str, kind: str, message: Any) -> Iterable[tuple[int, str, str, Any]]:
        is_depth = topic == "/cam0/depth/image_raw"
        message = change(message) if is_depth else message
        is_packed = is_depth and message.__msgtype__.endswith("CompressedImage")
        yield log_ns, f"{topic}/compressedDepth" if is_packed else topic, kind, message

    _changed(folder, name, changed, depth_encoding=encoding)


CODES = {"14-65535": 65535, "float-mm": 65.535, "float-far": 1e6, "float-max": np.finfo(np.float32).max}

CONSTANTS = {"ten-metres": 10.0, "four-metres": 4.0, "counts-65534": 65534}


def _make_codes(folder: Path) -> None:
    for name, value in {**CODES, **CONSTANTS}.items():
        encoding, dtype = ("16UC1", "<u2") if isinstance(value, int) else ("32FC1", "<f4")

        def change(message: Any, value: float = value, dtype: str = dtype) -> Any:
            pixels = np.frombuffer(message.data.tobytes(), dtype).reshape(message.height, message.width).copy()
            pixels[:5] = value
            return replace(message, data=np.frombuffer(pixels.tobytes(), np.uint8))

        _change_depth(folder, name, change, encoding)


def _examine_codes(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.mcap")):
        capture = out / f"{path.stem}.capture"
        result = expect_result(run, ["check", path])
        expect_result(run, ["ingest", path, "-o", capture])
        if path.stem not in CODES:
            value = {"counts-65534": 65.534}.get(path.stem, CONSTANTS.get(path.stem))
            assert f"many pixels are exactly {value:g} m, the largest depth of 6 of 6 images" in result.text
            continue
        assert re.search(r"\d+ depth pixels of 6 images are [^.]*65535 .*count as none", result.text)
        assert "depth-constant" not in result.text
        assert read_capture_header(capture)["loss"]["invalid_depth"] > 500
        assert first_depth(capture).max() < 2.0
        if path.stem in {"14-65535", "float-max"}:
            few = ("scene.first_iterations=2", "--set", "scene.iterations_per_step=1", "--max-splats", "200")
            expect_result(run, ["reconstruct", path, "-o", out / f"{path.stem}.scene", "--set", *few])


def counts_of(message: Any) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """The pixels of a message of sixteen bits."""
    return np.frombuffer(message.data.tobytes(), "<u2").reshape(message.height, message.width)


def _png(message: Any) -> bytes:
    return bytes(cv2.imencode(".png", counts_of(message))[1])


def _packed(form: str, head: bytes, pack: Callable[[Any], bytes] = _png) -> Callable[[Any], Any]:
    def change(message: Any) -> Any:
        return built(COMPRESSED_IMAGE, header=message.header, format=form, data=head + pack(message))

    return change


def jpeg_of(message: Any) -> bytes:
    """Sixteen bits of depth as a careless driver packs them."""
    return bytes(cv2.imencode(".jpg", (counts_of(message) >> 4).astype(np.uint8))[1])


def _rvl(message: Any) -> bytes:
    return struct.pack("<ii", message.width, message.height) + encoded_rvl(counts_of(message))


HEAD = struct.pack("<iff", 0, 0.0, 0.0)

READ = {
    "04-cd-nohead": _packed("16UC1; compressedDepth", b""),
    "04-cd-16uc1": _packed("16UC1; png compressed ", HEAD),
    "png-nohead": _packed("16UC1; compressedDepth png", b""),
    "just-png": _packed("png", HEAD),
}

REFUSED = {
    "rvl-unsaid": (_packed("16UC1; compressedDepth", HEAD, _rvl), "RVL under the format '16UC1; compressedDepth'"),
    "rvl-other": (_packed("16UC1; rvl", HEAD, _rvl), "RVL under the format '16UC1; rvl'"),
    "jpeg-inside": (_packed("16UC1; compressedDepth", HEAD, jpeg_of), "JPEG loses depth: record PNG"),
    "jpeg-said": (_packed("16UC1; jpeg compressed ", b"", jpeg_of), "JPEG loses depth: record PNG"),
    "jpeg": (_packed("jpeg", b"", jpeg_of), "JPEG loses depth: record PNG"),
    "float-nohead": (_packed("32FC1; compressedDepth", b""), "32FC1 without the 12 bytes"),
}


def _make_packed(folder: Path) -> None:
    for name, change in (*READ.items(), *((name, change) for name, (change, _) in REFUSED.items())):
        _change_depth(folder, name, change)


def _examine_packed(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.mcap")):
        capture, is_read = out / f"{path.stem}.capture", path.stem in READ
        result = expect_result(run, ["ingest", path, "-o", capture], code=0 if is_read else 4)
        assert "damaged" not in result.text and "copy the file" not in result.text
        if is_read:
            assert result.text.count("its PNG begins at byte 0") + result.text.count("a PNG behind 12 bytes") == 1
            depth = first_depth(capture)
            assert 1.0 < np.median(depth[depth > 0]) < 1.3
        else:
            assert REFUSED[path.stem][1] in result.text and REFUSED[path.stem][1] in run(["check", path]).text
            assert "/cam0/depth/image_raw/compressedDepth" in result.text


def _rename(folder: Path, name: str, topics: dict[str, str], encoding: str = "mono16", color: str = "rgb8") -> None:
    """A good log of six frames under other names; a depth topic may have several, or none."""

    def changed(log_ns: int, topic: str, kind: str, message: Any) -> Iterable[tuple[int, str, str, Any]]:
        for other in topics.get(topic, topic).split():
            yield log_ns, other, kind, message

    _changed(folder, name, changed, depth_encoding=encoding, color_format=color)


COLOR_0, DEPTH_0 = "/cam0/color/image_raw", "/cam0/depth/image_raw"

NO_DEPTH = {  # the topic of sixteen bits, and its word
    "21-k4a-ironly": ("/ir/image_raw", "ir"),
    "infra": ("/cam0/infra1/image_rect_raw", "infra"),
    "infra-plain": ("/cam0/infra/image_raw", "infra"),
    "aux": ("/cam0/aux/image_raw", "aux"),
    "kinect2": ("/cam0/sd/image_ir_rect", "ir"),
    "thermal": ("/cam0/thermal/image_raw", "thermal"),
    "amplitude": ("/cam0/depth/amplitude", "amplitude"),
    "confidence": ("/cam0/depth/confidence_map", "confidence"),
    "intensity": ("/cam0/intensity", "intensity"),
    "disparity": ("/cam0/stereo/disparity", "disparity"),
}

DEPTHS = {  # topics of sixteen bits, and which of them is depth
    "mono16": "/cam0/depth/image_raw",
    "beside": "/cam0/depth/image_raw /cam0/a_ir/image_raw",
    "aligned-to-infra": "/cam0/aligned_depth_to_infra1/image_raw /cam0/infra1/image_rect_raw",
    "in-an-ir-device": "/cam0/ir_camera/depth/image_raw /cam0/ir_camera/image_mono",
    "unnamed-beside": "/cam0/z16/image_raw /cam0/ir/image_raw",
    "k4a": "/cam0/depth_to_rgb/image_raw /cam0/ir/image_raw",
}


def _make_infrared(folder: Path) -> None:
    for name, (topic, _) in NO_DEPTH.items():
        _rename(folder, name, {DEPTH_0: topic}, encoding="16UC1" if name == "aux" else "mono16")
    for name, topics in DEPTHS.items():
        _rename(folder, name, {DEPTH_0: topics})
    _rename(folder, "rivals", {DEPTH_0: "/cam0/one/image_raw /cam0/two/image_raw"})
    _rename(folder, "gray-depth", {COLOR_0: DEPTH_0, DEPTH_0: "/cam0/z16"}, color="mono8")


def _examine_infrared(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.mcap")):
        words = ["ingest", path, "-o", out / f"{path.stem}.capture"]
        if path.stem in NO_DEPTH:
            said = "no depth topic; neither depth nor colour: {} (named {})".format(*NO_DEPTH[path.stem])
            expect_result(run, words, said, "give --camera NAME=COLOR,DEPTH", code=4)
            assert "no depth topic" in run(["check", path]).text
        elif path.stem in DEPTHS:
            expect_result(run, words)
            assert DEPTHS[path.stem].split()[0] in run(["info", path]).out.splitlines()[-1]
        elif path.stem == "gray-depth":
            expect_result(run, words, "/cam0/depth/image_raw (mono8 that is named depth)", code=4)
        else:
            rivals = "/cam0/one/image_raw, /cam0/two/image_raw could each be its depth"
            expect_result(run, words, rivals, "give --camera cam0=/cam0/color/image_raw,DEPTH", code=4)
            assert "could each be its depth" in run(["info", path]).text
            expect_result(run, [*words, "--camera", "cam0=/cam0/color/image_raw,/cam0/two/image_raw"])


def _with_info(
    folder: Path, name: str, lens: tuple[float, float, float], size: tuple[int, int], cut: tuple[int, ...], of: str
) -> None:
    """A good log of 32x24 images whose CameraInfo `of` color or depth says this lens (f, cx, cy) and size of the
    sensor, and is cut: binning, x, y, width and height of the region, whether it is to be rectified.
    """
    (f, cx, cy), (binning, x, y, width, height, rectify) = lens, cut
    roi = {"x_offset": x, "y_offset": y, "width": width, "height": height, "do_rectify": bool(rectify)}
    said = {"binning_x": binning, "binning_y": binning, "roi": roi, "p": [f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1, 0]}

    def changed(log_ns: int, topic: str, kind: str, message: Any) -> Iterable[tuple[int, str, str, Any]]:
        is_info = topic.endswith("camera_info")
        if not is_info or of == "depth":
            yield log_ns, topic, kind, message
        if is_info:
            info = camera_info(log_ns, message.header.frame_id, size, (f, f, cx, cy), d=message.d, **said)
            yield log_ns, topic.replace("color", of), kind, info

    _changed(folder, name, changed)


CUT = {  # lens and size of the whole sensor, the cut, and fx, cx, cy of the images
    "binning": ((60, 31.5, 23.5), (64, 48), (2, 0, 0, 0, 0, 0), (30, 15.75, 11.75)),
    "roi": ((30, 25.5, 18.5), (64, 48), (0, 10, 7, 32, 24, 1), (30, 15.5, 11.5)),
    "roi-raw": ((30, 25.5, 18.5), (64, 48), (1, 10, 7, 32, 24, 0), (30, 15.5, 11.5)),
    "both": ((60, 41.5, 33.5), (128, 96), (2, 10, 10, 64, 48, 0), (30, 15.75, 11.75)),
    "whole": ((30, 15.5, 11.5), (32, 24), (0, 0, 0, 32, 24, 0), (30, 15.5, 11.5)),
    "one": ((30, 15.5, 11.5), (32, 24), (1, 0, 0, 0, 0, 0), (30, 15.5, 11.5)),
}

SHARED_CUT = {"02-binning": (60, 31.75, 23.75), "02-roi": (60, 31.5, 23.5)}

CONTRADICTED = {  # lens, size and cut as above, and what is said
    "02-roi-size": ((30, 18.5, 13.5), (32, 24), (0, 3, 2, 32, 24, 0), "says region of"),
    "offset": ((30, 25.5, 18.5), (32, 24), (0, 3, 2, 29, 22, 0), "(region of 29x22 at (3, 2) of 32x24), got 32x24"),
    "no-size": ((30, 25.5, 18.5), (64, 48), (0, 3, 2, 0, 0, 0), "says region of 0x0 at (3, 2) of 64x48"),
    "other-size": ((30, 25.5, 18.5), (64, 48), (0, 10, 7, 40, 24, 0), "region of 40x24 at (10, 7) of 64x48), got"),
    "unbinned": ((30, 15.5, 11.5), (32, 24), (2, 0, 0, 0, 0, 0), "(binning 2x2 of 32x24), got 32x24"),
}


def _make_cut(folder: Path) -> None:
    for name, (lens, size, cut, _) in {**CUT, **CONTRADICTED}.items():
        _with_info(folder, name, lens, size, cut, "color")
    _with_info(folder, "depth-alone", (30, 21.5, 11.5), (64, 48), (0, 10, 0, 32, 24, 0), "depth")


def _examine_cut(folder: Path, out: Path, run: Run) -> None:
    for path in sorted(folder.glob("*.mcap")):
        capture = out / f"{path.stem}.capture"
        words = ["ingest", path, "-o", capture]
        if path.stem in CONTRADICTED:
            result = expect_result(run, words, CONTRADICTED[path.stem][3], code=4)
            name = re.search(r"camera (\w+):", result.text)[1]
            assert f"give --intrinsics {name}=FX,FY,CX,CY of the recorded images" in result.text
            assert run(["check", path]).code != 0
            expect_result(run, [*words, "--intrinsics", f"{name}=60,60,31.5,23.5"])
            continue
        result = expect_result(run, words)
        camera = next(iter(read_capture_header(capture)["cameras"].values()))
        if path.stem == "depth-alone":
            assert "/cam0/depth/camera_info: says region of 32x24 at (10, 0) of 64x48" in result.text
            continue
        f, cx, cy = SHARED_CUT[path.stem] if path.stem in SHARED_CUT else CUT[path.stem][3]
        assert [camera[key] for key in ("fx", "fy", "cx", "cy")] == [f, f, cx, cy]
        assert ("K is moved and scaled to that" in result.text) == (path.stem not in {"whole", "one"})


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
        parts = "Azure Kinect", "azure_kinect_ros_driver (recording_file:=FILE)"
        if path.suffix != ".mkv":
            parts = "a Record3D recording, which is not read", "export it in the Record3D app"
        for words in (["ingest", path, "-o", out / "x.capture"], ["info", path], ["check", path]):
            assert "pip install" not in expect_result(run, words, *parts, code=4).text


CASES: tuple[Case, ...] = (
    Case(name="09-ir-taken-for-depth", make=_make_infrared, examine=_examine_infrared, has_shared=True),
    Case(name="10-depth-65535", make=_make_codes, examine=_examine_codes, has_shared=True),
    Case(name="21-realsense-sdk-db3", make=_make_sdk, examine=_examine_sdk, has_shared=True),
    Case(name="23-db3-wal-all", make=_make_killed, examine=_examine_killed, has_shared=True),
    Case(name="24-message-zstd-single-db3", make=_make_message_mode, examine=_examine_message_mode, has_shared=True),
    Case(name="25-compressedDepth-without-header", make=_make_packed, examine=_examine_packed, has_shared=True),
    Case(name="27-camera-info-binning-roi", make=_make_cut, examine=_examine_cut, has_shared=True),
    Case(name="34-record3d-mkv", make=_make_foreign, examine=_examine_foreign, has_shared=True),
)
