"""Camera poses from text and JSON, as T_world_camera of optical cameras (z forward)."""

import json
import re
from collections.abc import Callable, Iterator, Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import POSE_TOLERANCE_NS
from splatctrl_cli.config.ranges import MAX_PLACE
from splatctrl_cli.errors import refuse_faults, refuse_if
from splatctrl_cli.geometry import invert_transform, pose_at, quat_from_rotation, transform_from
from splatctrl_cli.recording.log.registration import TfTree
from splatctrl_cli.records import Float64

FORMATS = ("matrix-blocks", "matrix-lines", "trajectory-log", "tum", "nerfstudio", "matrix-files")
CONVENTIONS = ("camera_to_world", "world_to_camera")
AXES = ("opencv", "opengl", "left-handed")
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])  # y up, in the camera and in the world (ICL-NUIM)
OPENGL_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])
_MOST_NS = 1 << 62
_MSVC_NAN = re.compile(r"[+-]?1\.#(INF|IND|QNAN|SNAN)\d*")  # how Windows writes NaN and infinity (12-Scenes)
MAX_SKEW = 1e-3  # largest entry of R^T R - I that is rounding of a text file
_CORRECT = "correct the file, or [poses] where a .toml names it"


def world_camera(matrix: Float64, convention: str, axes: str, where: str) -> Float64:
    """T_world_camera (4, 4), optical, of a file's matrix. Raises InputError if not rigid."""
    T = rigid(matrix, where)
    T = invert_transform(T) if convention == "world_to_camera" else T
    T = T @ OPENGL_FROM_OPTICAL if axes == "opengl" else T
    return MIRROR @ T @ MIRROR if axes == "left-handed" else T


def rigid(matrix: Float64, where: str) -> Float64:
    """Replace a matrix's (4, 4) rotation by the nearest one, against rounding in text.

    Raises InputError for scale, shear, mirror or NaN.
    """
    is_finite = matrix.shape == (4, 4) and bool((np.abs(matrix) < MAX_PLACE).all())
    refuse_if(
        not is_finite or np.abs(matrix[:3, :3].T @ matrix[:3, :3] - np.eye(3)).max() > MAX_SKEW,
        f"{where}: expected a rigid transform (4x4), got one with scale, shear or NaN",
        remedy="correct the matrix",
    )
    U, _, Vt = np.linalg.svd(matrix[:3, :3])
    refuse_if(
        np.linalg.det(U @ Vt) < 0, f"{where}: expected a rotation, got a mirror image", remedy="check [poses] axes"
    )
    return pose_at(matrix[:3, 3], U @ Vt)


def read_matrix_blocks(path: Path, heading: str) -> dict[str, Float64]:
    """4x4 blocks under ``# heading ... NUMBER`` lines, by number."""
    poses: dict[str, Float64] = {}
    lines = _lines(path)
    for index, line in enumerate(lines):
        number = re.search(r"(\d+)\s*$", line)
        if line.startswith("#") and heading in line and number:
            poses[str(int(number[1]))] = _matrix(lines[index + 1 : index + 5], f"{path}:{index + 2}")
    return poses


def read_trajectory_log(path: Path) -> dict[str, Float64]:
    """Open3D's .log: three numbers, first the frame's, then a 4x4 matrix."""
    poses: dict[str, Float64] = {}
    lines = [line for line in _lines(path) if line]
    for index in range(0, len(lines), 5):
        where = f"{path}: pose {index // 5}"
        head = lines[index].split()
        refuse_if(
            len(head) != 3 or not head[0].isdigit(),
            f"{where}: expected three integers, got {lines[index]!r}",
            remedy=_CORRECT,
        )
        poses[str(int(head[0]))] = _matrix(lines[index + 1 : index + 5], where)
    return poses


def tum_rows(path: Path) -> dict[str, Float64 | None]:
    """Read ``stamp tx ty tz qx qy qz qw`` by stamp [s]; None for NaN."""
    poses: dict[str, Float64 | None] = {}
    for where, words, values in read_rows(path):
        is_lost = len(values) == 8 and np.isfinite(values[0]) and np.isnan(values[1:]).any()
        is_pose = len(values) == 8 and bool((np.abs(values[1:]) < MAX_PLACE).all()) and any(values[4:])
        refuse_if(
            not is_lost and not is_pose,
            f"{where}: expected 'stamp tx ty tz qx qy qz qw', got {' '.join(words)!r}",
            remedy=_CORRECT,
        )
        poses[words[0]] = None if is_lost else transform_from(values[1:4], values[4:8])
    return poses


