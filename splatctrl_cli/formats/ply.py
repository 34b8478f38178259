"""PLY elements as tables, if the file is complete; points in PLY or CSV."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from splatctrl_cli.config.ranges import MAX_PLACE
from splatctrl_cli.errors import InputError, UsageError, refuse_faults, refuse_if, require
from splatctrl_cli.formats.unpacking import read_bytes
from splatctrl_cli.records import Array, Float64, PointCloud

SCALARS = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
NAMES_OF_SCALARS = {"f4": "float", "u1": "uchar"}
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True, kw_only=True)
class PlyFile:
    """An element's rows, a structured array, and the header's comments."""

    path: Path
    rows: Array
    comments: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> tuple[str, ...]:
        return self.rows.dtype.names or ()

    def pairs(self) -> dict[str, str]:
        """``key: value`` comments; a value may be empty."""
        parts = (line.partition(":") for line in self.comments)
        return {key.strip(): value.strip() for key, _, value in parts if key.strip()}

    def column(self, name: str) -> Float64:
        """A property as (N,) float64. Raises InputError naming the first non-finite index."""
        values = self.rows[name].astype(np.float64)
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            raise InputError(
                f"{self.path}: splat {bad[0]}: {name}: expected a finite number, got {values[bad[0]]} "
                f"({len(bad)} of {len(self)} are not finite)"
            )
        return values


@dataclass(frozen=True, kw_only=True)
class _Element:
    """properties: names and scalar types; a list has types of length and values, space between."""

    name: str
    count: int
    properties: list[tuple[str, str]]

    def dtype(self, path: Path, byte_order: str) -> "np.dtype[Any]":
        """The row's type; float text becomes float64 to keep its digits."""
        refuse_if(
            any(" " in kind for _, kind in self.properties),
            f"{path}: element {self.name} has list properties: expected a table of numbers",
        )
        types = [(name, SCALARS[kind]) for name, kind in self.properties]
        return np.dtype(
            [(name, "f8" if (byte_order, kind) == ("=", "f4") else byte_order + kind) for name, kind in types]
        )

    def end(self, content: bytes, offset: int, byte_order: str) -> int:
        """End of the element at `offset`, perhaps beyond `content`."""
        kinds = [[np.dtype(byte_order + SCALARS[word]) for word in kind.split()] for _, kind in self.properties]
        if not any(" " in kind for _, kind in self.properties):
            return offset + self.count * sum(kind.itemsize for (kind,) in kinds)
        for _ in range(self.count):
            for kind, *values in kinds:
                if offset + kind.itemsize > len(content):
                    return offset + kind.itemsize
                num = max(0, int(np.frombuffer(content, kind, 1, offset)[0])) if values else 0
                offset += kind.itemsize + sum(num * value.itemsize for value in values)
        return offset


def read_table(path: Path, element: str, required: tuple[str, ...]) -> PlyFile:
    """Read an element of a PLY (ASCII or binary, either byte order).

    Raises InputError if missing, no PLY, of another length, compressed, or without a `required` property.
    """
    content = read_bytes(path)
    form, elements, comments, length = _parse_header(path, content)
    chosen = require(
        next((other for other in elements if other.name == element), None),
        f"{path}: expected an element {element}, got {[other.name for other in elements]}",
    )
    names = [name for name, _ in chosen.properties]
    refuse_if(
        "packed_position" in names,
        f"{path}: a compressed PLY of SuperSplat (packed_position, ...), expected one value per property",
        remedy="export it there as an uncompressed PLY",
    )
    check_properties(path, names, required)
    read = _read_ascii if form == "ascii" else _read_binary
    return PlyFile(path=path, rows=read(path, content, form, elements, length, chosen), comments=tuple(comments))


def check_properties(path: Path, names: Sequence[str], required: Sequence[str]) -> None:
    """Raise InputError naming missing `required` properties."""
    missing = [name for name in required if name not in names]
    refuse_if(
        missing,
        f"{path}: no 3D-GS splat file: missing properties {' '.join(missing)} (it has {' '.join(names)})",
        remedy="write them by these names: scale_* is log(sigma [m]), rot_* a quaternion w x y z, opacity a logit"
        if ({"opacity", "f_dc_0"} & {*names})
        else "a point cloud or mesh has to be reconstructed first",
    )


