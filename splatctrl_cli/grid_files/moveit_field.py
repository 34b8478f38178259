"""Occupied cells as the stream of MoveIt's distance field, which propagates distances from them itself.

Format: moveit_core, distance_field/src/propagation_distance_field.cpp (`readFromStream`; the same in MoveIt 1 and 2)
and voxel_grid.h. Seven lines of text, then a zlib stream of bits: x slowest, each run of z in whole bytes, lowest bit
first. The reader takes ``int(size * (1 / resolution))`` cells a side, and puts the centre of cell 0 at the origin.
"""

import re
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.grid_files.grid_format import CHUNK, GridFormat, check_grid, covers
from splatctrl_cli.records import Bool, DistanceGrid

FIELDS = ("resolution", "size_x", "size_y", "size_z", "origin_x", "origin_y", "origin_z")
MARGIN = 1e-6  # [cells] by which a size is larger, so that no rounding truncates it to a cell less
REACH = np.sqrt(3.0) / 2.0  # [cells] from a centre to a corner
ROUNDING = 1e-6  # [m] of float32 values a metre or two from their origin


def write_moveit(path: Path, grid: DistanceGrid) -> None:
    """Write the cells that are taken for occupied: a splat may reach into the cell's cube, or sdf is not above 0.

    The first is ``bound <= 0``, or ``hard <= sqrt(3)/2 voxel`` in a grid without bound; the second takes in the
    distance's own zero level, unknown space where the policy makes it an obstacle, and cells that are NaN.
    Raises InputError where the grid has neither bound nor hard.
    """
    shape = check_grid(grid)
    if not {"bound", "hard"} & grid.channels.keys():
        raise InputError(
            f"grid to write for MoveIt: expected the channel bound or hard, got {', '.join(grid.channels)}",
            remedy="bake it with one of them",
        )
    numbers = (grid.voxel, *((n + MARGIN) * grid.voxel for n in shape), *grid.origin)
    text = "".join(f"{name}: {float(value)!r}\n" for name, value in zip(FIELDS, numbers, strict=True))
    step = max(1, CHUNK // (4 * shape[1] * shape[2]))
    packer = zlib.compressobj()
    with path.open("wb") as stream:
        stream.write(text.encode("ascii"))
        for start in range(0, shape[0], step):
            occupied = is_occupied(grid, slice(start, start + step))
            stream.write(packer.compress(np.packbits(occupied, axis=2, bitorder="little").tobytes()))
        stream.write(packer.flush())


def is_occupied(grid: DistanceGrid, layers: slice) -> Bool:
    """(L, Y, Z) which cells of these layers of x are written as occupied."""
    if "bound" in grid.channels:
        reached = np.asarray(grid.channels["bound"][layers]) <= np.float32(0.0)
    else:
        reached = np.asarray(grid.channels["hard"][layers]) <= np.float32(REACH * grid.voxel + ROUNDING)
    is_clear: NDArray[np.bool_] = np.asarray(grid.channels["sdf"][layers]) > np.float32(0.0)  # False for NaN
    return reached | ~is_clear


def read_moveit_head(path: Path) -> tuple[dict[str, float], int]:
    """The numbers at the head of a stream, and where its bits start. Raises InputError for a file that has none."""
    with path.open("rb") as stream:
        lines = [stream.readline(128) for _ in FIELDS]
        start = stream.tell()
    numbers: dict[str, float] = {}
    for name, line in zip(FIELDS, lines, strict=True):
        key, _, value = line.decode("ascii", errors="replace").partition(": ")
        try:
            numbers[name] = float(value)
        except ValueError:
            numbers[name] = np.nan
        if key != name or not np.isfinite(numbers[name]):
            raise InputError(f"{path}: expected '{name}: NUMBER', got {line!r}", remedy="the file is damaged")
    return numbers, start


def describe_moveit(path: Path, head: bytes) -> Summary | None:
    """A stream of MoveIt's distance field."""
    if re.match(rb"resolution: \S+\nsize_x: ", head) is None:
        return None
    numbers, start = read_moveit_head(path)
    cells = [int(numbers[f"size_{axis}"] * (1.0 / numbers["resolution"])) for axis in "xyz"]
    place = covers([numbers[f"origin_{axis}"] for axis in "xyz"], numbers["resolution"], cells)
    facts = {**place, "packed_bytes": path.stat().st_size - start}
    return Summary(path=str(path), kind="MoveIt distance field", facts=facts)


_DOCS = """
`moveit` | `field.moveit`: occupied cells | `PropagationDistanceField(stream, max_distance)` of MoveIt 1 and 2 | a
    reader that follows its source; MoveIt not tried | 0.4 s, 16 MiB (one channel)
"""
ENTRIES = (
    GridFormat(
        name="moveit",
        order=5,
        suffix=".moveit",
        write=write_moveit,
        describe=describe_moveit,
        needs=frozenset({"bound", "hard"}),
        bytes_per_cell=0,
        docs=_DOCS,
    ),
)
