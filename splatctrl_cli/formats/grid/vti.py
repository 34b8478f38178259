"""Baked distance fields as ParaView's ``.vti``: VTK ImageData with points at cell centres.

Values are raw appended little-endian blocks, x fastest, each after its length. The header is a string in FieldData
(VTK's page on XML file formats).
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree.ElementTree import Element, ParseError
from xml.sax.saxutils import quoteattr

import numpy as np
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from splatctrl_cli.errors import refuse_faults, refuse_if, require
from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.formats.grid.grid_format import (
    CHANNELS,
    FORMAT,
    GridFormat,
    check_finite,
    check_grid,
    check_layout,
    header_text,
    parse_header,
    summary_of,
    x_fastest,
)
from splatctrl_cli.records import DistanceGrid, Values

_TYPES = {"<f4": "Float32", "|u1": "UInt8"}
_DTYPES = {name: dtype for dtype, name in _TYPES.items()}
_FILE = {"type": "ImageData", "version": "1.0", "byte_order": "LittleEndian", "header_type": "UInt64"}
_APPENDED = b'<AppendedData encoding="raw">'
_REMEDY = "give a .vti that sdf-bake wrote, or bake it again"


def write_vti(path: Path, grid: DistanceGrid) -> None:
    """Write the grid; NaN is kept."""
    x, y, z = check_grid(grid)
    extent = f"0 {x - 1} 0 {y - 1} 0 {z - 1}"
    origin, spacing = (" ".join(repr(float(v)) for v in values) for values in (grid.origin, [grid.voxel] * 3))
    arrays, offset = [], 0
    for name, values in grid.channels.items():
        arrays.append(
            f'        <DataArray type="{_TYPES[CHANNELS[name].dtype]}" Name={quoteattr(name)} '
            f'NumberOfComponents="{CHANNELS[name].components}" format="appended" offset="{offset}"/>'
        )
        offset += 8 + values.nbytes
    codes = " ".join(str(byte) for byte in (*header_text(grid).encode("utf-8"), 0))
    vectors = ' Vectors="gradient"' if "gradient" in grid.channels else ""
    lines = [
        '<?xml version="1.0"?>',
        f"<VTKFile {' '.join(f'{key}={quoteattr(value)}' for key, value in _FILE.items())}>",
        *(f"  <!-- {line} -->" for line in _comments(grid)),
        f'  <ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}">',
        "    <FieldData>",
        '      <Array type="String" Name="header" NumberOfTuples="1" format="ascii">',
        f"        {codes}",
        "      </Array>",
        "    </FieldData>",
        f'    <Piece Extent="{extent}">',
        f'      <PointData Scalars="sdf"{vectors}>',
        *arrays,
        "      </PointData>",
        "    </Piece>",
        "  </ImageData>",
        f"  {_APPENDED.decode()}",
        "   _",
    ]
    with path.open("wb") as stream:
        stream.write("\n".join(lines).encode("utf-8"))
        for values in grid.channels.values():
            stream.write(values.nbytes.to_bytes(8, "little"))
            stream.writelines(planes.tobytes() for planes in x_fastest(values))
        stream.write(b"\n  </AppendedData>\n</VTKFile>\n")


def read_vti(path: Path, *, with_values: bool = True) -> DistanceGrid:
    """Read a `write_vti` grid; without values, channels are zeros.

    Raises InputError if missing, damaged or of another program.
    """
    with _opened(path) as stream:
        grid, starts = _head(path, stream)
        if with_values:
            grid = replace(
                grid, channels={name: _values(path, stream, grid, name, start) for name, start in starts.items()}
            )
            check_finite(str(path), grid)
    return grid


def _opened(path: Path) -> BinaryIO:
    missing, folder = "bake one with sdf-bake --formats vti", "give the field.vti in it"
    with (
        refuse_faults(lambda _: f"{path}: no such file", FileNotFoundError, remedy=missing),
        refuse_faults(lambda _: f"{path}: expected a file, got a folder", IsADirectoryError, remedy=folder),
    ):
        return path.open("rb")


def _head(path: Path, stream: BinaryIO) -> tuple[DistanceGrid, dict[str, int]]:
    """The grid with zeros, and each channel's offset [bytes]: its length, then its values."""
    text = stream.read(1 << 22)  # bytes in which the XML must end
    mark = text.find(_APPENDED)
    begin = text.find(b"_", mark) + 1
    refuse_if(mark < 0 or begin == 0, f"{path}: expected raw appended data, got none", remedy=_REMEDY)
    with refuse_faults(f"{path}: not readable XML", ParseError, DefusedXmlException, remedy=_REMEDY):
        root: Any = ElementTree.fromstring(text[:begin] + b"</AppendedData></VTKFile>")
    image, piece = root.find("ImageData"), root.find("ImageData/Piece")
    refuse_if(
        {key: root.get(key) for key in _FILE} != _FILE or image is None or piece is None,
        f"{path}: expected a VTKFile of {_FILE}, got {dict(root.attrib)}",
        remedy=_REMEDY,
    )
    with refuse_faults(
        lambda error: f"{path}: not a distance grid of ours: {error!r}", KeyError, ValueError, remedy=_REMEDY
    ):
        return _parsed(path, image, piece, begin)


