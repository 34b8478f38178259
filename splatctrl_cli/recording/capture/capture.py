"""``X.capture/``: a plain folder of images, poses and joints (docs/capture.md)."""

import csv
import hashlib
import json
import math
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.files.output import sha256
from splatctrl_cli.formats.arrays import DAMAGE, NpzFile, npy_of
from splatctrl_cli.formats.image_file import decode_file
from splatctrl_cli.geometry import invert_transform, transform_from
from splatctrl_cli.recording.log.messages import metres
from splatctrl_cli.recording.log.state_columns import NO_STATES, StateColumns
from splatctrl_cli.recording.log.state_topics import joint_records
from splatctrl_cli.recording.log.stored_frame import (
    AGAIN,
    FrameSource,
    StoredFrame,
    human_mask,
    merge_joints,
    read_topics,
)
from splatctrl_cli.recording.log.survey import Survey
from splatctrl_cli.recording.source_options import CALIBRATION, PERTURB, SourceOptions, refuse_unknown_cameras
from splatctrl_cli.records import Bool, Float32, Float64, Intrinsics, LossReport, UInt8

FORMAT, VERSION = "splatctrl-capture", 1


def check_header(file: Path, header: Mapping[str, Any]) -> None:
    """Raise InputError naming the first missing or wrong entry."""
    for name, is_right, expected in _ENTRIES:
        refuse_if(name not in header, f"{file}: {name} is missing", remedy=AGAIN)
        refuse_if(not is_right(header[name]), f"{file}: {name}: expected {expected}", remedy=AGAIN)


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are_names(value: object) -> bool:
    return isinstance(value, list) and all(map(_is_text, value))


def _is_camera(value: object) -> bool:
    if not isinstance(value, dict):
        return False
    sides = [value.get(name) for name in ("width", "height")]
    scale = value.get("depth_scale")
    return (
        all(isinstance(side, int) and 0 < side <= 65_536 for side in sides)
        and all(_is_number(value.get(name)) for name in ("fx", "fy", "cx", "cy"))
        and min(value["fx"], value["fy"]) > 0
        and (scale is None or (_is_number(scale) and scale > 0))
    )


def _is_loss(value: object) -> bool:
    counts = {field.name for field in fields(LossReport)} - {"notes"}
    return isinstance(value, dict) and all(
        _are_names(entry) if name == "notes" else name in counts and isinstance(entry, int)
        for name, entry in value.items()
    )


def _are_poses(value: object) -> bool:
    """True for rigid T_world_frame (4, 4), or None, by name."""
    if not isinstance(value, dict):
        return False
    try:
        poses = [np.array(entry, np.float64) for entry in value.values() if entry is not None]
    except (TypeError, ValueError):
        return False
    return all(T.shape == (4, 4) and np.allclose(T @ invert_transform(T), np.eye(4), atol=1e-6) for T in poses)


_ENTRIES: tuple[tuple[str, Callable[[object], bool], str], ...] = (
    ("world_frame", _is_text, "a name"),
    ("has_clock", lambda value: isinstance(value, bool), "true or false"),
    ("joint_names", _are_names, "a list of names"),
    (
        "cameras",
        lambda value: isinstance(value, dict) and all(map(_is_camera, value.values())),
        "by name width, height, fx, fy, cx, cy and depth_scale of each",
    ),
    ("loss", _is_loss, "counts by name, and notes"),
    ("sources", lambda value: isinstance(value, dict), "sha256 by name"),
    ("name", _is_text, "a name"),
    ("tf_frames", _are_poses, "a 4x4 matrix or null by name"),
)


def is_capture(path: Path) -> bool:
    return (path / "capture.json").is_file()


