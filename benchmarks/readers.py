"""The readers of foreign bytes, called in this process, with each one's valid inputs and errors.

For `benchmarks.coverage_fuzz` and for the tests: a reader reads any bytes, or raises one of its errors.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin

from benchmarks.fuzz_samples import ROBOT, capture_of, plain_log
from splatctrl_cli.errors import SplatCtrlError
from splatctrl_cli.formats.arrays import DAMAGE, npy_of, read_arrays, savez
from splatctrl_cli.formats.grid.grid_formats import write_grid
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.grid.nrrd import read_nrrd_head
from splatctrl_cli.formats.grid.vti import read_vti
from splatctrl_cli.formats.image_file import image_head, read_pfm, write_pfm
from splatctrl_cli.formats.splat.splats import FORMATS
from splatctrl_cli.recording.capture.capture import CaptureSource
from splatctrl_cli.recording.container.bag_logs import Bag1Log, Db3Log
from splatctrl_cli.recording.container.foxglove import read_protobuf
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage
from splatctrl_cli.recording.folder.folder_description import read_description
from splatctrl_cli.recording.folder.poses import read_nerfstudio, read_trajectory_log, tum_rows
from splatctrl_cli.recording.log.decoder import IMAGE, UndecodableMessageError
from splatctrl_cli.recording.log.messages import decode_rvl, read_image
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.robot.sphere_files import read_spheres
from splatctrl_cli.robot.urdf import read_urdf
from tests.formats.grid.make_grid import random_grid
from tests.formats.splat.test_gaussian_ply import gaussian_set
from tests.recording.container.test_foxglove import descriptor_set
from tests.recording.container.test_log_formats import as_ros1_bag, as_ros2_folder
from tests.recording.folder.make_layout import make_nerfstudio, make_redwood, make_tum
from tests.recording.log.make_log import LogRecipe, make_log
from tests.recording.log.make_rvl import encoded_rvl

Read = Callable[[bytes], object]
DEPTH = np.arange(48, dtype=np.uint16).reshape(6, 8) * 700
STAMP = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="a")
FORMS = ("jpeg", "png", "16UC1; compressedDepth png", "16UC1; compressedDepth rvl", "32FC1; compressedDepth png")
ENCODINGS = ("rgb8", "bgra8", "mono8", "bayer_rggb8", "uyvy", "nv12", "nv24", "16UC1", "32FC1", "rgb16", "odd")


@dataclass(frozen=True, kw_only=True)
class Reader:
    """One reader of bytes: valid inputs, and the errors that any other bytes may end in."""

    name: str
    read: Read
    seeds: tuple[bytes, ...]
    errors: tuple[type[Exception], ...] = (SplatCtrlError,)


def all_readers(folder: Path) -> list[Reader]:
    """Every reader; files are written below the empty `folder`."""
    made = folder / "made"
    made.mkdir(parents=True)
    return [*_logs(made, folder), *_messages(), *_arrays(made, folder), *_splats(made, folder), *_texts(made, folder)]


def _file(folder: Path, name: str, read: Callable[[Path], object]) -> Read:
    """A reader of a file as one of bytes."""
    path = folder / "given" / name
    path.parent.mkdir(exist_ok=True)

    def read_bytes(data: bytes) -> object:
        path.write_bytes(data)
        return read(path)

    return read_bytes


def _logs(made: Path, folder: Path) -> list[Reader]:
    log = make_log(made / "log.mcap", LogRecipe(num_frames=1))
    plain = plain_log(log, made / "plain.mcap")
    bag = as_ros1_bag(log, made / "log.bag")
    db3 = as_ros2_folder(log, made / "bag", StoragePlugin.SQLITE3) / "bag.db3"

    def messages(kind: Callable[[Path], McapLog | Bag1Log | Db3Log]) -> Callable[[Path], object]:
        return lambda path: list(kind(path).messages(Damage()))

    found = [
        Reader(name="mcap", read=_file(folder, "x.mcap", messages(McapLog)), seeds=_bytes(log, plain)),
        Reader(name="bag", read=_file(folder, "x.bag", messages(Bag1Log)), seeds=_bytes(bag)),
        Reader(name="db3", read=_file(folder, "x.db3", messages(Db3Log)), seeds=_bytes(db3)),
    ]
    capture = capture_of(log, made / "c.capture")
    for name in ("capture.json", "frames.csv", "joints.npz"):
        read = _of_capture(capture, name)
        found.append(Reader(name=name, read=read, seeds=_bytes(capture / name)))
    return found


def _of_capture(capture: Path, name: str) -> Read:
    """A capture with one file replaced, and its checksum with it."""
    sums, before = capture / "SHA256SUMS", (capture / name).read_bytes()
    lines = sums.read_text().splitlines()

    def read(data: bytes) -> object:
        (capture / name).write_bytes(data)
        digest = hashlib.sha256(data).hexdigest()
        sums.write_text("".join(f"{digest if x[66:] == name else x[:64]}  {x[66:]}\n" for x in lines))
        try:
            return list(CaptureSource(capture, SourceOptions()).records())
        finally:
            (capture / name).write_bytes(before)
            sums.write_text("\n".join(lines) + "\n")

    return read


def _messages() -> list[Reader]:
    png = cv2.imencode(".png", DEPTH)[1].tobytes()
    jpeg = cv2.imencode(".jpg", np.full((6, 8, 3), 90, np.uint8))[1].tobytes()
    rvl = encoded_rvl(DEPTH)
    depth_head = bytes(12)
    files = (jpeg, png, depth_head + png, depth_head + np.array([8, 6], "<i4").tobytes() + rvl, depth_head + png)
    seeds = tuple(bytes([kind]) + file for kind, file in enumerate(files))

    def compressed(data: bytes) -> object:
        form = FORMS[data[0] % len(FORMS)] if data else FORMS[0]
        message = SimpleNamespace(header=STAMP, format=form, data=np.frombuffer(data[1:], np.uint8))
        return read_image(message, "compressed", lazily=bool(data) and data[0] > 127).pixels

    def raw(data: bytes) -> object:
        head = np.frombuffer(data[:12].ljust(12, b"\0"), "<u2")
        message = SimpleNamespace(
            **{"header": STAMP, "width": head[1], "height": head[2], "step": head[3], "is_bigendian": head[4] & 1},
            **{"encoding": ENCODINGS[int(head[0]) % len(ENCODINGS)], "data": np.frombuffer(data[12:], np.uint8)},
        )
        return read_image(message, IMAGE).pixels

    def protobuf(data: bytes) -> object:
        size = int.from_bytes(data[:2], "little")
        return read_protobuf(data[2 : 2 + size], "foxglove.RawImage", data[2 + size :])

    types = descriptor_set()
    raws = tuple(  # nv24 has to end where its pixels do
        np.array([k, 8, 6, 24 if name == "nv24" else 48, 0, 0], "<u2").tobytes()
        + bytes(144 if name == "nv24" else 600)
        for k, name in enumerate(ENCODINGS)
    )
    proto = len(types).to_bytes(2, "little") + types + b"\x15\x08\x00\x00\x00\x1d\x06\x00\x00\x00"
    return [
        Reader(name="compressed image", read=compressed, seeds=seeds, errors=(UndecodableMessageError,)),
        Reader(name="image", read=raw, seeds=raws, errors=(UndecodableMessageError,)),
        Reader(name="image head", read=image_head, seeds=(jpeg, png), errors=()),
        Reader(name="rvl", read=lambda data: decode_rvl(data, 48), seeds=(rvl,), errors=(ValueError,)),
        Reader(name="protobuf", read=protobuf, seeds=(proto,), errors=(ValueError,)),
    ]


def _arrays(made: Path, folder: Path) -> list[Reader]:
    arrays = made / "arrays.npz"
    savez(arrays, {"a": np.arange(6.0).reshape(2, 3), "text": np.array("{}")})
    np.save(made / "a.npy", np.arange(6, dtype=np.float32).reshape(2, 3))
    write_pfm(made / "a.pfm", np.ones((3, 4), np.float32))
    (made / "field").mkdir()
    grids = {p.suffix: p for p in write_grid(made / "field", random_grid("sdf", "gradient"), ["npz", "vti", "nrrd"])}
    read = _file(folder, "x.npz", lambda path: read_arrays(path, most=1 << 20))
    damage = (*DAMAGE, SplatCtrlError, OSError)
    return [
        Reader(name="arrays", read=read, seeds=_bytes(arrays), errors=damage),
        Reader(name="npy", read=npy_of, seeds=_bytes(made / "a.npy"), errors=damage),
        Reader(name="grid.npz", read=_file(folder, "x.npz", read_npz), seeds=_bytes(grids[".npz"])),
        Reader(name="vti", read=_file(folder, "x.vti", read_vti), seeds=_bytes(grids[".vti"])),
        Reader(name="nrrd", read=_file(folder, "x.nrrd", read_nrrd_head), seeds=_bytes(grids[".nrrd"])),
        Reader(name="pfm", read=_file(folder, "x.pfm", read_pfm), seeds=_bytes(made / "a.pfm")),
    ]


def _splats(made: Path, folder: Path) -> list[Reader]:
    found = []
    for suffix in splat_suffixes():
        path = made / f"splats{suffix}"
        FORMATS[suffix].write(path, gaussian_set(4), {"a": "b"})
        found.append(
            Reader(name=suffix[1:], read=_file(folder, f"x{suffix}", FORMATS[suffix].read), seeds=_bytes(path))
        )
    return found


def splat_suffixes() -> list[str]:
    """Suffixes of the formats whose bytes this package reads itself, without a library."""
    return [suffix for suffix in FORMATS if not suffix.startswith(".usd")]


def _texts(made: Path, folder: Path) -> list[Reader]:
    for name, make in {"tum": make_tum, "redwood": make_redwood, "nerfstudio": make_nerfstudio}.items():
        (made / name).mkdir()
        make(made / name)
    toml = (
        b'root = "."\n[camera]\nwidth = 32\nheight = 24\nfx = 30\nfy = 30\ncx = 15.5\ncy = 11.5\n'
        b'[frames]\ncolor = "*.png"\n'
        b'depth = "*.png"\n[depth]\nscale = 1e-3\n[poses]\nformat = "trajectory-log"\nfile = "t.log"\n'
    )
    files: dict[str, tuple[Callable[[Path], object], bytes]] = {
        "x.urdf": (read_urdf, (ROBOT / "robot.urdf").read_bytes()),
        "x.yaml": (read_spheres, (ROBOT / "robot_spheres.yaml").read_bytes()),
        "x.toml": (read_description, toml),
        "x.tum": (tum_rows, (made / "tum/groundtruth.txt").read_bytes()),
        "x.log": (read_trajectory_log, (made / "redwood/trajectory.log").read_bytes()),
        "transforms.json": (read_nerfstudio, (made / "nerfstudio/transforms.json").read_bytes()),
    }
    return [
        Reader(name=name, read=_file(folder, name, read), seeds=(seed,), errors=(SplatCtrlError, RecursionError))
        for name, (read, seed) in files.items()
    ]


def _bytes(*paths: Path) -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in paths)