def _parsed(path: Path, image: Element, piece: Element, begin: int) -> tuple[DistanceGrid, dict[str, int]]:
    bounds = [int(number) for number in piece.attrib["Extent"].split()]
    refuse_if(
        bounds[::2] != [0, 0, 0] or piece.attrib["Extent"] != image.attrib["WholeExtent"],
        f"expected one piece from 0 0 0, got {piece.attrib['Extent']}",
        error=ValueError,
    )
    shape = (bounds[1] + 1, bounds[3] + 1, bounds[5] + 1)
    spacing = {float(number) for number in image.attrib["Spacing"].split()}
    refuse_if(len(spacing) != 1, f"expected cubic cells, got {image.attrib['Spacing']}", error=ValueError)
    codes = [int(code) for code in (image.findtext("FieldData/Array") or "").split()]
    header = parse_header(str(path), bytes(codes[:-1]).decode("utf-8"))
    arrays = {array.attrib["Name"]: array.attrib for array in piece.iterfind("PointData/DataArray")}
    widths = {name: int(its["NumberOfComponents"]) for name, its in arrays.items()}
    layout = {
        name: (_DTYPES[its["type"]], shape if widths[name] == 1 else (*shape, widths[name]))
        for name, its in arrays.items()
    }
    starts = {name: begin + int(its["offset"]) for name, its in arrays.items()}
    check_layout(str(path), layout)
    origin = np.array([float(number) for number in image.attrib["Origin"].split()])
    voxel = spacing.pop()
    refuse_if(
        origin.shape != (3,) or not np.isfinite(origin).all() or not 0.0 < voxel < np.inf,
        f"expected a place and a size above 0, got {image.attrib['Origin']}, {voxel}",
        error=ValueError,
    )
    zeros = {name: np.broadcast_to(np.zeros((), kind), size) for name, (kind, size) in layout.items()}
    return DistanceGrid(origin=origin, voxel=voxel, channels=zeros, header=header), starts


def _values(path: Path, stream: BinaryIO, grid: DistanceGrid, name: str, start: int) -> Values:
    stream.seek(start)
    zeros = grid.channels[name]
    (x, y, z), size = zeros.shape[:3], zeros.size * zeros.itemsize
    num_bytes = min(int.from_bytes(stream.read(8), "little"), path.stat().st_size - start - 8)
    refuse_if(
        num_bytes != size,
        f"{path}: {name}: expected {size} bytes, got {max(num_bytes, 0)}",
        remedy="the file is cut; bake it again",
    )
    planes: Values = np.fromfile(stream, zeros.dtype, zeros.size).reshape(z, y, x, *zeros.shape[3:])
    return np.ascontiguousarray(planes.transpose(2, 1, 0, *range(3, planes.ndim)))


def _comments(grid: DistanceGrid) -> list[str]:
    names = ("sign", "frame", "units", "origin", "distance", "kernel", "length_scale", "weights")
    return [f"{name}: {grid.header[name]}".replace("--", "- -") for name in names if name in grid.header]


def describe_vti(path: Path, head: bytes) -> Summary | None:
    if path.suffix != ".vti" and b'type="ImageData"' not in head[:512]:
        return None
    text = head.decode("latin-1")
    match, what = re.search(r"<ImageData\b([^>]*)>", text), f"{path}: a .vti without ImageData"
    image = require(match, what, remedy="the file is damaged")
    codes = re.search(r'<Array type="String"[^>]*>([\d\s]+)</Array>', text)  # the string, written as numbers
    if codes and FORMAT in bytes(int(code) % 256 for code in codes[1].split()).decode("utf-8", "replace"):
        return summary_of(path, "ParaView image data", read_vti(path, with_values=False))
    facts: dict[str, object] = dict(_ATTRIBUTE.findall(image[1]))
    arrays = [dict(_ATTRIBUTE.findall(attributes)) for attributes in re.findall(r"<DataArray\b([^>]*)>", text)]
    grid = Grid(
        name="arrays",
        header=("array", "type", "components"),
        rows=[[a.get("Name", "-"), a.get("type", "-"), a.get("NumberOfComponents", "1")] for a in arrays],
    )
    return Summary(path=str(path), kind="ParaView image data", facts=facts, grids=(grid,))


_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')


ENTRIES = (
    GridFormat(
        name="vti",
        order=1,
        suffix=".vti",
        write=write_vti,
        describe=describe_vti,
        read=read_vti,
        docs="""
`vti` | `field.vti`: ImageData, points at the cell centres | VTK 9.7.2; ParaView not tried
""",
    ),
)