def read_capture_header(path: Path) -> dict[str, Any]:
    """Read capture.json. Raises InputError if damaged, of another program or another version."""
    file = path / "capture.json"
    with refuse_faults(f"{file}: cannot be read", ValueError, OSError, remedy=AGAIN):
        header: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    refuse_if(
        not isinstance(header, dict) or header.get("format") != FORMAT,
        f"{file}: not a splatctrl capture",
        remedy="expected what `splatctrl ingest` writes",
    )
    refuse_if(
        header.get("version") != VERSION,
        f"{file}: expected version {VERSION}, got {header.get('version')}",
        remedy="use a newer splatctrl",
    )
    header = {"tf_frames": {}, **header}  # missing in those of other programs
    check_header(file, header)
    sums = FileSums(path)
    for name in ("capture.json", "frames.csv", "joints.npz"):
        refuse_if(not (path / name).is_file(), f"{path / name}: missing", remedy=AGAIN)
        refuse_if(
            sums.get(name) != sha256(path / name),
            f"{path / name}: its checksum differs from SHA256SUMS",
            remedy=AGAIN,
        )
    return header


SUMS = "SHA256SUMS"
COLUMNS = ("camera", "stamp_ns", "color", "depth", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "source")
MASKS = ("human", "valid")  # further columns, where the recording has such masks
ROBOT = "robot_description.urdf"  # the URDF that the log itself brings, where it does
_MOST_ROW = 1 << 16  # bytes of a row
_UNREADABLE = (OSError, UnicodeDecodeError, csv.Error, ValueError, TypeError)


class FrameRows:
    """Some cameras' rows of frames.csv, read again at each iteration."""

    def __init__(self, file: Path, cameras: Collection[str]) -> None:
        """Raises InputError for an invalid row, or a file outside the capture."""
        self._file, self._cameras = file, cameras
        with refuse_faults(f"{file}: cannot be read", *_UNREADABLE, remedy=AGAIN):
            self._num = sum(1 for _ in self._read())

    def __iter__(self) -> Iterator[Mapping[str, str]]:
        """Raises InputError if the file has changed."""
        num = 0
        with suppress(*_UNREADABLE):
            for row in self._read():
                num += 1
                yield row
            if num == self._num:
                return
        raise InputError(f"{self._file}: changed while it was read", remedy="try again")

    def _read(self) -> Iterator[Mapping[str, str]]:
        with self._file.open("rb") as stream:
            lines = iter(lambda: stream.readline(_MOST_ROW), b"")
            rows = csv.reader((line.decode("utf-8") for line in lines), strict=True)
            names = tuple(next(rows, ()))
            refuse_if(
                names[: len(COLUMNS)] != COLUMNS or names[len(COLUMNS) :] not in ((), *zip(MASKS), MASKS),
                f"{self._file}: expected columns {', '.join(COLUMNS)}",
                remedy=AGAIN,
            )
            for values in filter(None, rows):
                row = _checked(dict(zip(names, values, strict=True)))
                if row["camera"] in self._cameras:
                    yield row


def _checked(row: Mapping[str, str]) -> Mapping[str, str]:
    int(row["stamp_ns"])
    for key in COLUMNS[4:11]:
        float(row[key])
    for name in (row["color"], row["depth"], *(row.get(mask) or "" for mask in MASKS)):
        path = PurePosixPath(name)
        refuse_if(path.is_absolute() or ".." in path.parts, f"{name} lies outside the capture", error=ValueError)
    return row


class FileSums:
    """SHA256SUMS: checksums by file name."""

    def __init__(self, folder: Path) -> None:
        """Raises InputError without the file."""
        file = folder / SUMS
        refuse_if(not file.is_file(), f"{file}: missing", remedy=f"the capture was not finished; {AGAIN}")
        keys, sums = array("Q"), bytearray()
        with file.open("rb") as stream:
            while line := stream.readline(_MOST_ROW):
                with suppress(ValueError):  # UnicodeDecodeError among them
                    digest = bytes.fromhex(line[:64].decode("ascii"))
                    if len(digest) == 32:
                        keys.append(_key(line[66:].rstrip(b"\r\n")))
                        sums += digest
        order = np.argsort(np.frombuffer(keys, dtype=np.uint64), kind="stable")
        self._keys = np.frombuffer(keys, dtype=np.uint64)[order]
        self._sums = np.frombuffer(sums, dtype=np.uint8).reshape(-1, 32)[order]

    def get(self, name: str) -> str | None:
        """Hexadecimal sha256 of a name's last line, or None."""
        at = int(np.searchsorted(self._keys, np.uint64(_key(name.encode())), side="right")) - 1
        return None if at < 0 or int(self._keys[at]) != _key(name.encode()) else bytes(self._sums[at]).hex()


