"""Joint states in a CSV or NPZ file whose columns a TOML file describes (docs/replay.md, Logs)."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.folder_description import read_table
from splatctrl_cli.io.state_csv import CsvTable, poses_of, read_csv
from splatctrl_cli.io.state_messages import pose_of_columns, pose_of_quat, rigid_or_none
from splatctrl_cli.io.state_track import RawTrack
from splatctrl_cli.io.state_velocity import Stamps
from splatctrl_cli.records import Float64

UNITS = {"rad": 1.0, "deg": float(np.pi / 180.0)}
TIME_UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
POSE_FRAMES = ("base", "world")
POSE_ORDERS = ("rows", "columns")
_SEE = "see docs/replay.md, Logs"


@dataclass(frozen=True, kw_only=True)
class StatesTable:
    """``[states]``: a file and its columns; in an NPZ file, arrays (T, K) give K columns each.

    epoch_ns: the Unix time of time 0; pose: x, y, z, qx, qy, qz, qw, or the 16 numbers of a matrix by pose_order.
    """

    file: str
    joints: list[str]
    time: str
    position: list[str]
    velocity: list[str] = field(default_factory=list)
    commanded_velocity: list[str] = field(default_factory=list)
    pose: list[str] = field(default_factory=list)
    unit: str = "rad"
    time_unit: str = "s"
    epoch_ns: int = 0
    pose_frame: str = "base"
    pose_order: str = "rows"


def described_track(path: Path) -> tuple[RawTrack, Path]:
    """The states that a TOML file describes, and the file that holds them.

    Raises InputError, naming the key or column.
    """
    table = read_table(StatesTable, path, "states")
    choices: Mapping[str, tuple[str, ...]] = {
        "unit": tuple(UNITS),
        "time_unit": tuple(TIME_UNITS_NS),
        "pose_frame": POSE_FRAMES,
        "pose_order": POSE_ORDERS,
    }
    for key, allowed in choices.items():
        if getattr(table, key) not in allowed:
            raise InputError(
                f"{path}: states.{key}: expected one of {', '.join(allowed)}, got {getattr(table, key)!r}",
                remedy=_SEE,
            )
    if not table.joints or len(set(table.joints)) < len(table.joints):
        raise InputError(f"{path}: states.joints: expected names, each once, got {table.joints}", remedy=_SEE)
    file = path.parent / table.file
    if not file.is_file():
        raise InputError(f"{path}: states.file: {file}: no such file", remedy="give it relative to the .toml")
    columns: _Columns = _NpzColumns(file) if file.suffix == ".npz" else _CsvColumns(read_csv(file))
    return _track(table, columns, path), file


def _track(table: StatesTable, columns: "_Columns", path: Path) -> RawTrack:
    position = columns.numbers(table.position)
    factor, num = UNITS[table.unit], len(table.joints)
    stamps = columns.stamps(table.time, TIME_UNITS_NS[table.time_unit], table.epoch_ns)
    blocks: dict[str, Float64 | None] = {"position": position}
    for key in ("velocity", "commanded_velocity"):
        names = getattr(table, key)
        blocks[key] = columns.numbers(names) if names else None
    for key, block in blocks.items():
        if block is not None and block.shape != (len(stamps), num):
            raise InputError(
                f"{path}: states.{key}: expected {num} columns of {len(stamps)} states, got {block.shape[::-1]}",
                remedy="one column per joint",
            )
    velocity, commanded = blocks["velocity"], blocks["commanded_velocity"]
    poses = _poses(table, columns, path, len(stamps))
    return RawTrack(
        where=Path(table.file).name,
        names=tuple(table.joints),
        stamp_ns=stamps,
        position=position * factor,
        velocity=np.full_like(position, np.nan) if velocity is None else velocity * factor,
        commanded_velocity=None if commanded is None else commanded * factor,
        T_base_ee=poses if table.pose_frame == "base" else None,
        T_world_ee=poses if table.pose_frame == "world" else None,
    )


def _poses(table: StatesTable, columns: "_Columns", path: Path, num_states: int) -> Float64 | None:
    if not table.pose:
        return None
    rows = columns.numbers(table.pose)
    if rows.shape[1] not in {7, 16} or len(rows) != num_states:
        raise InputError(
            f"{path}: states.pose: expected 7 or 16 columns of {num_states} states, got {rows.shape[::-1]}",
            remedy=_SEE,
        )
    if rows.shape[1] == 7:
        return poses_of(rows, lambda row: pose_of_quat(row[:3], row[3:]))
    if table.pose_order == "columns":
        return poses_of(rows, pose_of_columns)
    return poses_of(rows, lambda row: rigid_or_none(row.reshape(4, 4)))


class _CsvColumns:
    def __init__(self, table: CsvTable) -> None:
        self._table = table

    def numbers(self, names: list[str]) -> Float64:
        return self._table.numbers([self._table.index(name) for name in names])

    def stamps(self, name: str, unit_ns: int, epoch_ns: int) -> Stamps:
        return self._table.stamps(self._table.index(name), unit_ns, epoch_ns)


class _NpzColumns:
    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with np.load(path, allow_pickle=False) as content:
                self._arrays: dict[str, NDArray[Any]] = {name: content[name] for name in content.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: cannot be read as NPZ: {error}", remedy="check the file") from None

    def numbers(self, names: list[str]) -> Float64:
        blocks = [self._array(name).astype(np.float64) for name in names]
        if len({len(block) for block in blocks}) > 1:
            lengths = ", ".join(f"{name} {len(block)}" for name, block in zip(names, blocks, strict=True))
            raise InputError(f"{self._path}: expected arrays of one length, got {lengths}", remedy="check the file")
        return np.hstack([block.reshape(len(block), -1) for block in blocks])

    def stamps(self, name: str, unit_ns: int, epoch_ns: int) -> Stamps:
        times = self._array(name).reshape(-1)
        if times.dtype.kind in "iu":
            return np.asarray(times.astype(np.int64) * unit_ns + epoch_ns)
        if not np.isfinite(times).all():
            raise InputError(f"{self._path}: {name}: expected times, got NaN or infinity", remedy="check the file")
        whole = np.floor(times)
        parts = np.round((times - whole) * unit_ns).astype(np.int64)
        return np.asarray(whole.astype(np.int64) * unit_ns + parts + epoch_ns)

    def _array(self, name: str) -> NDArray[Any]:
        array = self._arrays.get(name)
        if array is None or array.dtype.kind not in "iuf" or array.ndim == 0 or not len(array):
            raise InputError(
                f"{self._path}: {name!r}: expected an array of numbers, got "
                f"{'none' if array is None else f'{array.dtype} of shape {array.shape}'}",
                remedy=f"arrays there: {', '.join(self._arrays)}",
            )
        return array


_Columns = _CsvColumns | _NpzColumns
