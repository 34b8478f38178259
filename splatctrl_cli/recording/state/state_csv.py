"""CSV numbers by column, and libfranka's logs."""

import csv
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.spilled_rows import BLOCK, RowFile, Rows, Table, absent, blocks_of
from splatctrl_cli.recording.folder.poses import stamp_of_text
from splatctrl_cli.recording.log.state_messages import NAMELESS, pose_of_columns
from splatctrl_cli.recording.log.state_track import RawTrack
from splatctrl_cli.records import Float64, Stamps

_DESCRIBE = "describe the columns in a .toml (splatctrl help replay, Logs)"


@dataclass(frozen=True, kw_only=True)
class CsvTable:
    """A CSV file: stripped column names, lines read in blocks."""

    path: Path
    names: list[str]

    def index(self, name: str | int) -> int:
        """The first column so named; a number is unchanged. Raises InputError."""
        if isinstance(name, int):
            return name
        if name not in self.names:
            raise InputError(f"{self.path}: no column {name!r}", remedy=f"columns there: {', '.join(self.names)}")
        return self.names.index(name)

    def read(
        self, time: str | int, unit_ns: int, groups: Mapping[str, Sequence[str | int]], epoch_ns: int = 0
    ) -> tuple[Stamps, dict[str, Rows]]:
        """Read stamps (T,) [ns] and each group's numbers (T, K), NaN for an empty cell.

        Times are in `unit_ns`, every digit kept; columns are names or numbers. Raises InputError naming line and
        column, for a line of another length, and without states.
        """
        chosen = {name: [self.index(column) for column in columns] for name, columns in groups.items()}
        at, stamps = self.index(time), array("q")
        files = {name: RowFile((len(columns),)) for name, columns in groups.items()}
        for number, rows in self._blocks():
            stamps.extend(self._stamp(row, number + i, at, unit_ns) + epoch_ns for i, row in enumerate(rows))
            for name, columns in chosen.items():
                files[name].append(self._numbers(rows, number, columns))
        if not stamps:
            raise InputError(f"{self.path}: expected joint states, got none", remedy="record them again")
        return np.array(stamps, dtype=np.int64), {name: Rows(file) for name, file in files.items()}

    def _blocks(self) -> Iterator[tuple[int, list[list[str]]]]:
        """Yield a first line's number and rows; empty lines do not count."""
        with self.path.open(newline="", encoding="utf-8-sig") as stream:
            lines = (line for line in csv.reader(stream) if line)
            next(lines, None)
            number, num = 2, len(self.names)
            while True:
                try:
                    rows = list(islice(lines, BLOCK))
                except (OSError, UnicodeDecodeError, csv.Error) as error:
                    raise _unreadable(self.path, error) from None
                if not rows:
                    return
                for i, row in enumerate(rows):
                    if len(row) != num:
                        raise InputError(
                            f"{self.path}:{number + i}: expected {num} columns, got {len(row)}",
                            remedy="the file was cut there; leave the line out",
                        )
                yield number, rows
                number += len(rows)

    def _numbers(self, rows: list[list[str]], number: int, columns: Sequence[int]) -> Float64:
        values = np.empty((len(rows), len(columns)))
        for i, row in enumerate(rows):
            for k, column in enumerate(columns):
                cell = row[column].strip()
                try:
                    values[i, k] = float(cell) if cell else np.nan
                except ValueError:
                    raise self._no_number(row, number + i, column) from None
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
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = list(islice((line for line in csv.reader(stream) if line), 2))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise _unreadable(path, error) from None
    if len(lines) < 2:
        raise InputError(f"{path}: expected joint states, got none", remedy="record them again")
    return CsvTable(path=path, names=[name.strip().lstrip("# ") for name in lines[0]])


def _unreadable(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: cannot be read as CSV: {error}", remedy="check the file")


def is_libfranka(table: CsvTable) -> bool:
    """True for the columns of franka::logToCSV."""
    return table.names[0] in {"time", "duration"} and _first(table, "q", 0) is not None


def libfranka_track(table: CsvTable) -> RawTrack:
    """The states of a log by franka::logToCSV, joints named joint1 ... joint7.

    The first column counts milliseconds since power-on. Positions are ``q[0]`` to ``q[6]``, velocities ``dq[0]``...,
    prefixed with ``state.`` since libfranka 0.14. Commands are ``cmd.dq_d``, earlier the second columns ``dq_d``
    (libfranka, src/log.cpp and src/logging/robot_state_log.cpp). An added O_T_EE is the end effector's pose by
    columns.
    """
    num = len(NAMELESS)
    position = _block(table, "q", num)
    if position is None:
        raise InputError(f"{table.path}: expected columns q[0] to q[6], got fewer", remedy=_DESCRIBE)
    sent, desired = _sent(table, num), _block(table, "dq_d", num)
    wanted = {
        "position": position,
        "velocity": _block(table, "dq", num),
        "sent": sent,
        "desired": desired if desired != sent else None,
        "pose": _block(table, "O_T_EE", 16),
    }
    stamps, found = table.read(0, 1_000_000, {name: of for name, of in wanted.items() if of is not None})
    pose, velocity = found.get("pose"), found.get("velocity")
    has_sent = "sent" in found and any(np.nan_to_num(rows).any() for rows in blocks_of(found["sent"]))
    return RawTrack(
        where=table.path.name,
        names=NAMELESS,
        stamp_ns=stamps,
        position=found["position"],
        velocity=absent(len(stamps), num) if velocity is None else velocity,
        commanded_velocity=found["sent"] if has_sent else found.get("sent" if desired == sent else "desired"),
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
        sent = [_last(table.names, n) for i in range(num) if table.names.count(n := f"dq_d[{i}]") == 2]
    return sent if len(sent) == num else None


def _last(names: list[str], name: str) -> int:
    return len(names) - 1 - names[::-1].index(name)
