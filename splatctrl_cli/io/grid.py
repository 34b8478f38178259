"""Baked distance fields on disk: ``.npz`` for programs, ``.vti`` for ParaView. Same grid, same bytes.

npz members: ``origin`` (3,) float64 [m], ``voxel`` () float64 [m], ``header`` () str (JSON), one array a channel.
vti: ImageData whose points are the cell centres; raw appended little-endian blocks, x fastest; the header is a
string in FieldData.
"""

import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import DistanceGrid

CHANNELS: Mapping[str, tuple[str, int]] = {  # dtype and number of dimensions
    "sdf": ("<f4", 3),
    "gpdf": ("<f4", 3),
    "hard": ("<f4", 3),
    "gradient": ("<f4", 4),
    "observed": ("|u1", 3),
}
VERSION = 1
_VTK_TYPES = {"<f4": "Float32", "|u1": "UInt8"}


def write_npz(path: Path, grid: DistanceGrid) -> None:
    """Write the grid, uncompressed (floats hardly compress, and readers can map them)."""
    members: dict[str, NDArray[np.generic]] = {
        "origin": np.asarray(grid.origin, dtype="<f8"),
        "voxel": np.asarray(grid.voxel, dtype="<f8"),
        "header": np.asarray(_header_text(grid)),
        **grid.channels,
    }
    with path.open("wb") as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name, array in members.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)


def read_npz(path: Path) -> DistanceGrid:
    """The grid that `write_npz` wrote.

    Raises InputError for a file that is missing, damaged or not ours: members, types, shapes, checksums and
    finiteness are all checked, and pickled objects are never loaded.
    """
    members = _read_members(path)
    expected = {"origin", "voxel", "header", *CHANNELS}
    if set(members) != expected:
        raise InputError(
            f"{path}: expected the arrays {', '.join(sorted(expected))}, got {', '.join(sorted(members)) or 'none'}",
            remedy="give a field.npz that sdf-bake wrote",
        )
    origin, voxel = members.pop("origin"), members.pop("voxel")
    header = _parse_header(path, members.pop("header"))
    if origin.dtype != np.float64 or origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(f"{path}: origin: expected 3 finite float64, got {origin.dtype} {origin.tolist()}")
    if voxel.dtype != np.float64 or voxel.shape != () or not 0 < float(voxel.astype(np.float64)) < np.inf:
        raise InputError(f"{path}: voxel: expected one float64 above 0 m, got {voxel.dtype} {voxel.tolist()}")
    _check_channels(path, members)
    channels = {name: members[name] for name in CHANNELS}
    return DistanceGrid(origin=origin.astype(np.float64), voxel=float(voxel), channels=channels, header=header)


def write_vti(path: Path, grid: DistanceGrid) -> None:
    """Write the grid as VTK ImageData that ParaView opens."""
    shape = grid.channels["sdf"].shape
    extent = f"0 {shape[0] - 1} 0 {shape[1] - 1} 0 {shape[2] - 1}"
    arrays, offset = [], 0
    for name, values in grid.channels.items():
        components = values.shape[3] if values.ndim == 4 else 1
        arrays.append(
            f'        <DataArray type="{_vtk_type(values)}" Name={quoteattr(name)} NumberOfComponents="{components}" '
            f'format="appended" offset="{offset}"/>'
        )
        offset += 8 + values.nbytes
    codes = " ".join(str(byte) for byte in (*_header_text(grid).encode("utf-8"), 0))
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        *(f"  <!-- {line} -->" for line in _comments(grid)),
        f'  <ImageData WholeExtent="{extent}" Origin="{_triple(grid.origin)}" Spacing="{_triple([grid.voxel] * 3)}">',
        "    <FieldData>",
        '      <Array type="String" Name="header" NumberOfTuples="1" format="ascii">',
        f"        {codes}",
        "      </Array>",
        "    </FieldData>",
        f'    <Piece Extent="{extent}">',
        '      <PointData Scalars="sdf" Vectors="gradient">',
        *arrays,
        "      </PointData>",
        "    </Piece>",
        "  </ImageData>",
        '  <AppendedData encoding="raw">',
        "   _",
    ]
    with path.open("wb") as stream:
        stream.write("\n".join(lines).encode("utf-8"))
        for values in grid.channels.values():
            _write_block(stream, values)
        stream.write(b"\n  </AppendedData>\n</VTKFile>\n")


def _write_block(stream: BinaryIO, values: NDArray[np.generic]) -> None:
    stream.write(np.uint64(values.nbytes).astype("<u8").tobytes())
    x_fastest = values.transpose(2, 1, 0, *range(3, values.ndim))
    for plane in x_fastest:  # one z at a time: no second copy of the whole channel
        stream.write(np.ascontiguousarray(plane).tobytes())


def _vtk_type(values: NDArray[np.generic]) -> str:
    return _VTK_TYPES[values.dtype.newbyteorder("<").str]


def _comments(grid: DistanceGrid) -> list[str]:
    names = ("format", "sign", "frame", "units", "origin", "kernel", "length_scale", "weights")
    return [f"{name}: {grid.header[name]}".replace("--", "- -") for name in names if name in grid.header]


def _triple(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values, dtype=np.float64))


def _header_text(grid: DistanceGrid) -> str:
    return json.dumps(grid.header, indent=1, allow_nan=False)


def _read_members(path: Path) -> dict[str, NDArray[np.generic]]:
    members: dict[str, NDArray[np.generic]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as member:
                    members[name.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
                    if member.read(1):
                        raise ValueError(f"{name} goes on after its array")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file", remedy="bake one with sdf-bake") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a file, got a folder", remedy="give the field.npz in it") from None
    except (
        zipfile.BadZipFile,
        zlib.error,
        ValueError,
        EOFError,
        KeyError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise InputError(f"{path}: not a whole distance grid: {error}", remedy="bake it again") from None
    return members


def _parse_header(path: Path, header: NDArray[np.generic]) -> dict[str, object]:
    if header.dtype.kind != "U" or header.shape != ():
        raise InputError(f"{path}: header: expected one string, got {header.dtype} {header.shape}")
    try:
        parsed = json.loads(str(header))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: header: not JSON: {error}") from None
    if not isinstance(parsed, dict) or parsed.get("version") != VERSION:
        version = parsed.get("version") if isinstance(parsed, dict) else None
        raise InputError(f"{path}: header: expected version {VERSION}, got {version!r}", remedy="bake it again")
    return parsed


def _check_channels(path: Path, channels: Mapping[str, NDArray[np.generic]]) -> None:
    shape = channels["sdf"].shape
    for name, (dtype, ndim) in CHANNELS.items():
        values = channels[name]
        wanted = (*shape, 3) if ndim == 4 else shape
        if values.dtype.str != dtype or values.shape != wanted or len(shape) != 3 or 0 in shape:
            raise InputError(f"{path}: {name}: expected {dtype} {wanted}, got {values.dtype.str} {values.shape}")
        if not np.isfinite(values.astype(dtype, copy=False)).all():
            raise InputError(f"{path}: {name}: expected finite values, got some that are not", remedy="bake it again")
