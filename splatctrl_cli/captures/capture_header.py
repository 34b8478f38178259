"""capture.json: whether a folder is a capture, and what it has to say for the rest to be read by it."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from splatctrl_cli.captures.capture_index import FileSums
from splatctrl_cli.captures.capture_writer import FORMAT, VERSION
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import sha256
from splatctrl_cli.logs.joint_topics import AGAIN
from splatctrl_cli.records import LossReport

INDEX_FILES = ("capture.json", "frames.csv", "joints.npz")


def check_header(file: Path, header: Mapping[str, Any]) -> None:
    """Raise InputError naming the first entry that is missing or of another kind."""
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


def _are_cameras(value: object) -> bool:
    return isinstance(value, dict) and all(map(_is_camera, value.values()))


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
    ("cameras", _are_cameras, "by name width, height, fx, fy, cx, cy and depth_scale of each"),
    ("loss", _is_loss, "counts by name, and notes"),
    ("sources", lambda value: isinstance(value, dict), "sha256 by name"),
    ("name", _is_text, "a name"),
)


def is_capture(path: Path) -> bool:
    """Whether a folder holds a capture."""
    return (path / "capture.json").is_file()


def read_capture_header(path: Path) -> dict[str, Any]:
    """capture.json. Raises InputError where it is not one of ours, or of a newer kind."""
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
    """Raises InputError where an index file is not as it was written: nothing in it can be trusted then."""
    sums = FileSums(path)
    for name in INDEX_FILES:
        if not (path / name).is_file():
            raise InputError(f"{path / name}: missing", remedy=AGAIN)
        if sums.get(name) != sha256(path / name):
            raise InputError(f"{path / name}: its checksum differs from SHA256SUMS", remedy=AGAIN)
