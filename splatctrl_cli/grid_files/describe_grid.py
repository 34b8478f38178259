"""Heads of the files that hold a baked distance field: what they cover and how they were made, no values."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.arrays import DAMAGE, read_arrays
from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.grid_files.grid import read_npz_head
from splatctrl_cli.grid_files.grid_channels import CHANNELS, FORMAT, GridHead
from splatctrl_cli.grid_files.moveit_field import read_moveit_head
from splatctrl_cli.grid_files.nrrd import PREFIX, read_nrrd_head
from splatctrl_cli.grid_files.vdb import read_vdb_head
from splatctrl_cli.grid_files.vti import read_vti_head

FIELD_FACTS = (
    *("distance", "kernel", "length_scale", "weights", "unknown", "probability", "sign", "frame", "labels"),
    *("splats_used", "observed", "stamp_ns"),
)
_MOST_HEAD = 1 << 20  # bytes of a grid's arrays but for its values
_CHANNEL_COLUMNS = ("channel", "dtype", "unit")


def covers(first_cell: Any, voxel: float, shape: Any) -> dict[str, object]:
    """Cells, extent and the centres of the first and last cell [m] of a grid."""
    first, sides = np.asarray(first_cell, np.float64), voxel * (np.asarray(shape) - 1)
    return {
        "shape": [int(n) for n in shape],
        "extent_m": np.round(sides, 6).tolist(),
        "first_cell": np.round(first, 6).tolist(),
        "last_cell": np.round(first + sides, 6).tolist(),
        "voxel": voxel,
    }


def header_facts(header: Mapping[str, Any]) -> dict[str, object]:
    """How a grid was made, of what its header says."""
    return {key: header[key] for key in FIELD_FACTS if header.get(key) is not None}


def describe_grid_npz(path: Path) -> Summary:
    """A ``field.npz``. Raises InputError for one that is damaged or of another version."""
    return _summary(path, "distance grid", read_npz_head(path))


def describe_vti(path: Path, head: bytes) -> Summary:
    """A ``.vti``: as a distance grid where it is ours, as what its XML says where not."""
    text = head.decode("latin-1")
    image = re.search(r"<ImageData\b([^>]*)>", text)
    if image is None:
        raise InputError(f"{path}: a .vti without ImageData", remedy="the file is damaged")
    if FORMAT in _field_text(text):
        return _summary(path, "ParaView image data", read_vti_head(path))
    facts: dict[str, object] = dict(re.findall(r'(\w+)="([^"]*)"', image[1]))
    rows = []
    for attributes in re.findall(r"<DataArray\b([^>]*)>", text):
        values = dict(re.findall(r'(\w+)="([^"]*)"', attributes))
        rows.append([values.get("Name", "-"), values.get("type", "-"), values.get("NumberOfComponents", "1")])
    grid = Grid(name="arrays", header=("array", "type", "components"), rows=rows)
    return Summary(path=str(path), kind="ParaView image data", facts=facts, grids=(grid,))


def describe_nrrd(path: Path, _head: bytes) -> Summary:
    """Any NRRD file: its fields, and the header of the bake where it is ours."""
    fields, pairs = read_nrrd_head(path)
    header = {key.removeprefix(PREFIX): _value(value) for key, value in pairs.items() if key.startswith(PREFIX)}
    others = {key: value for key, value in pairs.items() if not key.startswith(PREFIX)}
    return Summary(path=str(path), kind="NRRD", facts={**fields, **header_facts(header), **others})


def describe_vdb(path: Path, _head: bytes) -> Summary:
    """Any OpenVDB file: its grids, and the header of the bake where it is ours."""
    grids = read_vdb_head(path)
    rows = [
        [g.name, g.type, g.metadata.get("class", "-"), g.metadata.get("file_voxel_count", "-")]
        for g in sorted(grids, key=lambda g: g.name)
    ]
    header = {key: _value(value) for key, value in grids[0].metadata.items()} if grids else {}
    facts: dict[str, object] = {"grids": len(grids)}
    if header.get("format") == FORMAT:
        facts |= header_facts(header)
    table = Grid(name="grid_table", header=("grid", "type", "class", "active voxels"), rows=rows)
    return Summary(path=str(path), kind="OpenVDB", facts=facts, grids=(table,))


def describe_curobo(path: Path) -> Summary:
    """A ``field.curobo.npz``. Raises InputError for one that is damaged."""
    try:
        content = read_arrays(
            path, ("curobo", "channel", "shape", "voxel_size", "dims", "pose", "header"), most=_MOST_HEAD
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
    except (*DAMAGE, OSError, TypeError) as error:
        raise InputError(f"{path}: not a readable .npz: {error}", remedy="the file is damaged") from None
    return Summary(path=str(path), kind="cuRobo voxel grid", facts=facts)


def describe_moveit(path: Path, _head: bytes) -> Summary:
    """A stream of MoveIt's distance field."""
    numbers, start = read_moveit_head(path)
    cells = [int(numbers[f"size_{axis}"] * (1.0 / numbers["resolution"])) for axis in "xyz"]
    place = covers([numbers[f"origin_{axis}"] for axis in "xyz"], numbers["resolution"], cells)
    facts = {**place, "packed_bytes": path.stat().st_size - start}
    return Summary(path=str(path), kind="MoveIt distance field", facts=facts)


def describe_mesh(path: Path, _head: bytes) -> Summary:
    """A mesh that trimesh reads, such as a surface of the field; read whole."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        mesh.merge_vertices()  # .stl has three a triangle
        facts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "is_watertight": bool(mesh.is_watertight)}
        lower, upper = np.round(mesh.bounds, 6).tolist()
    except Exception as error:  # whatever its parsers meet
        raise InputError(f"{path}: not a readable mesh: {error}", remedy="the file is damaged") from None
    return Summary(path=str(path), kind="mesh", facts={**facts, "lower": lower, "upper": upper})


def is_moveit(_path: Path, head: bytes) -> bool:
    """Whether a file starts as a stream of MoveIt's distance field does."""
    return re.match(rb"resolution: \S+\nsize_x: ", head) is not None


def _summary(path: Path, kind: str, head: GridHead) -> Summary:
    rows = [[name, CHANNELS[name].dtype.lstrip("<|"), CHANNELS[name].unit or "-"] for name in head.channels]
    facts = {**covers(head.origin, head.voxel, head.shape), **header_facts(head.header)}
    table = Grid(name="channels", header=_CHANNEL_COLUMNS, rows=rows)
    return Summary(path=str(path), kind=kind, facts=facts, grids=(table,))


def _field_text(text: str) -> str:
    """The string in FieldData, which is written as numbers."""
    codes = re.search(r'<Array type="String"[^>]*>([\d\s]+)</Array>', text)
    return "" if codes is None else bytes(int(code) % 256 for code in codes[1].split()).decode("utf-8", "replace")


def _value(text: object) -> object:
    """What a JSON text holds; any other value as it is."""
    try:
        return json.loads(text) if isinstance(text, str) else text
    except ValueError:
        return text
