"""``X.capture/``: a recording as a plain folder of images, poses and joints (docs/capture.md)."""

import csv
import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splatctrl_cli.errors import InputError, WriteError
from splatctrl_cli.geometry import quat_from_rotation, transform_from
from splatctrl_cli.io.capture_joints import joints_file, read_joints
from splatctrl_cli.io.joint_topics import (
    JointTopics,
    joints_again,
    read_topics,
    with_joints,
    without_joints,
    write_topics,
)
from splatctrl_cli.io.masks import human_mask
from splatctrl_cli.io.messages import decode_file, metres
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.output import sha256, write_json
from splatctrl_cli.io.shot import Shot, ShotSource, merged
from splatctrl_cli.records import Float32, Float64, Intrinsics, JointState, LossReport, Record, RgbdFrame, UInt8

FORMAT, VERSION = "splatctrl-capture", 1
INDEX_FILES = ("capture.json", "frames.csv", "joints.npz")
COLUMNS = ("camera", "stamp_ns", "color", "depth", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "source")
MASKED_COLUMNS = (*COLUMNS, "human")  # where the recording has masks
FLOAT_DEPTH_UNIT = 1e-4  # [m] tried for depth that was not recorded as counts
FLOAT_DEPTH_ERROR = 1e-6  # [m] at most, else the floats themselves are stored
_NOT_FOR_CAPTURES = (
    *("world_frame", "camera_topics", "camera_poses", "human_topics", "intrinsics"),
    *("depth_scale", "root", "holdout"),
)
_AGAIN = "run `splatctrl ingest` again"
PNG_LEVEL = 3  # zlib; 3 is half the time of OpenCV's default 6 and 5 % larger on apc_shelf depth


@dataclass(frozen=True, kw_only=True)
class CaptureSummary:
    """What was written."""

    num_frames: dict[str, int]
    num_joint_states: int
    loss: LossReport


@dataclass(kw_only=True)
class _Sums:
    """sha256 of each file as it is written."""

    lines: list[str] = field(default_factory=list)

    def write(self, folder: Path, name: str, data: bytes) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        self.lines.append(f"{hashlib.sha256(data).hexdigest()}  {name}\n")

    def add(self, folder: Path, name: str) -> None:
        """Of a file that is there."""
        self.lines.append(f"{sha256(folder / name)}  {name}\n")


def write_capture(
    folder: Path,
    source: ShotSource,
    *,
    topics: JointTopics | None = None,
    progress: Callable[[int], None] | None = None,
) -> CaptureSummary:
    """Write all of `source` into the empty `folder`; the same input gives the same bytes.

    JPEG and PNG colour is kept byte for byte where its pixels are the frame's; depth becomes 16-bit PNG in the unit
    it was recorded in, or .npy [m] where no unit holds it. topics: the joint states as they were recorded, beside
    those of `source`, which are of one topic. Raises InputError when the source yields no frame.
    """
    sums, rows, joints = _Sums(), [], []
    cameras: dict[str, dict[str, Any]] = {}
    for item in source.shots():
        if isinstance(item, JointState):
            joints.append(item)
            continue
        rows.append(_write_shot(folder, item, cameras, sums))
        if progress is not None:
            progress(len(rows))
    if not rows:
        raise InputError(f"{source.name}: no frame could be read", remedy="see `splatctrl info`")
    sums.write(folder, "joints.npz", joints_file(joints, len(source.joint_names)))
    _write_frames(folder, rows, sums)
    header = {
        "format": FORMAT,
        "version": VERSION,
        "name": source.name,
        "world_frame": source.world_frame,
        "units": {"length": "m", "time": "ns", "angle": "rad"},
        "pose": "T_world_camera, optical frame (x right, y down, z forward), quaternion x y z w",
        "pixels": "pixel (0, 0) is centred at u = v = 0",
        "has_clock": source.has_clock,
        "cameras": cameras,
        "joint_names": list(source.joint_names),
        "sources": source.digests(),
        "loss": asdict(source.loss),
    }
    if topics is not None and topics.topics:
        header["joint_topics"] = write_topics(folder, topics, lambda name: sums.add(folder, name))
    write_json(folder / "capture.json", header)
    sums.add(folder, "capture.json")
    (folder / "SHA256SUMS").write_text("".join(sorted(sums.lines, key=lambda line: line[66:])), encoding="ascii")
    return CaptureSummary(
        num_frames={name: camera["num_frames"] for name, camera in cameras.items()},
        num_joint_states=len(joints),
        loss=source.loss,
    )


