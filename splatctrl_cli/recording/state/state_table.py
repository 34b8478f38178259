"""Joint states in CSV, NPZ, HDF5, Parquet, by a TOML (docs/replay.md, Logs); libfranka's logs.

LeRobot datasets are a preset of [states]. Versions 2 and 3 (huggingface/lerobot, lerobot_dataset.py, utils.py) list
features in ``meta/info.json``. v2 has a ``data/chunk-000/episode_000000.parquet`` per episode, v3 a shared
``data/chunk-000/file-000.parquet`` with column ``episode_index``. ``observation.state`` is position, ``timestamp``
seconds from the episode's begin.
"""

import csv
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if, require
from splatctrl_cli.files.spilled_rows import BLOCK, RowFile, Rows, Table, absent, blocks_of, scaled
from splatctrl_cli.formats.arrays import ArrayFile, Hdf5File, NpzFile, ParquetFile
from splatctrl_cli.recording.folder.folder_description import read_table
from splatctrl_cli.recording.folder.layout import read_json
from splatctrl_cli.recording.folder.poses import stamp_of_text
from splatctrl_cli.recording.log.state_messages import NAMELESS, pose_of_columns, pose_of_quat, rigid_or_none
from splatctrl_cli.recording.log.state_track import RawTrack
from splatctrl_cli.records import Float64, Stamps


def _refuse_unreadable(path: Path) -> AbstractContextManager[None]:
    faults = (OSError, UnicodeDecodeError, csv.Error)
    return refuse_faults(f"{path}: cannot be read as CSV", *faults, remedy="check the file")


@dataclass(frozen=True, kw_only=True)
class CsvTable:
    """A CSV file: stripped column names, lines read in blocks."""

    path: Path
    names: list[str]

    def index(self, name: str | int) -> int:
        """Number of the first column so named; numbers are unchanged. Raises InputError."""
        if isinstance(name, int):
            return name
        refuse_if(
            name not in self.names,
            f"{self.path}: no column {name!r}",
            remedy=f"columns there: {', '.join(self.names)}",
        )
        return self.names.index(name)

    def read(
        self, time: str | int, unit_ns: int, groups: Mapping[str, Sequence[str | int]], epoch_ns: int = 0
    ) -> tuple[Stamps, dict[str, Rows]]:
        """Read stamps (T,) [ns] and each group's numbers (T, K), NaN for an empty cell.

        Times count `unit_ns`, every digit kept; columns are names or numbers. Raises InputError for a wrong cell
        (naming line and column), a line of another length, and no states.
        """
        chosen = {name: [self.index(column) for column in columns] for name, columns in groups.items()}
        at, stamps = self.index(time), array("q")
        files = {name: RowFile((len(columns),)) for name, columns in groups.items()}
        for rows in self._blocks():
            stamps.extend(self._stamp(row, number, at, unit_ns) + epoch_ns for number, row in rows.items())
            for name, columns in chosen.items():
                files[name].append(self._numbers(rows, columns))
        refuse_if(not stamps, f"{self.path}: expected joint states, got none", remedy="record them again")
        return np.array(stamps, dtype=np.int64), {name: Rows(file) for name, file in files.items()}

    def _blocks(self) -> Iterator[dict[int, list[str]]]:
        with self.path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            lines = ((reader.line_num, row) for row in reader if row)
            next(lines, None)
            while True:
                with _refuse_unreadable(self.path):
                    rows = dict(islice(lines, BLOCK))
                if not rows:
                    return
                for number, row in rows.items():
                    if len(row) != len(self.names):
                        raise InputError(
                            f"{self.path}:{number}: expected {len(self.names)} columns, got {len(row)}",
                            remedy="the file was cut there; leave the line out",
                        )
                yield rows

    def _numbers(self, rows: dict[int, list[str]], columns: Sequence[int]) -> Float64:
        values = np.empty((len(rows), len(columns)))
        for i, (number, row) in enumerate(rows.items()):
            for k, column in enumerate(columns):
                cell = row[column].strip()
                try:
                    values[i, k] = float(cell) if cell else np.nan
                except ValueError:
                    raise self._no_number(row, number, column) from None
        return values

    def _stamp(self, row: list[str], number: int, column: int, unit_ns: int) -> int:
        stamp_ns = stamp_of_text(row[column].strip(), unit_ns)
        if stamp_ns is None:
            raise self._no_number(row, number, column)
        return stamp_ns

    def _no_number(self, row: list[str], number: int, column: int) -> InputError:
        return InputError(
            f"{self.path}:{number}: column {self.names[column]}: expected a number, got {row[column]!r}",
            remedy="correct the line",
        )


def read_csv(path: Path) -> CsvTable:
    """Open a CSV. Raises InputError without states."""
    with _refuse_unreadable(path), path.open(newline="", encoding="utf-8-sig") as stream:
        lines = list(islice((line for line in csv.reader(stream) if line), 2))
    refuse_if(len(lines) < 2, f"{path}: expected joint states, got none", remedy="record them again")
    return CsvTable(path=path, names=[name.strip().lstrip("# ") for name in lines[0]])


