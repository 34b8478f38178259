"""Baked distance fields as ``.npz``. Same grid, same bytes.

Members: ``origin`` (3,) float64 [m], ``voxel`` () float64 [m], ``header`` () str (JSON), one uncompressed array per
channel (`grid_format.CHANNELS`).
"""

import errno
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.formats.arrays import DAMAGE, check_numbers, has_arrays, npy_head, savez
from splatctrl_cli.formats.grid.grid_format import (
    GridFormat,
    check_finite,
    check_grid,
    check_layout,
    header_text,
    parse_header,
    summary_of,
)
from splatctrl_cli.records import DistanceGrid, Float64, Values

PLACE: Mapping[str, tuple[str, tuple[int, ...]]] = {"origin": ("<f8", (3,)), "voxel": ("<f8", ())}


MOST_PACKED = 1 << 29  # bytes of arrays that are compressed; stored ones are as large as the file

_Members = dict[str, tuple[np.dtype[np.generic], tuple[int, ...]]]


def write_npz(path: Path, grid: DistanceGrid) -> None:
    """Write the grid."""
    check_grid(grid)
    members: dict[str, Values] = {
        "origin": np.asarray(grid.origin, dtype="<f8"),
        "voxel": np.asarray(grid.voxel, dtype="<f8"),
        "header": np.asarray(header_text(grid)),
    }
    savez(path, {**members, **grid.channels}, level=0)


def read_npz(path: Path, *, with_values: bool = True) -> DistanceGrid:
    """Read the grid of `write_npz`; never unpickles. Without values, channels are zeros.

    Raises InputError if missing, damaged (checksums included), not finite, of another version or program. NaN is
    allowed in sdf and gradient if the header's ``unknown`` is ``nan``.
    """
    with _opened(path) as archive:
        members = _members(archive)
        origin, voxel, header = _head(path, archive, members)
        layout = {name: (kind.str, size) for name, (kind, size) in members.items() if name not in {*PLACE, "header"}}
        check_layout(str(path), layout)
        channels = {
            name: _array(archive, name) if with_values else np.broadcast_to(np.zeros((), kind), size)
            for name, (kind, size) in layout.items()
        }
    grid = DistanceGrid(origin=origin, voxel=voxel, channels=channels, header=header)
    if with_values:
        check_finite(str(path), grid)
    return grid


def describe_npz(path: Path, head: bytes) -> Summary | None:
    """Summarise a ``field.npz``. Raises InputError if damaged or of another version."""
    is_ours = has_arrays(path, head, {*PLACE, "header", "sdf"})
    return summary_of(path, "distance grid", read_npz(path, with_values=False)) if is_ours else None


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except FileNotFoundError:
        raise InputError(f"{path}: no such file", remedy="bake one with sdf-bake") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a file, got a folder", remedy="give the field.npz in it") from None
    except (*DAMAGE, OSError) as error:
        if isinstance(error, OSError) and error.errno not in {None, errno.EINVAL}:  # bz2's; a place before the start
            raise
        raise InputError(f"{path}: not a whole distance grid: {error}", remedy="bake it again") from None


def _members(archive: zipfile.ZipFile) -> _Members:
    members: _Members = {}
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        refuse_if(
            name in members or name == entry.filename,
            f"{entry.filename}: expected one .npy of each name",
            error=ValueError,
        )
        with archive.open(entry) as stream:
            shape, _, dtype = npy_head(stream)
            check_numbers(dtype)
            size = stream.tell() + dtype.itemsize * prod(shape)
        refuse_if(
            entry.file_size != size,
            f"{entry.filename}: expected {size} bytes, got {entry.file_size}",
            error=ValueError,
        )
        members[name] = (dtype, shape)
    size = sum(entry.file_size for entry in archive.infolist() if entry.compress_type != zipfile.ZIP_STORED)
    refuse_if(
        size > MOST_PACKED,
        f"{size} bytes in compressed arrays, expected at most {MOST_PACKED}, or arrays not compressed",
        error=ValueError,
    )
    return members


def _head(path: Path, archive: zipfile.ZipFile, members: _Members) -> tuple[Float64, float, dict[str, object]]:
    """Origin (3,) [m], voxel [m] and header."""
    refuse_if(
        {*PLACE, "header", "sdf"} - members.keys(),
        f"{path}: expected the arrays origin, voxel, header and sdf, got {', '.join(members) or 'none'}",
        remedy="give a field.npz that sdf-bake wrote",
    )
    dtype, text_shape = members["header"]
    refuse_if(
        dtype.kind != "U" or text_shape != (),
        f"{path}: header: expected one string, got {dtype} {text_shape}",
        remedy="bake it again",
    )
    header = parse_header(str(path), str(_array(archive, "header")))
    for name, expected in PLACE.items():
        got = (members[name][0].str, members[name][1])
        refuse_if(got != expected, f"{path}: {name}: expected {expected}, got {got}", remedy="bake it again")
    origin, voxel = _array(archive, "origin").astype(np.float64), float(_array(archive, "voxel").astype(np.float64))
    refuse_if(
        not np.isfinite(origin).all(),
        f"{path}: origin: expected 3 finite float64, got {origin.tolist()}",
        remedy="bake it again",
    )
    refuse_if(
        not 0.0 < voxel < np.inf, f"{path}: voxel: expected a size above 0 m, got {voxel}", remedy="bake it again"
    )
    return origin, voxel, header


def _array(archive: zipfile.ZipFile, name: str) -> Values:
    with archive.open(f"{name}.npy") as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        refuse_if(
            stream.read(1), f"{name}.npy has data after its array", error=ValueError
        )  # reading to the end is what checks the sum
    return np.asarray(array, order="C")


ENTRIES = (
    GridFormat(
        name="npz",
        order=0,
        suffix=".npz",
        write=write_npz,
        describe=describe_npz,
        read=read_npz,
        docs="""
`npz` | `field.npz`: `origin` (3,) and `voxel` () float64, `header` (JSON text), an array a channel, (X, Y, Z) or
    (X, Y, Z, 3), z fastest | this tool, NumPy
""",
    ),
)
