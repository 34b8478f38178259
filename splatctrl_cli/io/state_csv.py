"""Numbers of a CSV file by column, and the logs that libfranka writes."""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.state_messages import NAMELESS, pose_of_columns
from splatctrl_cli.io.state_track import RawTrack
from splatctrl_cli.io.state_velocity import Stamps
from splatctrl_cli.records import Float64

_MILLISECOND_NS = 1_000_000
_DESCRIBE = "describe the columns in a .toml (docs/replay.md, Logs)"


@dataclass(frozen=True, kw_only=True)
class CsvTable:
    """A CSV file: the column names of its first line, stripped, and its other lines as text."""

    path: Path
    names: list[str]
    rows: list[list[str]]

    def index(self, name: str) -> int:
        """The first column of that name. Raises InputError."""
        if name not in self.names:
            raise InputError(f"{self.path}: no column {name!r}", remedy=f"columns there: {', '.join(self.names)}")
        return self.names.index(name)

    def numbers(self, columns: list[int]) -> Float64:
        """(T, len(columns)) float64, NaN for an empty cell. Raises InputError naming line and column."""
        values = np.empty((len(self.rows), len(columns)))
        for i, row in enumerate(self.rows):
            for k, column in enumerate(columns):
                cell = row[column].strip()
                try:
                    values[i, k] = float(cell) if cell else np.nan
                except ValueError:
                    raise self._no_number(i, column) from None
        return values

    def stamps(self, column: int, unit_ns: int, epoch_ns: int = 0) -> Stamps:
        """Stamps (T,) [ns] of a column of times in units of `unit_ns`, every digit kept."""
        stamps = []
        for i, row in enumerate(self.rows):
            try:
                stamps.append(round(Decimal(row[column].strip()) * unit_ns) + epoch_ns)
            except (InvalidOperation, ValueError, OverflowError):
                raise self._no_number(i, column) from None
        return np.array(stamps, dtype=np.int64)

    def _no_number(self, row: int, column: int) -> InputError:
        return InputError(
            f"{self.path}:{row + 2}: column {self.names[column]}: expected a number, got {self.rows[row][column]!r}",
            remedy="correct the line",
        )


def read_csv(path: Path) -> CsvTable:
    """Raises InputError for a file without states, or with a line of another length than the first."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [line for line in csv.reader(stream) if line]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV: {error}", remedy="check the file") from None
    if len(lines) < 2:
        raise InputError(f"{path}: expected joint states, got none", remedy="record them again")
    names, rows = [name.strip().lstrip("# ") for name in lines[0]], lines[1:]
    for number, row in enumerate(rows, start=2):
        if len(row) != len(names):
            raise InputError(
                f"{path}:{number}: expected {len(names)} columns, got {len(row)}",
                remedy="the file was cut there; leave the line out",
            )
    return CsvTable(path=path, names=names, rows=rows)


def is_libfranka(table: CsvTable) -> bool:
    """Whether the columns are those of franka::logToCSV."""
    return table.names[0] in {"time", "duration"} and _first(table, "q", 0) is not None


def libfranka_track(table: CsvTable) -> RawTrack:
    """The states of a log by franka::logToCSV, joints named joint1 ... joint7.

    Its first column counts milliseconds since the robot was switched on. Measured positions are ``q[0]`` to ``q[6]``,
    velocities ``dq[0]``..., since libfranka 0.14 with ``state.`` before them; what the control loop asked for is
    ``cmd.dq_d``, before that the second columns named ``dq_d`` (libfranka, src/log.cpp and
    src/logging/robot_state_log.cpp). Where a program added O_T_EE it is the end effector's pose, column by column.
    """
    num = len(NAMELESS)
    position = _block(table, "q", num)
    if position is None:
        raise InputError(f"{table.path}: expected columns q[0] to q[6], got fewer", remedy=_DESCRIBE)
    velocity, commanded, pose = _block(table, "dq", num), _commanded(table, num), _block(table, "O_T_EE", 16)
    return RawTrack(
        where=table.path.name,
        names=NAMELESS,
        stamp_ns=table.stamps(0, _MILLISECOND_NS),
        position=position,
        velocity=np.full_like(position, np.nan) if velocity is None else velocity,
        commanded_velocity=commanded,
        T_base_ee=None if pose is None else poses_of(pose, pose_of_columns),
    )


def poses_of(rows: Float64, read: Callable[[Float64], Float64 | None]) -> Float64:
    """(T, 4, 4) of rows (T, K) by a function of one row, NaN where that gives None."""
    poses = [read(row) for row in rows]
    return np.array([np.full((4, 4), np.nan) if T is None else T for T in poses])


def _first(table: CsvTable, name: str, number: int) -> int | None:
    for full in (f"state.{name}[{number}]", f"{name}[{number}]"):
        if full in table.names:
            return table.names.index(full)
    return None


def _block(table: CsvTable, name: str, num: int) -> Float64 | None:
    columns = [column for i in range(num) if (column := _first(table, name, i)) is not None]
    return table.numbers(columns) if len(columns) == num else None


def _commanded(table: CsvTable, num: int) -> Float64 | None:
    """The command of velocities where one was sent, else the desired velocities of the state."""
    sent = [table.names.index(n) for i in range(num) if (n := f"cmd.dq_d[{i}]") in table.names]
    if not sent:
        sent = [_last(table.names, n) for i in range(num) if table.names.count(n := f"dq_d[{i}]") == 2]
    if len(sent) == num:
        values = table.numbers(sent)
        if np.nan_to_num(values).any():
            return values
    return _block(table, "dq_d", num)


def _last(names: list[str], name: str) -> int:
    return len(names) - 1 - names[::-1].index(name)