def _key(name: bytes) -> int:
    return int.from_bytes(hashlib.blake2b(name, digest_size=8).digest(), "little")


NEEDED = ("stamp_ns", "position", "velocity")
OPTIONAL = ("commanded_velocity", "T_base_ee", "T_world_ee")  # NaN where a state has none, absent where none has one
_NOT_FOR_CAPTURES = (
    *("world_frame", "camera_topics", "camera_poses", "human_topics", "intrinsics"),
    *("camera_pose_topics", "depth_scale", "root", "holdout", "stamps"),
)


class CaptureSource(FrameSource):
    """Records of a capture; files with a wrong checksum are damage.

    joints: a robot's, merged from the capture's joint topics. Without either, states are those of joints.npz.
    """

    def __init__(self, path: Path, options: SourceOptions, joints: Sequence[str] | None = None) -> None:
        options.refuse(_NOT_FOR_CAPTURES, "a capture", path)
        self._path = path
        self.name = path.name
        header = read_capture_header(path)
        self.world_frame = str(header["world_frame"])
        self.tf_frames = {name: None if T is None else np.array(T) for name, T in header["tf_frames"].items()}
        self.has_clock = bool(header["has_clock"])
        self.made_of = frozenset(header["sources"].values())  # sha256
        applied = (CALIBRATION, PERTURB)
        self._applied = {name: value for name, value in header["sources"].items() if name.startswith(applied)}
        self.joint_names = tuple(header["joint_names"])
        self._cameras: dict[str, dict[str, Any]] = header["cameras"]
        self.cameras = tuple(self._cameras) if options.cameras is None else options.cameras
        refuse_unknown_cameras(path, self.cameras, self._cameras)
        self._sums = FileSums(path)
        self._rows = FrameRows(path / "frames.csv", self.cameras)
        self._damaged: list[str] = []  # of the last pass
        self._damaged_before: list[str] = []  # of the earlier pass with most, as the last may end early
        self._loss = LossReport(**header["loss"])
        described = header.get("joint_topics")
        self.joint_topics = None if described is None else read_topics(path, described, self._checked)
        if joints is None or self.joint_topics is None:
            options.refuse(("joint_topic",), "the states of one topic in a capture", path)
            self.states = _read_joints(path) if self.joint_names else NO_STATES
        else:
            topics, loss = self.joint_topics, LossReport()
            survey = Survey(topics={topic.topic.name: topic for topic in topics.topics})
            chosen = options if options.joint_topic is not None else replace(options, joint_topic=topics.chosen)
            self.joint_names, self.states = joint_records(survey, chosen, loss, joints)
            self._loss = merge_joints(
                merge_joints(self._loss, topics.loss, topics.first_note, sign=-1), loss, topics.first_note
            )

    @property
    def loss(self) -> LossReport:
        loss = self._loss
        damaged = max(self._damaged, self._damaged_before, key=len)
        return replace(loss, damaged=loss.damaged + len(damaged), notes=[*loss.notes, *damaged])

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        return ((int(row["stamp_ns"]), row["camera"], _pose(row)) for row in self._rows)

    def digests(self) -> dict[str, str]:
        """sha256 of SHA256SUMS, which covers every file, and the applied changes."""
        return {f"{self.name}/SHA256SUMS": sha256(self._path / "SHA256SUMS"), **self._applied}

    def _frames(self) -> Iterator[StoredFrame]:
        self._damaged, self._damaged_before = [], max(self._damaged, self._damaged_before, key=len)
        yield from filter(None, map(self._stored_frame, self._rows))

    def _stored_frame(self, row: Mapping[str, str]) -> StoredFrame | None:
        color_bytes, depth_bytes = self._read(row["color"]), self._read(row["depth"])
        human_bytes = self._read(row["human"]) if row.get("human") else None
        camera = self._cameras[row["camera"]]
        valid = self._valid(row["valid"], camera) if row.get("valid") else None
        if color_bytes is None or depth_bytes is None or (row.get("valid") and valid is None):
            return None
        color, depth = decode_file(color_bytes, color=True), _decode_depth(row["depth"], depth_bytes, camera)
        if color is None or depth is None:
            self._damaged.append(f"{row['color']}, {row['depth']}: cannot be decoded")
            return None
        if not color.shape[:2] == depth.shape == (camera["height"], camera["width"]):
            size = f"{camera['width']}x{camera['height']}"
            self._damaged.append(f"{row['color']}, {row['depth']}: expected images of {size} as capture.json says")
            return None
        intrinsics = Intrinsics(**{f.name: camera[f.name] for f in fields(Intrinsics)})
        return StoredFrame(
            stamp_ns=int(row["stamp_ns"]),
            camera=row["camera"],
            intrinsics=intrinsics,
            T_world_camera=_pose(row),
            read_color=lambda: color,
            read_depth=lambda: depth,
            human=None if human_bytes is None else self._human(row["human"], human_bytes, intrinsics),
            valid=valid,
            color_file=color_bytes,
            depth_unit=camera["depth_scale"] if row["depth"].endswith(".png") else None,
            origin=row["source"],
        )

    def _valid(self, name: str, camera: Mapping[str, Any]) -> Bool | None:
        data = self._read(name)
        pixels = None if data is None else decode_file(data, color=False)
        if data is not None and (pixels is None or pixels.shape != (camera["height"], camera["width"])):
            self._damaged.append(f"{name}: not a mask of the images' size")
            return None
        return None if pixels is None else np.asarray(pixels > 0)

    def _human(self, name: str, data: bytes, intrinsics: Intrinsics) -> UInt8 | None:
        pixels = decode_file(data, color=False)
        if pixels is None:
            self._damaged.append(f"{name}: cannot be decoded")
            return None
        return human_mask(pixels, intrinsics, str(self._path / name))

    def _read(self, name: str) -> bytes | None:
        path = self._path / name
        data = path.read_bytes() if path.is_file() else None
        if data is not None and self._sums.get(name) == hashlib.sha256(data).hexdigest():
            return data
        fault = "missing" if data is None else "its checksum differs from SHA256SUMS"
        self._damaged.append(f"{name}: {fault}")
        return None

    def _checked(self, name: str) -> Path:
        file = self._path / name
        refuse_if(
            Path(name).is_absolute() or ".." in Path(name).parts, f"{file}: lies outside the capture", remedy=AGAIN
        )
        refuse_if(
            not file.is_file() or self._sums.get(name) != sha256(file),
            f"{file}: missing, or its checksum differs from SHA256SUMS",
            remedy=AGAIN,
        )
        return file