class CaptureSource:
    """Records of a capture folder; a file whose checksum differs is counted as damage and left out.

    joints: a robot's, to be brought together from the topics that the capture kept, as from those of the log itself;
    without them, or in a capture that kept none, the states are those of joints.npz.
    """

    def __init__(self, path: Path, options: SourceOptions, joints: Sequence[str] | None = None) -> None:
        options.refuse(_NOT_FOR_CAPTURES, "a capture", path)
        self._path = path
        self.name = path.name
        header = read_capture_header(path)
        self.world_frame = str(header["world_frame"])
        self.has_clock = bool(header["has_clock"])
        self.joint_names = tuple(header["joint_names"])
        self._cameras: dict[str, dict[str, Any]] = header["cameras"]
        self.cameras = tuple(self._cameras) if options.cameras is None else options.cameras
        for name in self.cameras:
            if name not in self._cameras:
                raise InputError(f"{path}: no camera {name!r}", remedy=f"use one of: {', '.join(self._cameras)}")
        self._sums = _read_sums(path)
        self._rows = [row for row in _read_frames(path) if row["camera"] in self.cameras]
        self._damaged: list[str] = []
        self._loss = LossReport(**header["loss"])
        described = header.get("joint_topics")
        self.joint_topics = None if described is None else read_topics(path, described, self._checked)
        self._joints: Sequence[JointState] = []
        if joints is None or self.joint_topics is None:
            options.refuse(("joint_topic",), "the states of one topic in a capture", path)
            self._joints = read_joints(path) if self.joint_names else []
        else:
            kept = self.joint_topics
            self.joint_names, self._joints, loss = joints_again(kept, options, joints)
            others = without_joints(self._loss, kept.loss, kept.first_note)
            self._loss = with_joints(others, loss, kept.first_note)

    @property
    def loss(self) -> LossReport:
        """What `ingest` could not take, and what has been damaged since."""
        loss = self._loss
        return replace(loss, damaged=loss.damaged + len(self._damaged), notes=[*loss.notes, *self._damaged])

    def records(self) -> Iterator[Record]:
        """Joint states and frames by stamp."""
        for item in self.shots():
            yield item.frame if isinstance(item, Shot) else item

    def shots(self) -> Iterator[Shot | JointState]:
        """Joint states and shots by stamp."""
        self._damaged = []
        return merged(self._joints, self._shots())

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Of every row of frames.csv."""
        return ((int(row["stamp_ns"]), row["camera"], _pose(row)) for row in self._rows)

    def digests(self) -> dict[str, str]:
        """sha256 of SHA256SUMS, which covers every file."""
        return {f"{self.name}/SHA256SUMS": sha256(self._path / "SHA256SUMS")}

    def _shots(self) -> Iterator[Shot]:
        for row in self._rows:
            color_bytes, depth_bytes = self._read(row["color"]), self._read(row["depth"])
            human_bytes = self._read(row["human"]) if row.get("human") else None
            if color_bytes is None or depth_bytes is None:
                continue
            camera = self._cameras[row["camera"]]
            bgr, depth = decode_file(color_bytes, color=True), _decode_depth(row["depth"], depth_bytes, camera)
            if bgr is None or depth is None:
                self._damaged.append(f"{row['color']}, {row['depth']}: cannot be decoded")
                continue
            intrinsics = Intrinsics(**{f.name: camera[f.name] for f in dataclasses.fields(Intrinsics)})
            yield Shot(
                frame=RgbdFrame(
                    stamp_ns=int(row["stamp_ns"]),
                    camera=row["camera"],
                    color=np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8),
                    depth=depth,
                    intrinsics=intrinsics,
                    T_world_camera=_pose(row),
                    human=None if human_bytes is None else self._human(row["human"], human_bytes, intrinsics),
                ),
                color_file=color_bytes,
                depth_unit=camera["depth_scale"] if row["depth"].endswith(".png") else None,
                origin=row["source"],
            )

    def _human(self, name: str, data: bytes, intrinsics: Intrinsics) -> UInt8 | None:
        pixels = decode_file(data, color=False)
        if pixels is None:
            self._damaged.append(f"{name}: cannot be decoded")
            return None
        return human_mask(pixels, intrinsics, str(self._path / name))

    def _read(self, name: str) -> bytes | None:
        path = self._path / name
        if not path.is_file():
            self._damaged.append(f"{name}: missing")
            return None
        data = path.read_bytes()
        if self._sums.get(name) != hashlib.sha256(data).hexdigest():
            self._damaged.append(f"{name}: its checksum differs from SHA256SUMS")
            return None
        return data

    def _checked(self, name: str) -> Path:
        """The path of a file that is as it was written. Raises InputError for another."""
        file = self._path / name
        if not file.is_file() or self._sums.get(name) != sha256(file):
            raise InputError(f"{file}: missing, or its checksum differs from SHA256SUMS", remedy=_AGAIN)
        return file


def _pose(row: dict[str, str]) -> Float64:
    values = [float(row[key]) for key in COLUMNS[4:11]]
    return transform_from(values[:3], values[3:])


def is_capture(path: Path) -> bool:
    """Whether a folder holds a capture."""
    return (path / "capture.json").is_file()


def read_capture_header(path: Path) -> dict[str, Any]:
    """capture.json. Raises InputError where it is not one of ours, or of a newer kind."""
    file = path / "capture.json"
    try:
        header = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"{file}: cannot be read: {error}", remedy="run `splatctrl ingest` again") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(f"{file}: not a splatctrl capture", remedy="expected what `splatctrl ingest` writes")
    if header.get("version") != VERSION:
        raise InputError(
            f"{file}: expected version {VERSION}, got {header.get('version')}", remedy="use a newer splatctrl"
        )
    for key in ("world_frame", "has_clock", "joint_names", "cameras", "loss", "sources", "name"):
        if key not in header:
            raise InputError(f"{file}: {key} is missing", remedy="run `splatctrl ingest` again")
    _check_index(path)
    return header


def _check_index(path: Path) -> None:
    """Raises InputError where an index file is not as it was written: nothing in it can be trusted then."""
    sums = _read_sums(path)
    for name in INDEX_FILES:
        if not (path / name).is_file():
            raise InputError(f"{path / name}: missing", remedy="run `splatctrl ingest` again")
        if sums.get(name) != sha256(path / name):
            raise InputError(
                f"{path / name}: its checksum differs from SHA256SUMS", remedy="run `splatctrl ingest` again"
            )


def _write_shot(folder: Path, shot: Shot, cameras: dict[str, dict[str, Any]], sums: _Sums) -> dict[str, str]:
    frame = shot.frame
    unit = FLOAT_DEPTH_UNIT if shot.depth_unit is None else shot.depth_unit
    camera = cameras.setdefault(frame.camera, {**asdict(frame.intrinsics), "depth_scale": unit, "num_frames": 0})
    if any(camera[name] != value for name, value in asdict(frame.intrinsics).items()):
        raise InputError(
            f"{shot.origin}: camera {frame.camera} changes its lens, and a capture holds one of each camera",
            remedy="leave --holdout to `reconstruct` and `score`",
        )
    stem = f"{camera['num_frames']:06d}"
    camera["num_frames"] += 1
    color = shot.color_file
    if color is None:
        color = _encoded(cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
    is_png = color.startswith(b"\x89PNG")
    color_name = f"color/{frame.camera}/{stem}.{'png' if is_png else 'jpg'}"
    sums.write(folder, color_name, color)
    counts = _counts(frame.depth, unit, is_exact=shot.depth_unit is not None)
    depth_name = f"depth/{frame.camera}/{stem}.{'npy' if counts is None else 'png'}"
    sums.write(folder, depth_name, _npy(frame.depth) if counts is None else _encoded(counts))
    T = frame.T_world_camera
    pose = [*T[:3, 3], *quat_from_rotation(T[:3, :3])]
    values = [frame.camera, frame.stamp_ns, color_name, depth_name, *(repr(float(v)) for v in pose), shot.origin]
    row = dict(zip(COLUMNS, map(str, values), strict=True))
    if frame.human is None:
        return row
    human_name = f"human/{frame.camera}/{stem}.png"
    sums.write(folder, human_name, _encoded(frame.human * np.uint8(255)))
    return row | {"human": human_name}


def _counts(depth: Float32, unit: float, *, is_exact: bool) -> np.ndarray[Any, np.dtype[np.uint16]] | None:
    """Depth as uint16 counts of `unit`; None where they would not give the depth back."""
    if depth.max(initial=0.0) / unit > 65535.5:
        return None
    counts = np.round(depth / np.float32(unit)).astype(np.uint16)
    error = np.abs(metres(counts, unit) - depth).max(initial=0.0)
    return counts if error <= (0.0 if is_exact else FLOAT_DEPTH_ERROR) else None


def _decode_depth(name: str, data: bytes, camera: dict[str, Any]) -> Float32 | None:
    if name.endswith(".npy"):
        return np.asarray(np.load(BytesIO(data), allow_pickle=False), dtype=np.float32)
    counts = decode_file(data, color=False)
    return None if counts is None else metres(counts, camera["depth_scale"])


def _encoded(pixels: np.ndarray[Any, Any]) -> bytes:
    is_written, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    if not is_written:
        raise WriteError(f"an image of shape {pixels.shape} could not be encoded as PNG")
    return bytes(data)


def _npy(depth: Float32) -> bytes:
    stream = BytesIO()
    np.save(stream, np.ascontiguousarray(depth, dtype="<f4"), allow_pickle=False)
    return stream.getvalue()


def _write_frames(folder: Path, rows: list[dict[str, str]], sums: _Sums) -> None:
    stream = StringIO()
    columns = MASKED_COLUMNS if any("human" in row for row in rows) else COLUMNS
    writer = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    sums.write(folder, "frames.csv", stream.getvalue().encode())


def _read_frames(path: Path) -> list[dict[str, str]]:
    file = path / "frames.csv"
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: cannot be read: {error}", remedy="run `splatctrl ingest` again") from None
    if tuple(reader.fieldnames or ()) not in (COLUMNS, MASKED_COLUMNS):
        raise InputError(f"{file}: expected columns {', '.join(COLUMNS)}", remedy="run `splatctrl ingest` again")
    try:
        for row in rows:
            int(row["stamp_ns"])
            [float(row[key]) for key in COLUMNS[4:11]]
    except (ValueError, TypeError) as error:
        raise InputError(f"{file}: {error}", remedy="run `splatctrl ingest` again") from None
    return rows


def _read_sums(path: Path) -> dict[str, str]:
    file = path / "SHA256SUMS"
    if not file.is_file():
        raise InputError(f"{file}: missing", remedy="the capture was not finished; run `splatctrl ingest` again")
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    return {line[66:]: line[:64] for line in lines}