def write_table(path: Path, rows: Array, comments: Mapping[str, str]) -> None:
    """Write `rows` (float32 and uint8 fields) as element vertex. Same input, same bytes.

    Comments follow the properties, for some readers. Non-ASCII text is escaped. Raises UsageError for a comment of
    several lines, or a key with a colon.
    """
    fields: Mapping[str, Any] = rows.dtype.fields or {}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {NAMES_OF_SCALARS[kind.str[1:]]} {name}" for name, (kind, *_) in fields.items()]
    for key, value in comments.items():
        refuse_if(
            not key or ":" in key or any(mark in key + value for mark in "\r\n"),
            f"PLY comment {key!r}: expected one line and a key without a colon, got {value!r}",
            error=UsageError,
        )
        lines.append(f"comment {key}: {value}".rstrip() if value else f"comment {key}")
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode("ascii", "backslashreplace") + rows.tobytes())


def _read_binary(
    path: Path, content: bytes, form: str, elements: Sequence[_Element], length: int, chosen: _Element
) -> Array:
    byte_order, start, end = BYTE_ORDERS[form], 0, length
    dtype = chosen.dtype(path, byte_order)
    for element in elements:
        start, end = end if element is chosen else start, element.end(content, end, byte_order)
    what = "cut short" if len(content) < end else "longer than its header says"
    refuse_if(
        len(content) != end,
        f"{path}: {what}: expected {end} bytes ({length} of header and the data it promises), got {len(content)}",
        remedy="copy or write the file again",
    )
    return np.frombuffer(content, dtype, count=chosen.count, offset=start)


def _read_ascii(
    path: Path, content: bytes, form: str, elements: Sequence[_Element], length: int, chosen: _Element
) -> Array:
    lines = [line.split() for line in content[length:].split(b"\n") if line.strip()]
    expected = sum(element.count for element in elements if element.properties)
    refuse_if(len(lines) != expected, f"{path}: expected {expected} lines of data, got {len(lines)}")
    start = sum(element.count for element in elements[: elements.index(chosen)] if element.properties)
    rows = lines[start : start + chosen.count]
    table = np.zeros(chosen.count, dtype=chosen.dtype(path, BYTE_ORDERS[form]))
    bad = next((i for i, row in enumerate(rows) if len(row) != len(chosen.properties)), None)
    if bad is not None:
        raise InputError(
            f"{path}: {chosen.name} {bad}: expected {len(chosen.properties)} numbers, got {len(rows[bad])}"
        )
    for index, (name, _) in enumerate(chosen.properties):
        with refuse_faults(f"{path}: {chosen.name}: property {name}", ValueError, OverflowError):
            table[name] = [float(row[index]) for row in rows]
    return table


def _parse_header(path: Path, content: bytes) -> tuple[str, list[_Element], list[str], int]:
    refuse_if(
        not content.startswith((b"ply\n", b"ply\r\n")),
        f"{path}: no PLY file: expected it to start with 'ply', got {content[:8]!r}",
    )
    end = content.find(b"\nend_header")
    newline = content.find(b"\n", end + 1)
    refuse_if(
        end < 0 or newline < 0 or content[end:newline].strip() != b"end_header",
        f"{path}: cut short: its header has no end_header line",
    )
    form, elements, comments = "", list[_Element](), list[str]()
    for line in content[:end].decode("utf-8", "backslashreplace").splitlines()[1:]:
        match line.split():
            case ["format", name, "1.0"] if name in BYTE_ORDERS:
                form = name
            case ["comment" | "obj_info", *_]:
                comments.append(line.strip().partition(" ")[2])
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name=name, count=int(count), properties=[]))
            case ["property", "list", length, kind, name] if (
                elements and kind in SCALARS and SCALARS.get(length, "f4")[0] in "iu"
            ):
                elements[-1].properties.append((name, f"{length} {kind}"))
            case ["property", kind, name] if elements and kind in SCALARS:
                refuse_if(
                    name in (known for known, _ in elements[-1].properties),
                    f"{path}: element {elements[-1].name} names property {name} twice",
                )
                elements[-1].properties.append((name, kind))
            case []:
                continue
            case _:
                raise InputError(f"{path}: header line not understood: {line.strip()!r}")
    refuse_if(not form, f"{path}: its header has no format line; expected one of {', '.join(BYTE_ORDERS)}")
    return form, elements, comments, newline + 1