def read_matrix_lines(path: Path) -> dict[str, Float64]:
    """A 4x4 or 3x4 (KITTI) matrix per line, by number from 0."""
    poses: dict[str, Float64] = {}
    for where, _, values in read_rows(path):
        refuse_if(
            len(values) not in {12, 16},
            f"{where}: expected the 16 or 12 numbers of a matrix, got {len(values)}",
            remedy=_CORRECT,
        )
        poses[str(len(poses))] = np.array([*values, 0.0, 0.0, 0.0, 1.0][:16]).reshape(4, 4)
    return poses


def read_rows(path: Path) -> Iterator[tuple[str, list[str], list[float]]]:
    """Yield place, words and numbers of lines that are neither empty nor comments."""
    for index, line in enumerate(_lines(path)):
        if line and not line.startswith("#"):
            words, where = line.split(), f"{path}:{index + 1}"
            yield where, words, _numbers(words, where)


def read_nerfstudio(path: Path) -> tuple[dict[str, Any], dict[str, Float64]]:
    """A transforms.json, and its matrices by file_path."""
    with refuse_faults(f"{path}: not a transforms.json", ValueError, KeyError, TypeError, remedy=_CORRECT):
        content = json.loads(path.read_text(encoding="utf-8"))
        matrices = {str(f["file_path"]): np.array(f["transform_matrix"], dtype=np.float64) for f in content["frames"]}
    for name, matrix in matrices.items():
        refuse_if(
            matrix.shape != (4, 4), f"{path}: {name}: expected a 4x4 matrix, got {matrix.shape}", remedy=_CORRECT
        )
    return content, matrices


def read_matrix_file(path: Path) -> Float64:
    """A text file's only 4x4 matrix."""
    return _matrix([line for line in _lines(path) if line and not line.startswith("#")][:4], str(path))


def read_numbers(path: Path) -> list[float]:
    return [value for line in _lines(path) if not line.startswith("#") for value in _numbers(line.split(), str(path))]


def trajectory(poses: Mapping[str, Float64 | None]) -> Callable[[int], Float64 | None]:
    """Function from stamp [ns] to a camera's T_world_camera (4, 4), None where unknown.

    It interpolates `poses`, by stamp [s, as text].
    """
    tree, known, lost = TfTree(), list[int](), list[int]()
    for text, T in poses.items():
        stamp_ns = stamp_of_text(text)
        if stamp_ns is not None:
            (lost if T is None else known).append(stamp_ns)
        if stamp_ns is not None and T is not None:
            tree.add("world", "camera", stamp_ns, T[:3, 3], quat_from_rotation(T[:3, :3]), static=False)
    known_ns, lost_ns = np.array(sorted(known), dtype=np.int64), np.array(sorted(lost), dtype=np.int64)

    def pose_at_stamp(stamp_ns: int) -> Float64 | None:
        after = np.searchsorted(known_ns, stamp_ns)
        is_known = after < len(known_ns) and known_ns[after] == stamp_ns
        before = known_ns[after : after + 1] if is_known else known_ns[max(after - 1, 0) : after]
        first, last = (part[0] if len(part) else stamp_ns for part in (before, known_ns[after : after + 1]))
        is_lost = ((lost_ns >= first) & (lost_ns <= last)).any()
        return None if is_lost else tree.lookup("world", "camera", stamp_ns, POSE_TOLERANCE_NS)

    return pose_at_stamp


def stamp_of_text(text: str, unit_ns: int = 1_000_000_000) -> int | None:
    """Nearest nanosecond of a time in units of `unit_ns`; None if no time."""
    try:
        stamp_ns = Decimal(text) * unit_ns
        return round(stamp_ns) if abs(stamp_ns) < _MOST_NS else None  # rounding 1e999 writes out its digits
    except (InvalidOperation, ValueError, OverflowError):
        return None


READERS: dict[str, Callable[[Path], dict[str, Float64]]] = {
    "matrix-lines": read_matrix_lines,
    "trajectory-log": read_trajectory_log,
    "tum": lambda path: {stamp: T for stamp, T in tum_rows(path).items() if T is not None},
    "nerfstudio": lambda path: read_nerfstudio(path)[1],
}


def _lines(path: Path) -> list[str]:
    with (
        refuse_faults(lambda error: f"{path}: {error.strerror}", OSError, remedy="check [poses] file and root"),
        refuse_faults(lambda _: f"{path}: not a text file", UnicodeDecodeError, remedy="check [poses] file"),
    ):
        return [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]


def _matrix(lines: list[str], where: str) -> Float64:
    rows = [_numbers(line.split(), where) for line in lines]
    refuse_if(
        len(rows) != 4 or any(len(row) != 4 for row in rows), f"{where}: expected a 4x4 matrix", remedy=_CORRECT
    )
    return np.array(rows)


def _numbers(words: list[str], where: str) -> list[float]:
    with refuse_faults(lambda _: f"{where}: expected numbers, got {' '.join(words)!r}", ValueError, remedy=_CORRECT):
        return [np.nan if _MSVC_NAN.fullmatch(word) else float(word) for word in words]
