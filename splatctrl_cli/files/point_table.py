"""Points in a CSV file: x, y and z in metres, a block of rows at a time."""

import csv
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from typing import TextIO

import numpy as np

from splatctrl_cli.config.ranges import MAX_PLACE
from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Float64

AXES = ("x", "y", "z")
POINTS_PER_BLOCK = 1 << 15

_Line = tuple[int, list[str]]


def point_blocks(stream: TextIO, name: str) -> Iterator[Float64]:
    """Points (Q, 3) float64 [m], at most `POINTS_PER_BLOCK` at a time, of the columns x, y, z of a CSV text.

    Without a header, which is a first line that is not all numbers, there are to be three columns. Other columns are
    not looked at, empty lines are skipped. Raises InputError naming `name`, the line and the column: for columns that
    are missing, a line of another length than the first, and what is no finite number within `MAX_PLACE`.
    """
    reader = csv.reader(stream)
    lines: Iterator[_Line] = ((reader.line_num, row) for row in reader if row)
    try:
        first = next(lines, None)
        if first is None:
            raise InputError(f"{name}: has no points", remedy="give a CSV file with the columns x,y,z [m]")
        columns, rest = _columns(name, first[1]), lines
        if columns is None:
            columns, rest = [0, 1, 2], chain([first], lines)
        num_points = 0
        while block := list(islice(rest, POINTS_PER_BLOCK)):
            yield _numbers(name, block, columns, len(first[1]))
            num_points += len(block)
    except csv.Error as error:
        raise InputError(f"{name}: line {reader.line_num}: no CSV text: {error}", remedy="correct the line") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: no UTF-8 text: {error}", remedy="give a CSV file") from None
    if not num_points:
        raise InputError(f"{name}: has a header and no points", remedy="add a line for each point")


def _columns(name: str, cells: Sequence[str]) -> list[int] | None:
    """Where x, y and z stand by a header; None for a first line that is a point."""
    if len(cells) == 3 and all(_number(cell) is not None for cell in cells):
        return None
    titles = [cell.strip().lstrip("\ufeff").lower() for cell in cells]
    for axis in AXES:
        if titles.count(axis) != 1:
            what = "no column" if axis not in titles else "several columns"
            raise InputError(
                f"{name}: {what} {axis}: expected a header with x, y and z, or three numbers a line, got"
                f" {','.join(cells)[:60]!r}",
                remedy="name the columns x,y,z; they are in metres",
            )
    return [titles.index(axis) for axis in AXES]


def _numbers(name: str, block: Sequence[_Line], columns: Sequence[int], num_columns: int) -> Float64:
    i, j, k = columns
    try:
        points = np.array([(float(row[i]), float(row[j]), float(row[k])) for _, row in block])
    except (ValueError, IndexError):
        raise _first_wrong(name, block, columns, num_columns) from None
    if any(len(row) != num_columns for _, row in block) or not (np.abs(points) <= MAX_PLACE).all():
        raise _first_wrong(name, block, columns, num_columns)
    return points


def _first_wrong(name: str, block: Sequence[_Line], columns: Sequence[int], num_columns: int) -> InputError:
    """What is wrong with the first line of a block that has something wrong."""
    for number, row in block:
        if len(row) != num_columns:
            return InputError(
                f"{name}: line {number}: expected {num_columns} columns, got {len(row)}", remedy="correct the line"
            )
        for axis, column in zip(AXES, columns, strict=True):
            value = _number(row[column])
            if value is None or not abs(value) <= MAX_PLACE:
                return InputError(
                    f"{name}: line {number}: column {axis}: expected a finite number up to {MAX_PLACE:g} m, got"
                    f" {row[column].strip()[:40]!r}",
                    remedy="correct the line, or leave it out",
                )
    raise AssertionError("expected a line that is wrong")


def _number(cell: str) -> float | None:
    try:
        return float(cell.lstrip("\ufeff"))
    except ValueError:
        return None