def read_points(path: Path) -> PointCloud:
    """Read a PLY's points x, y, z [m] with red, green, blue (0 to 255).

    Raises InputError if truncated, empty or without one of these properties.
    """
    table = _columns(path, ("x", "y", "z", "red", "green", "blue"), "coloured point cloud")
    points, colors = table[:, :3], table[:, 3:] / 255.0
    refuse_if(
        colors.min() < 0.0 or colors.max() > 1.0,
        f"{path}: red, green, blue: expected 0 to 255, got up to {255.0 * colors.max():g}",
    )
    return PointCloud(points=points.astype(np.float32), colors=colors.astype(np.float32))


def read_positions(path: Path) -> Float64:
    """Read a PLY's points (N, 3), in the file's unit, ignoring other properties.

    Raises InputError if truncated, empty or without x, y or z.
    """
    return _columns(path, ("x", "y", "z"), "point cloud")


def _columns(path: Path, names: tuple[str, ...], what: str) -> Float64:
    ply = read_table(path, "vertex", ())
    missing = [name for name in names if name not in ply.names]
    refuse_if(missing, f"{path}: no {what}: missing properties {' '.join(missing)}")
    refuse_if(not len(ply), f"{path}: has no points", remedy="give a point cloud of the scene")
    return np.column_stack([ply.column(name) for name in names])


def is_mesh(path: Path) -> bool:
    """True unless a PLY without faces."""
    if path.suffix.lower() != ".ply":
        return True
    header = read_bytes(path, 65536).partition(b"end_header")[0]
    counts = [line.split() for line in header.splitlines() if line.startswith(b"element face")]
    return bool(counts) and counts[0][-1] != b"0"


AXES = ("x", "y", "z")
POINTS_PER_BLOCK = 1 << 15

_Line = tuple[int, list[str]]


def point_blocks(stream: TextIO, name: str) -> Iterator[Float64]:
    """Yield a CSV's points as (Q, 3) float64 [m], at most `POINTS_PER_BLOCK` at once.

    A first line of three numbers is no header. Else the header names x, y, z; other columns are ignored. Raises
    InputError for a missing column, a line of another length, or no finite number within `MAX_PLACE`.
    """
    reader = csv.reader(stream)
    lines: Iterator[_Line] = ((reader.line_num, row) for row in reader if row)
    with (
        refuse_faults(
            lambda error: f"{name}: line {reader.line_num}: no CSV text: {error}",
            csv.Error,
            remedy="correct the line",
        ),
        refuse_faults(f"{name}: no UTF-8 text", UnicodeDecodeError, remedy="give a CSV file"),
    ):
        first = require(
            next(lines, None), f"{name}: has no points", remedy="give a CSV file with the columns x,y,z [m]"
        )
        columns, rest = _axes(name, first[1]), lines
        if columns is None:
            columns, rest = [0, 1, 2], chain([first], lines)
        num_points = 0
        while block := list(islice(rest, POINTS_PER_BLOCK)):
            yield _numbers(name, block, columns, len(first[1]))
            num_points += len(block)
    refuse_if(not num_points, f"{name}: has a header and no points", remedy="add a line for each point")


def _axes(name: str, cells: Sequence[str]) -> list[int] | None:
    if len(cells) == 3 and all(_number(cell) is not None for cell in cells):
        return None
    titles = [cell.strip().lstrip("\ufeff").lower() for cell in cells]
    for axis in AXES:
        what = "no column" if axis not in titles else "several columns"
        refuse_if(
            titles.count(axis) != 1,
            f"{name}: {what} {axis}: expected a header with x, y and z, or three numbers a line, got"
            f" {','.join(cells)[:60]!r}",
            remedy="name the columns x,y,z; they are in metres",
        )
    return [titles.index(axis) for axis in AXES]


def _numbers(name: str, block: Sequence[_Line], columns: Sequence[int], num_columns: int) -> Float64:
    i, j, k = columns
    with suppress(ValueError, IndexError):
        points = np.array([(float(row[i]), float(row[j]), float(row[k])) for _, row in block])
        if all(len(row) == num_columns for _, row in block) and (np.abs(points) <= MAX_PLACE).all():
            return points
    for number, row in block:  # to name the first line that is wrong
        refuse_if(
            len(row) != num_columns,
            f"{name}: line {number}: expected {num_columns} columns, got {len(row)}",
            remedy="correct the line",
        )
        for axis, column in zip(AXES, columns, strict=True):
            value = _number(row[column])
            refuse_if(
                value is None or not abs(value) <= MAX_PLACE,
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