def read_robot_description(path: Path) -> list[tuple[str, str]]:
    """Name and text of a capture's URDF, if any. Raises InputError if changed."""
    file = path / ROBOT
    if not file.is_file():
        return []
    refuse_if(
        FileSums(path).get(ROBOT) != sha256(file), f"{file}: its checksum differs from SHA256SUMS", remedy=AGAIN
    )
    return [(ROBOT, file.read_bytes().decode("utf-8"))]


def _pose(row: Mapping[str, str]) -> Float64:
    values = [float(row[key]) for key in COLUMNS[4:11]]
    return transform_from(values[:3], values[3:])


def _decode_depth(name: str, data: bytes, camera: dict[str, Any]) -> Float32 | None:
    if name.endswith(".npy"):
        try:
            return np.asarray(npy_of(data), dtype=np.float32)
        except DAMAGE:
            return None
    counts, scale = decode_file(data, color=False), camera.get("depth_scale")
    return None if counts is None or scale is None else metres(counts, scale)


def _read_joints(path: Path) -> StateColumns:
    file = path / "joints.npz"
    with refuse_faults(lambda error: str(error.message), InputError, remedy=AGAIN):
        content = NpzFile(file)
        stamps = content.stamps("stamp_ns", 1, 0, least=0)
        rows = {name: content.rows(name) for name in (*NEEDED[1:], *OPTIONAL) if name in (*NEEDED, *content.names)}
    refuse_if(
        any(len(values) != len(stamps) for values in rows.values()),
        f"{file}: expected {len(stamps)} states in every array, got "
        + ", ".join(f"{name} {len(values)}" for name, values in rows.items()),
        remedy=AGAIN,
    )
    return StateColumns(stamp_ns=stamps, **rows)