def libfranka_track(table: CsvTable) -> RawTrack:
    """The states of a log by franka::logToCSV, joints named joint1 ... joint7.

    The first column counts milliseconds since power-on. Positions are ``q[0]`` to ``q[6]``, velocities ``dq[0]``...,
    prefixed with ``state.`` since libfranka 0.14. Commands are ``cmd.dq_d``, earlier the second of two ``dq_d``
    (libfranka, src/log.cpp, src/logging/robot_state_log.cpp). O_T_EE is the end effector's pose in column order.
    """
    refuse_if(
        table.names[0] not in {"time", "duration"} or _first(table, "q", 0) is None,
        f"{table.path}: expected libfranka's columns (time, q[0], ...), got {', '.join(table.names[:4])}, ...",
        remedy="describe the columns in a .toml and give that (splatctrl help replay, Logs)",
    )
    num = len(NAMELESS)
    position = require(
        _block(table, "q", num),
        f"{table.path}: expected columns q[0] to q[6], got fewer",
        remedy="describe the columns in a .toml (splatctrl help replay, Logs)",
    )
    sent, desired = _sent(table, num), _block(table, "dq_d", num)
    groups = {
        "position": position,
        "velocity": _block(table, "dq", num),
        "sent": sent,
        "desired": desired if desired != sent else None,
        "pose": _block(table, "O_T_EE", 16),
    }
    stamps, columns = table.read(0, 1_000_000, {name: of for name, of in groups.items() if of is not None})
    pose, velocity = columns.get("pose"), columns.get("velocity")
    has_sent = "sent" in columns and any(np.nan_to_num(rows).any() for rows in blocks_of(columns["sent"]))
    return RawTrack(
        where=table.path.name,
        names=NAMELESS,
        stamp_ns=stamps,
        position=columns["position"],
        velocity=absent(len(stamps), num) if velocity is None else velocity,
        commanded_velocity=columns["sent"] if has_sent else columns.get("sent" if desired == sent else "desired"),
        T_base_ee=None if pose is None else poses_of(pose, pose_of_columns),
    )


def poses_of(rows: Table, read: Callable[[Float64], Float64 | None]) -> Rows:
    """(T, 4, 4) of rows (T, K); NaN where `read` gives None."""
    nothing = np.full((4, 4), np.nan)
    blocks = (np.array([nothing if T is None else T for T in map(read, block)]) for block in blocks_of(rows))
    return Rows(RowFile((4, 4), blocks))


def _first(table: CsvTable, name: str, number: int) -> int | None:
    full = (f"state.{name}[{number}]", f"{name}[{number}]")
    return next((table.names.index(column) for column in full if column in table.names), None)


def _block(table: CsvTable, name: str, num: int) -> list[int] | None:
    columns = [column for i in range(num) if (column := _first(table, name, i)) is not None]
    return columns if len(columns) == num else None


def _sent(table: CsvTable, num: int) -> list[int] | None:
    sent = [table.names.index(n) for i in range(num) if (n := f"cmd.dq_d[{i}]") in table.names]
    if not sent:
        sent = [
            len(table.names) - 1 - table.names[::-1].index(n)
            for i in range(num)
            if table.names.count(n := f"dq_d[{i}]") == 2
        ]
    return sent if len(sent) == num else None


INFO, POSITION, EPISODE = Path("meta/info.json"), "observation.state", "episode_index"


def lerobot_preset(folder: Path, episode: int | None) -> Mapping[str, Any]:
    """The [states] keys of an episode (None: the only one). Raises InputError."""
    info = read_json(folder / INFO)
    with refuse_faults(
        lambda error: f"{folder / INFO}: expected total_episodes and the feature {POSITION}, got no usable {error}",
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        remedy="describe the columns in a .toml (splatctrl help replay, Logs)",
    ):
        feature, num = info["features"][POSITION], int(info["total_episodes"])
        size, feature_names = int(feature["shape"][0]), feature.get("names")
        lists = (
            feature_names.values() if isinstance(feature_names, dict) else [feature_names or []]
        )  # by kind, as {"motors": [...]}
        names = [
            str(name).removesuffix(".pos") for names in lists for name in names
        ]  # shoulder_pan.pos is shoulder_pan
    refuse_if(
        episode is None and num != 1,
        f"{folder}: {num} episodes",
        remedy="choose one in a .toml: [states] preset, file, episode",
    )
    return {
        "time": "timestamp",
        "position": [POSITION],
        "episode": episode or 0,
        **({"joints": names} if len(names) == size else {}),
        "file": str(_file(folder, episode or 0).absolute()),
    }


def _file(folder: Path, episode: int) -> Path:
    files = sorted((folder / "data").glob("*/*.parquet"))
    of_one = [file for file in files if file.stem == f"episode_{episode:06d}"]
    shared = (file for file in files if file.stem.startswith("file") and len(ParquetFile(file, (EPISODE, episode))))
    path, remedy = next(iter(of_one), None) or next(shared, None), "copy the whole dataset, or give another episode"
    return require(path, f"{folder}: no episode {episode}", remedy=remedy)


