"""Baked grids for other planners: NVIDIA's cuRobo and MoveIt.

cuRobo's voxel grid is ``field.curobo.npz``, after its source (NVlabs/curobo, 0.7.5 to 0.7.7, geom/types.py
`VoxelGrid`, curobolib/cpp/sphere_obb_kernel.cu `compute_voxel_index`), untested. z runs fastest; values are positive
inside; there are ``1 + floor(dims / voxel)`` cells a side. The kernel truncates ``(x - pose + dims / 2) / voxel``, so
the pose ``x y z qw qx qy qz`` is half a voxel below our cells' middle. The first three and last two cells of an axis,
and the outside, are free.

MoveIt's distance field reads occupied cells (moveit_core, distance_field/src/propagation_distance_field.cpp,
`readFromStream`; voxel_grid.h). Seven lines of text precede a zlib stream of bits: x slowest, each run of z in whole
bytes, lowest bit first. There are ``int(size * (1 / resolution))`` cells a side; cell 0 is centred at the origin.
"""

import json
import re
import zlib
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import refuse_faults, refuse_if
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.formats.arrays import DAMAGE, Pieces, has_arrays, read_arrays, savez
from splatctrl_cli.formats.grid.grid_format import (
    CHUNK,
    GridFormat,
    check_grid,
    covers,
    header_facts,
    header_text,
    slabs,
)
from splatctrl_cli.records import Bool, DistanceGrid, Values

CUROBO = "0.7"  # the version that a file is for, as it says


def write_curobo(path: Path, grid: DistanceGrid) -> None:
    """Write ``sdf`` for cuRobo. Raises InputError for NaN."""
    shape, distances = check_grid(grid), grid.channels["sdf"]
    refuse_if(
        any(np.isnan(layers).any() for layers in slabs(distances)),
        "grid to write for cuRobo: sdf: expected distances, got NaN",
        remedy="bake with field.unknown=obstacle or free",
    )
    sides = np.array(shape, np.float64) - 1.0
    center = grid.origin + 0.5 * grid.voxel * sides - 0.5 * grid.voxel
    features: Pieces = (
        "<f4",
        (shape[0] * shape[1] * shape[2],),
        lambda: (-layers.astype(np.float32, copy=False) for layers in slabs(distances)),
    )
    arrays: dict[str, Values | Pieces] = {
        "features": features,
        "dims": grid.voxel * sides,
        "voxel_size": np.asarray(grid.voxel, "<f8"),
        "pose": np.array([*center, 1.0, 0.0, 0.0, 0.0]),
        "shape": np.array(shape, "<i8"),
        "curobo": np.asarray(CUROBO),
        "channel": np.asarray("sdf"),
        "header": np.asarray(header_text(grid)),
    }
    savez(path, arrays, level=0)


def describe_curobo(path: Path, head: bytes) -> Summary | None:
    """Summarise a ``field.curobo.npz``. Raises InputError if damaged."""
    if not has_arrays(path, head, {"features", "dims", "voxel_size", "pose", "curobo"}):
        return None
    with refuse_faults(f"{path}: not a readable .npz", *DAMAGE, OSError, TypeError, remedy="the file is damaged"):
        content = read_arrays(
            path, ("curobo", "channel", "shape", "voxel_size", "dims", "pose", "header"), most=1 << 20
        )
        facts: dict[str, object] = {
            "curobo": str(content["curobo"]),
            "channel": str(content["channel"]),
            "shape": content["shape"].tolist(),
            "voxel": float(np.asarray(content["voxel_size"], np.float64)),
            "dims": content["dims"].tolist(),
            "pose_xyz_qwxyz": content["pose"].tolist(),
            **header_facts(json.loads(str(content["header"]))),
        }
    return Summary(path=str(path), kind="cuRobo voxel grid", facts=facts)


FIELDS = ("resolution", "size_x", "size_y", "size_z", "origin_x", "origin_y", "origin_z")
MOVEIT_MARGIN = 1e-6  # [cells] by which a size is larger, so that no rounding truncates it to a cell less
REACH = np.sqrt(3.0) / 2.0  # [cells] from a centre to a corner
ROUNDING = 1e-6  # [m] of float32 values a metre or two from their origin


def write_moveit(path: Path, grid: DistanceGrid) -> None:
    """Write occupied cells: a splat may reach the cube, or sdf is at most 0.

    A splat may reach the cube if ``bound <= 0``; without bound, if ``hard <= sqrt(3)/2 voxel``. NaN and unknown
    obstacles count as sdf of at most 0. Raises InputError with neither bound nor hard.
    """
    shape = check_grid(grid)
    refuse_if(
        not {"bound", "hard"} & grid.channels.keys(),
        f"grid to write for MoveIt: expected the channel bound or hard, got {', '.join(grid.channels)}",
        remedy="bake it with one of them",
    )
    numbers = (grid.voxel, *((n + MOVEIT_MARGIN) * grid.voxel for n in shape), *grid.origin)
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
    """True (L, Y, Z) for cells written as occupied."""
    name, most = ("bound", 0.0) if "bound" in grid.channels else ("hard", REACH * grid.voxel + ROUNDING)
    reached = np.asarray(grid.channels[name][layers]) <= np.float32(most)
    is_clear: Bool = np.asarray(grid.channels["sdf"][layers]) > np.float32(0.0)  # False for NaN
    return reached | ~is_clear


def read_moveit_head(path: Path) -> tuple[dict[str, float], int]:
    """Read header numbers, and the bits' offset [bytes]. Raises InputError if damaged."""
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
        refuse_if(
            key != name or not np.isfinite(numbers[name]),
            f"{path}: expected '{name}: NUMBER', got {line!r}",
            remedy="the file is damaged",
        )
    return numbers, start


def describe_moveit(path: Path, head: bytes) -> Summary | None:
    if re.match(rb"resolution: \S+\nsize_x: ", head) is None:
        return None
    numbers, start = read_moveit_head(path)
    cells = [int(numbers[f"size_{axis}"] * (1.0 / numbers["resolution"])) for axis in "xyz"]
    return Summary(
        path=str(path),
        kind="MoveIt distance field",
        facts={
            **covers([numbers[f"origin_{axis}"] for axis in "xyz"], numbers["resolution"], cells),
            "packed_bytes": path.stat().st_size - start,
        },
    )


ENTRIES = (
    GridFormat(
        name="curobo",
        order=4,
        suffix=".curobo.npz",
        write=write_curobo,
        describe=describe_curobo,
        holds_unknown=False,
        bytes_per_cell=4,
        docs="""
`curobo` | `field.curobo.npz`: `features`, `dims`, `voxel_size`, `pose`, `shape` | NVIDIA cuRobo, not tried, by the
    lines below
""",
    ),
    GridFormat(
        name="moveit",
        order=5,
        suffix=".moveit",
        write=write_moveit,
        describe=describe_moveit,
        needs=frozenset({"bound", "hard"}),
        bytes_per_cell=0,
        docs="""
`moveit` | `field.moveit`: occupied cells | `PropagationDistanceField(stream, max_distance)` of MoveIt 1 and 2, not
    tried
""",
    ),
)
