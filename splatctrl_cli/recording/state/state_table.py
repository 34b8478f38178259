"""Joint states in CSV, NPZ, HDF5 or Parquet, described in TOML (docs/replay.md, Logs)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.spilled_rows import Rows, absent, scaled
from splatctrl_cli.formats.arrays import ArrayFile, Hdf5File, NpzFile, ParquetFile
from splatctrl_cli.recording.folder.folder_description import read_table
from splatctrl_cli.recording.log.state_messages import pose_of_columns, pose_of_quat, rigid_or_none
from splatctrl_cli.recording.log.state_track import RawTrack
from splatctrl_cli.recording.state import lerobot
from splatctrl_cli.recording.state.state_csv import CsvTable, poses_of, read_csv

UNITS = {"rad": 1.0, "deg": float(np.pi / 180.0)}
TIME_UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
POSE_FRAMES = ("base", "world")
POSE_ORDERS = ("rows", "columns")
ARRAY_FILES: Mapping[str, type[ArrayFile]] = {
    ".npz": NpzFile,
    **dict.fromkeys([".h5", ".hdf5"], Hdf5File),
    ".parquet": ParquetFile,
}
PRESETS: Mapping[str, Callable[[Path, int | None], Mapping[str, Any]]] = {"lerobot": lerobot.preset}
_SEE = "see splatctrl help replay, Logs"


@dataclass(frozen=True, kw_only=True)
class StatesTable:
    """``[states]``: a file and its columns; an array (T, K) gives K columns.

    epoch_ns: Unix time of time 0. pose: x, y, z, qx, qy, qz, qw, or a matrix's 16 numbers by pose_order. preset: one
    of `PRESETS`, which fills missing keys for the dataset `file`; episode: of it.
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
    preset: str = ""
    episode: int | None = None


def described_track(path: Path) -> tuple[RawTrack, Path]:
    """Read described states, and their file. Raises InputError naming key or column."""
    table = read_table(StatesTable, path, "states", beside=("twists",), fill=lambda given: with_preset(path, given))
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
    if table.preset and table.episode is not None:
        return _of_episode(table, table.episode, path)
    return _track(table, columns_of(path, "states", table.file), path), path.parent / table.file


def dataset_track(folder: Path) -> tuple[RawTrack, Path]:
    """A LeRobot dataset's only episode, and its file. Raises InputError."""
    found = dict(lerobot.preset(folder, None))
    if "joints" not in found:
        raise InputError(
            f"{folder / lerobot.INFO}: {lerobot.POSITION} has no name for each joint",
            remedy="give a .toml: [states] preset, file, joints (splatctrl help replay, Logs)",
        )
    return _of_episode(StatesTable(**found), found["episode"], folder)


def _of_episode(table: StatesTable, episode: int, path: Path) -> tuple[RawTrack, Path]:
    file = Path(table.file)
    return _track(table, ParquetFile(file, (lerobot.EPISODE, episode)), path), file


def with_preset(path: Path, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Fill [states] of TOML file `path` by its preset."""
    name = given.get("preset", "")
    if not name:
        return given
    if name not in PRESETS:
        raise InputError(f"{path}: states.preset: expected one of {', '.join(PRESETS)}, got {name!r}", remedy=_SEE)
    found = PRESETS[name](path.parent / str(given.get("file", ".")), given.get("episode"))
    return {**found, **given, "file": found["file"]}


def columns_of(path: Path, table: str, name: str) -> CsvTable | ArrayFile:
    """Columns that a table of TOML file `path` names. Raises InputError."""
    file = path.parent / name
    if not file.is_file():
        raise InputError(f"{path}: {table}.file: {file}: no such file", remedy="give it relative to the .toml")
    kind = ARRAY_FILES.get(file.suffix.lower())
    return read_csv(file) if kind is None else kind(file)


def _track(table: StatesTable, columns: CsvTable | ArrayFile, path: Path) -> RawTrack:
    factor, num = UNITS[table.unit], len(table.joints)
    wanted = {"position": table.position, "velocity": table.velocity}
    wanted |= {"commanded_velocity": table.commanded_velocity, "pose": table.pose}
    stamps, found = columns.read(
        table.time,
        TIME_UNITS_NS[table.time_unit],
        {key: names for key, names in wanted.items() if names or key == "position"},
        table.epoch_ns,
    )
    for key, block in found.items():
        if key != "pose" and block.shape != (len(stamps), num):
            raise InputError(
                f"{path}: states.{key}: expected {num} columns of {len(stamps)} states, got {block.shape[::-1]}",
                remedy="one column per joint",
            )
    position, velocity = scaled(found["position"], factor), found.get("velocity")
    commanded = found.get("commanded_velocity")
    poses = _poses(table, found.get("pose"), path, len(stamps))
    return RawTrack(
        where=Path(table.file).name,
        names=tuple(table.joints),
        stamp_ns=stamps,
        position=position,
        velocity=absent(len(stamps), num) if velocity is None else scaled(velocity, factor),
        commanded_velocity=None if commanded is None else scaled(commanded, factor),
        T_base_ee=poses if table.pose_frame == "base" else None,
        T_world_ee=poses if table.pose_frame == "world" else None,
    )


def _poses(table: StatesTable, rows: Rows | None, path: Path, num_states: int) -> Rows | None:
    if rows is None:
        return None
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
