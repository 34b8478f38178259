"""Summaries of splats, grids, robots, JSON, arrays, images; by header if possible."""

import json
import zipfile
from collections.abc import Callable
from math import prod
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import numpy as np
import yaml
from defusedxml import ElementTree

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if, require
from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.formats.arrays import DAMAGE, npy_head, read_arrays
from splatctrl_cli.formats.grid.grid_format import json_value
from splatctrl_cli.formats.grid.grid_formats import FORMATS as GRID_FORMATS
from splatctrl_cli.formats.image_file import decode_file
from splatctrl_cli.formats.splat.splats import FORMATS as SPLAT_FORMATS
from splatctrl_cli.formats.splat.splats import describe_splats
from splatctrl_cli.recording.container.log_formats import SUFFIXES

_LIST_LIMIT = 12  # longer lists are counted, not shown


def describe_file(path: Path) -> Summary:
    """Describe a file by content. Raises InputError if unknown."""
    refuse_if(path.stat().st_size == 0, f"{path}: the file is empty (0 bytes)", remedy="write or copy it again")
    with path.open("rb") as stream:
        head = stream.read(1 << 16)  # bytes in which a text header must end
    for describe in _KINDS:
        if (summary := describe(path, head)) is not None:
            return summary
    grids = [Path(f"x{kind.suffix}").suffix for kind in GRID_FORMATS.values()]
    known = [*SUFFIXES, ".toml", *SPLAT_FORMATS, *(".npz", ".npy"), *grids]
    known += [".urdf", ".json", ".jsonl", ".csv", ".yaml", ".png", ".jpg"]
    raise InputError(f"{path}: unknown kind of file", remedy=f"known: {' '.join(dict.fromkeys(known))}")


def _ply(path: Path, head: bytes) -> Summary:
    text, end, _ = head.partition(b"end_header")
    refuse_if(not end, f"{path}: a PLY whose header does not end", remedy="the file is damaged")
    lines = text.decode("latin-1").splitlines()
    comments = [line[8:] for line in lines if line.startswith("comment ")]
    elements = [line.split()[1:3] for line in lines if line.startswith("element ") and len(line.split()) == 3]
    properties = [line.split()[-1] for line in lines if line.startswith("property ")]
    storage = next((line[7:] for line in lines if line.startswith("format ")), "unknown")
    is_splats = {"opacity", "scale_0"} <= set(properties)
    facts: dict[str, object] = {
        "format": storage,
        **{name: int(count) if count.isdigit() else count for name, count in elements},
        "properties": properties,
        "comments": comments,
    }
    return Summary(path=str(path), kind="splats" if is_splats else "PLY", facts=facts)


def _npz(path: Path, _head: bytes) -> Summary:
    with refuse_faults(f"{path}: not a readable .npz", *DAMAGE, OSError, remedy="the file is damaged"):
        with zipfile.ZipFile(path) as archive:
            arrays = {n: npy_head(archive.open(n)) for n in archive.namelist() if n.endswith(".npy")}
        refuse_if(not arrays, f"{path}: a zip file without arrays", remedy="expected .npz")
        short = [
            name.removesuffix(".npy")
            for name, (shape, _, dtype) in arrays.items()
            if (shape == () if dtype.kind in "US" else dtype.kind in "fiub" and prod(shape) <= _LIST_LIMIT)
        ]
        facts: dict[str, object] = {
            name: json_value(str(array)) if array.dtype.kind in "US" else array.tolist()
            for name, array in read_arrays(path, short, most=1 << 24).items()
        }
    rows = [
        [name.removesuffix(".npy"), "x".join(map(str, shape)) or "-", str(dtype)]
        for name, (shape, _, dtype) in arrays.items()
    ]
    names = {str(row[0]) for row in rows}
    return Summary(
        path=str(path),
        kind="occupancy grid" if "log_odds" in names else "distance grid" if {"sdf"} & names else "arrays",
        facts=facts,
        grids=(Grid(name="arrays", header=("array", "shape", "dtype"), rows=rows),),
    )


def _parsed(path: Path, parse: Callable[[], Any], what: str) -> Any:
    # ValueError: what defusedxml forbids, too
    with refuse_faults(
        f"{path}: not {what}", ValueError, EOFError, ParseError, yaml.YAMLError, remedy="the file is damaged"
    ):
        return parse()


def _npy(path: Path, _head: bytes) -> Summary:
    array = _parsed(path, lambda: np.load(path, mmap_mode="r", allow_pickle=False), "a readable .npy")
    return Summary(path=str(path), kind="array", facts={"shape": list(array.shape), "dtype": str(array.dtype)})