UNITS = {"rad": 1.0, "deg": float(np.pi / 180.0)}
TIME_UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
ARRAY_FILES: Mapping[str, type[ArrayFile]] = {
    ".npz": NpzFile,
    **dict.fromkeys([".h5", ".hdf5"], Hdf5File),
    ".parquet": ParquetFile,
}
PRESETS: Mapping[str, Callable[[Path, int | None], Mapping[str, Any]]] = {"lerobot": lerobot_preset}
_SEE = "see splatctrl help replay, Logs"


@dataclass(frozen=True, kw_only=True)
class StatesTable:
    """``[states]``: a file and its columns; an array (T, K) gives K columns.

    epoch_ns: Unix time of time 0. pose: x, y, z, qx, qy, qz, qw, or a matrix's 16 numbers by pose_order. preset: one
    of `PRESETS`, which fills missing keys for the dataset `file`. episode: that of the dataset.
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


def read_described_track(path: Path) -> tuple[RawTrack, Path]:
    """Read states by a TOML, and their file. Raises InputError naming key or column."""
    table = read_table(
        StatesTable, path, "states", others=("twists",), fill=lambda content: fill_preset(path, content)
    )
    choices: Mapping[str, tuple[str, ...]] = {
        "unit": tuple(UNITS),
        "time_unit": tuple(TIME_UNITS_NS),
        "pose_frame": ("base", "world"),
        "pose_order": ("rows", "columns"),
    }
    for key, allowed in choices.items():
        refuse_if(
            getattr(table, key) not in allowed,
            f"{path}: states.{key}: expected one of {', '.join(allowed)}, got {getattr(table, key)!r}",
            remedy=_SEE,
        )
    refuse_if(
        not table.joints or len(set(table.joints)) < len(table.joints),
        f"{path}: states.joints: expected names, each once, got {table.joints}",
        remedy=_SEE,
    )
    if table.preset and table.episode is not None:
        return _track(table, ParquetFile(Path(table.file), (EPISODE, table.episode)), path), Path(table.file)
    return _track(table, columns_of(path, "states", table.file), path), path.parent / table.file


def dataset_track(folder: Path) -> tuple[RawTrack, Path]:
    """A LeRobot dataset's only episode, and its file. Raises InputError."""
    preset = dict(lerobot_preset(folder, None))
    refuse_if(
        "joints" not in preset,
        f"{folder / INFO}: {POSITION} has no name for each joint",
        remedy="give a .toml: [states] preset, file, joints (splatctrl help replay, Logs)",
    )
    file = Path(preset["file"])
    return _track(StatesTable(**preset), ParquetFile(file, (EPISODE, preset["episode"])), folder), file


def fill_preset(path: Path, keys: Mapping[str, Any]) -> Mapping[str, Any]:
    """Fill [states] of TOML file `path` by its preset."""
    name = keys.get("preset", "")
    if not name:
        return keys
    refuse_if(
        name not in PRESETS, f"{path}: states.preset: expected one of {', '.join(PRESETS)}, got {name!r}", remedy=_SEE
    )
    preset = PRESETS[name](path.parent / str(keys.get("file", ".")), keys.get("episode"))
    return {**preset, **keys, "file": preset["file"]}


def columns_of(path: Path, table: str, name: str) -> CsvTable | ArrayFile:
    """Columns of the file that a TOML's table names. Raises InputError."""
    file = path.parent / name
    refuse_if(
        not file.is_file(), f"{path}: {table}.file: {file}: no such file", remedy="give it relative to the .toml"
    )
    kind = ARRAY_FILES.get(file.suffix.lower())
    return read_csv(file) if kind is None else kind(file)


def _track(table: StatesTable, columns: CsvTable | ArrayFile, path: Path) -> RawTrack:
    factor, num = UNITS[table.unit], len(table.joints)
    groups = {"position": table.position, "velocity": table.velocity}
    groups |= {"commanded_velocity": table.commanded_velocity, "pose": table.pose}
    stamps, values = columns.read(
        table.time,
        TIME_UNITS_NS[table.time_unit],
        {key: names for key, names in groups.items() if names or key == "position"},
        table.epoch_ns,
    )
    for key, block in values.items():
        refuse_if(
            key != "pose" and block.shape != (len(stamps), num),
            f"{path}: states.{key}: expected {num} columns of {len(stamps)} states, got {block.shape[::-1]}",
            remedy="one column per joint",
        )
    position, velocity = scaled(values["position"], factor), values.get("velocity")
    commanded = values.get("commanded_velocity")
    poses = _poses(table, values.get("pose"), path, len(stamps))
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
    refuse_if(
        rows.shape[1] not in {7, 16} or len(rows) != num_states,
        f"{path}: states.pose: expected 7 or 16 columns of {num_states} states, got {rows.shape[::-1]}",
        remedy=_SEE,
    )
    if rows.shape[1] == 7:
        return poses_of(rows, lambda row: pose_of_quat(row[:3], row[3:]))
    if table.pose_order == "columns":
        return poses_of(rows, pose_of_columns)
    return poses_of(rows, lambda row: rigid_or_none(row.reshape(4, 4)))
