"""Distance fields as OpenVDB's ``.vdb``: a FloatGrid per scalar channel, a Vec3SGrid for the gradient.

Needs OpenVDB's Python module (``openvdb``, formerly ``pyopenvdb``), which is not on PyPI, and all channels in memory.
Voxel (i, j, k) is cell (i, j, k): whole indices are cell centres. NaN cells and zero gradients are inactive.
"""

import json
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from splatctrl_cli import __version__
from splatctrl_cli.errors import UsageError, refuse_faults, refuse_if
from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.formats.grid.grid_format import (
    CHANNELS,
    FORMAT,
    GridFormat,
    check_grid,
    file_header,
    header_facts,
    json_value,
    slabs,
)
from splatctrl_cli.records import DistanceGrid

MAGIC = b" BDV\0\0\0\0"
_UUID_AT, _UUID_LENGTH = 21, 36  # [bytes] of the random identity in a file, which is made the same in all
_REMEDY = "install OpenVDB's Python module: conda-forge has openvdb, Debian and Ubuntu python3-openvdb"
_NUMBERS = {"int32": "<i", "int64": "<q", "float": "<f", "double": "<d", "bool": "<?"}


def write_vdb(path: Path, grid: DistanceGrid) -> None:
    """Write the grid; inactive voxels read as the float above the channel's largest.

    That is positive, so query active voxels only. A gradient's inactive voxels are zero. Raises UsageError without
    OpenVDB.
    """
    check_grid(grid)
    vdb = openvdb()
    metadata = {key: _plain(value) for key, value in file_header(grid).items()}
    v, (x, y, z) = float(grid.voxel), (float(value) for value in grid.origin)
    to_world = [[v, 0.0, 0.0, 0.0], [0.0, v, 0.0, 0.0], [0.0, 0.0, v, 0.0], [x, y, z, 1.0]]  # for row vectors
    grids = []
    for name, values in grid.channels.items():
        is_vector = CHANNELS[name].components == 3
        background = 0.0 if is_vector else _above(values)
        vdb_grid = vdb.Vec3SGrid((0.0, 0.0, 0.0)) if is_vector else vdb.FloatGrid(background)
        start = 0
        for layers in slabs(values):
            known = np.where(np.isnan(layers), np.float32(background), layers.astype(np.float32, copy=False))
            vdb_grid.copyFromArray(known, ijk=(start, 0, 0))
            start += len(layers)
        vdb_grid.transform = vdb.createLinearTransform(to_world)
        vdb_grid.name, vdb_grid.creator = name, f"splatctrl {__version__}"
        if name in {"sdf", "hard", "se", "gpdf"}:
            vdb_grid.gridClass = vdb.GridClass.LEVEL_SET
        if is_vector:
            vdb_grid.vectorType = vdb.VectorType.COVARIANT
        for key, value in metadata.items():
            vdb_grid[key] = value
        grids.append(vdb_grid)
    vdb.write(str(path), grids=grids, metadata={"creator": f"splatctrl {__version__}"})
    with path.open("r+b") as stream:
        stream.seek(_UUID_AT)
        stream.write(b"00000000-0000-4000-8000-000000000000"[:_UUID_LENGTH])


def openvdb() -> Any:
    """Import OpenVDB by either name. Raises UsageError without it."""
    try:
        import openvdb as module
    except ImportError:
        with refuse_faults(
            "OpenVDB: its Python module cannot be imported", ImportError, remedy=_REMEDY, error=UsageError
        ):
            import pyopenvdb as module
    return module


def _above(values: Any) -> float:
    largest = max((float(np.nanmax(layers)) for layers in slabs(values) if not np.isnan(layers).all()), default=0.0)
    return float(np.nextafter(np.float32(largest), np.float32(np.inf)))


def _plain(value: object) -> object:
    is_number = isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**31)
    return value if isinstance(value, str | bool) or is_number else json.dumps(value, allow_nan=False)


def read_vdb_head(path: Path) -> list[tuple[str, str, dict[str, object]]]:
    """Read name, type and metadata of a ``.vdb``'s grids, without OpenVDB.

    Layout: OpenVDB's io/Archive.cc, io/GridDescriptor.cc and MetaMap.cc, since file version 222. Raises InputError
    for another or a damaged file.
    """
    with path.open("rb") as stream:
        refuse_if(
            stream.read(8) != MAGIC, f"{path}: expected an OpenVDB file, got another", remedy="the file is damaged"
        )
        with refuse_faults(
            f"{path}: not a readable OpenVDB file", ValueError, struct.error, remedy="the file is damaged"
        ):
            version, _, _, has_offsets = _unpack(stream, "<3I?")
            refuse_if(version < 222 or not has_offsets, f"file version {version}", error=ValueError)
            stream.read(_UUID_LENGTH)
            _metadata(stream)
            grids = []
            for _ in range(_unpack(stream, "<I")[0]):
                name, kind, _parent = (_text(stream) for _ in range(3))
                start, _, end = _unpack(stream, "<3q")
                stream.seek(start + 4)  # behind the grid's kind of compression
                grids.append((name.split("\x1e")[0], kind, _metadata(stream)))
                stream.seek(end)
    return grids


def _unpack(stream: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack(layout, stream.read(struct.calcsize(layout)))


def _text(stream: BinaryIO) -> str:
    (length,) = _unpack(stream, "<I")
    text = stream.read(length)
    refuse_if(len(text) != length, "it is cut", error=ValueError)
    return text.decode("utf-8", errors="replace")


def _metadata(stream: BinaryIO) -> dict[str, object]:
    metadata: dict[str, object] = {}
    for _ in range(_unpack(stream, "<I")[0]):
        name, kind = _text(stream), _text(stream)
        if kind in _NUMBERS:
            stream.read(4)  # its length
            (metadata[name],) = _unpack(stream, _NUMBERS[kind])
        else:
            text = _text(stream)
            metadata[name] = text if kind == "string" else f"{kind} of {len(text)} bytes"
    return metadata


def describe_vdb(path: Path, head: bytes) -> Summary | None:
    if not head.startswith(MAGIC):
        return None
    grids = read_vdb_head(path)
    rows = [
        [name, kind, metadata.get("class", "-"), metadata.get("file_voxel_count", "-")]
        for name, kind, metadata in sorted(grids, key=lambda grid: grid[0])
    ]
    header = {key: json_value(value) for key, value in grids[0][2].items()} if grids else {}
    facts: dict[str, object] = {"grids": len(grids)}
    if header.get("format") == FORMAT:
        facts |= header_facts(header)
    table = Grid(name="grid_table", header=("grid", "type", "class", "active voxels"), rows=rows)
    return Summary(path=str(path), kind="OpenVDB", facts=facts, grids=(table,))


ENTRIES = (
    GridFormat(
        name="vdb",
        order=3,
        suffix=".vdb",
        write=write_vdb,
        describe=describe_vdb,
        check=openvdb,
        docs="""
`vdb` | `field.vdb`: a FloatGrid or Vec3SGrid a channel | OpenVDB 10.0.1; Houdini, Blender not tried
""",
    ),
)
