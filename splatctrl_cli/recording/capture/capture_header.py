"""A capture's index: capture.json, frames.csv and SHA256SUMS, in some fifty bytes of memory a file."""

import csv
import hashlib
import json
import math
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import fields
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import sha256
from splatctrl_cli.recording.log.stored_frame import AGAIN
from splatctrl_cli.records import LossReport

FORMAT, VERSION = "splatctrl-capture", 1
INDEX_FILES = ("capture.json", "frames.csv", "joints.npz")


def check_header(file: Path, header: Mapping[str, Any]) -> None:
    """Raise InputError naming the first missing or wrong entry."""
    for name, is_right, expected in _ENTRIES:
        if name not in header:
            raise InputError(f"{file}: {name} is missing", remedy=AGAIN)
        if not is_right(header[name]):
            raise InputError(f"{file}: {name}: expected {expected}", remedy=AGAIN)


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
)


def is_capture(path: Path) -> bool:
    """True for a capture folder."""
    return (path / "capture.json").is_file()


def read_capture_header(path: Path) -> dict[str, Any]:
    """Read capture.json. Raises InputError if not ours, or of another version."""
    file = path / "capture.json"
    try:
        header = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"{file}: cannot be read: {error}", remedy=AGAIN) from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(f"{file}: not a splatctrl capture", remedy="expected what `splatctrl ingest` writes")
    if header.get("version") != VERSION:
        raise InputError(
            f"{file}: expected version {VERSION}, got {header.get('version')}", remedy="use a newer splatctrl"
        )
    check_header(file, header)
    _check_index(path)
    return header


def _check_index(path: Path) -> None:
    sums = FileSums(path)
    for name in INDEX_FILES:
        if not (path / name).is_file():
            raise InputError(f"{path / name}: missing", remedy=AGAIN)
        if sums.get(name) != sha256(path / name):
            raise InputError(f"{path / name}: its checksum differs from SHA256SUMS", remedy=AGAIN)


SUMS = "SHA256SUMS"
COLUMNS = ("camera", "stamp_ns", "color", "depth", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "source")
MASKS = ("human", "valid")  # further columns, where the recording has such masks
ROBOT = "robot_description.urdf"  # the URDF that the log itself brings, where it does
_FURTHER = ((), *((mask,) for mask in MASKS), MASKS)  # columns of frames.csv after COLUMNS
_MOST_ROW = 1 << 16  # bytes of a row
_UNREADABLE = (OSError, UnicodeDecodeError, csv.Error, ValueError, TypeError)


class FrameRows:
    """Some cameras' rows of frames.csv, in order, read again at each iteration."""

    def __init__(self, file: Path, cameras: Collection[str]) -> None:
        """Raises InputError for an invalid row, or a file outside the capture."""
        self._file, self._cameras = file, cameras
        try:
            self._num = sum(1 for _ in self._read())
        except _UNREADABLE as error:
            raise InputError(f"{file}: cannot be read: {error}", remedy=AGAIN) from None

    def __iter__(self) -> Iterator[Mapping[str, str]]:
        """Raises InputError if the file has changed."""
        num, changed = 0, InputError(f"{self._file}: changed while it was read", remedy="try again")
        try:
            for row in self._read():
                num += 1
                yield row
        except _UNREADABLE:
            raise changed from None
        if num != self._num:
            raise changed

    def _read(self) -> Iterator[Mapping[str, str]]:
        with self._file.open("rb") as stream:
            lines = iter(lambda: stream.readline(_MOST_ROW), b"")
            rows = csv.reader((line.decode("utf-8") for line in lines), strict=True)
            names = tuple(next(rows, ()))
            if names[: len(COLUMNS)] != COLUMNS or names[len(COLUMNS) :] not in _FURTHER:
                raise InputError(f"{self._file}: expected columns {', '.join(COLUMNS)}", remedy=AGAIN)
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
        if path.is_absolute() or ".." in path.parts:
            raise ValueError(f"{name} lies outside the capture")
    return row


class FileSums:
    """SHA256SUMS: checksums by file name."""

    def __init__(self, folder: Path) -> None:
        """Raises InputError without the file."""
        file = folder / SUMS
        if not file.is_file():
            raise InputError(f"{file}: missing", remedy=f"the capture was not finished; {AGAIN}")
        keys, sums = array("Q"), bytearray()
        with file.open("rb") as stream:
            while line := stream.readline(_MOST_ROW):
                try:
                    digest = bytes.fromhex(line[:64].decode("ascii"))
                except ValueError:  # UnicodeDecodeError among them
                    continue
                if len(digest) == 32:
                    keys.append(_key(line[66:].rstrip(b"\r\n")))
                    sums += digest
        order = np.argsort(np.frombuffer(keys, dtype=np.uint64), kind="stable")
        self._keys = np.frombuffer(keys, dtype=np.uint64)[order]
        self._sums = np.frombuffer(sums, dtype=np.uint8).reshape(-1, 32)[order]

    def get(self, name: str) -> str | None:
        """Hexadecimal sha256 of a name's last line, or None."""
        at = int(np.searchsorted(self._keys, np.uint64(_key(name.encode())), side="right")) - 1
        if at < 0 or int(self._keys[at]) != _key(name.encode()):
            return None
        return bytes(self._sums[at]).hex()


def _key(name: bytes) -> int:
    """64 bits of a name; a collision would make a good file look damaged."""
    return int.from_bytes(hashlib.blake2b(name, digest_size=8).digest(), "little")