def _urdf(path: Path, _head: bytes) -> Summary:
    robot = _parsed(path, lambda: ElementTree.fromstring(path.read_bytes()), "readable XML")
    refuse_if(robot.tag != "robot", f"{path}: expected <robot>, got <{robot.tag}>", remedy="expected a URDF")
    joints, links = robot.findall("joint"), robot.findall("link")
    rows = []
    for joint in joints:
        limit = joint.find("limit")
        bounds = ["-", "-", "-"] if limit is None else [limit.get(k, "-") for k in ("lower", "upper", "velocity")]
        parent, child = (joint.find(tag) for tag in ("parent", "child"))
        names = [end.get("link", "-") if end is not None else "-" for end in (parent, child)]
        rows.append([joint.get("name", "-"), joint.get("type", "-"), *names, *bounds])
    movable = [j for j in joints if j.get("type") not in {"fixed", None}]
    facts: dict[str, object] = {
        "robot": robot.get("name", ""),
        "links": len(links),
        "joints": len(joints),
        "movable_joints": len(movable),
    }
    grid = Grid(
        name="joint_table", header=("joint", "type", "parent", "child", "lower", "upper", "velocity"), rows=rows
    )
    return Summary(
        path=str(path),
        kind="URDF",
        facts=facts,
        grids=(grid,),
        notes=() if movable else ("no movable joint: an unexpanded xacro looks like this; expand it with `xacro`",),
    )


def _json(path: Path, _head: bytes) -> Summary:
    content = _parsed(path, lambda: json.loads(path.read_text(encoding="utf-8")), "JSON")
    if not isinstance(content, dict):
        return Summary(
            path=str(path), kind="JSON", facts={"entries": len(content) if isinstance(content, list) else 1}
        )
    known = {"command": "run report", "primitives": "truth", "robot_urdf": "truth", "frames": "camera poses"}
    kind = next((name for key, name in known.items() if key in content), "JSON")
    kind = "truth" if path.name == "truth.json" else kind
    return Summary(path=str(path), kind=kind, facts={key: _short(value) for key, value in content.items()})


def _rows(path: Path, _head: bytes) -> Summary:
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if path.suffix == ".jsonl":
        with refuse_faults(f"{path}: the first line is not JSON", ValueError, remedy="the file is damaged"):
            first = json.loads(lines[0])
        return Summary(path=str(path), kind="JSON lines", facts={"rows": len(lines), "keys": list(first)})
    return Summary(path=str(path), kind="CSV", facts={"rows": len(lines) - 1, "columns": lines[0].split(",")})


def _yaml(path: Path, _head: bytes) -> Summary:
    content = _parsed(path, lambda: yaml.safe_load(path.read_text(encoding="utf-8")), "YAML")
    spheres = _find(content, "collision_spheres")
    if isinstance(spheres, dict):
        rows = [[link, len(items)] for link, items in spheres.items() if isinstance(items, list)]
        grid = Grid(name="links", header=("link", "spheres"), rows=rows)
        return Summary(
            path=str(path), kind="robot spheres", facts={"spheres": sum(int(row[1]) for row in rows)}, grids=(grid,)
        )
    return Summary(path=str(path), kind="YAML", facts={"keys": list(content) if isinstance(content, dict) else []})


def _image(path: Path, _head: bytes) -> Summary:
    what = f"{path}: not an image that can be read"
    pixels = require(decode_file(path.read_bytes(), color=False), what, remedy="the file is damaged")
    return Summary(
        path=str(path),
        kind="image",
        facts={
            "size": f"{pixels.shape[1]}x{pixels.shape[0]}",
            "channels": 1 if pixels.ndim == 2 else pixels.shape[2],
            "dtype": str(pixels.dtype),
        },
    )


def _find(content: Any, key: str) -> Any:
    if not isinstance(content, dict):
        return None
    if key in content:
        return content[key]
    return next((result for value in content.values() if (result := _find(value, key)) is not None), None)


def _short(value: object) -> object:
    if isinstance(value, list) and (len(value) > _LIST_LIMIT or any(isinstance(v, list | dict) for v in value)):
        return f"{len(value)} entries"
    return {key: _short(item) for key, item in value.items()} if isinstance(value, dict) else value


def _kind(
    describe: Callable[[Path, bytes], Summary], starts: tuple[bytes, ...] = (), suffixes: tuple[str, ...] = ()
) -> Callable[[Path, bytes], Summary | None]:
    return lambda path, head: (
        describe(path, head) if head.startswith(starts) or path.suffix.lower() in suffixes else None
    )


_KINDS: tuple[Callable[[Path, bytes], Summary | None], ...] = (
    _kind(_ply, (b"ply\n", b"ply\r\n")),
    _kind(_npy, (b"\x93NUMPY",)),
    _kind(_image, (b"\x89PNG", b"\xff\xd8\xff")),
    *(kind.describe for kind in GRID_FORMATS.values()),
    _kind(_npz, (b"PK\x03\x04",)),
    _kind(describe_splats, suffixes=tuple(suffix for suffix in SPLAT_FORMATS if suffix != ".ply")),
    _kind(_urdf, suffixes=(".urdf", ".xacro")),
    _kind(_json, suffixes=(".json",)),
    _kind(_rows, suffixes=(".jsonl", ".csv")),
    _kind(_yaml, suffixes=(".yaml", ".yml")),
)
