"""Baked distance fields as ``.nrrd``, a file per channel, for 3D Slicer, ITK and pynrrd.

Format: http://teem.sourceforge.net/nrrd/format.html (NRRD0005, attached header, raw little-endian values). x is
fastest: `nrrd.read` gives ``values[x, y, z]``, for a gradient ``values[component, x, y, z]``. Header entries are
pairs ``splatctrl.KEY`` of JSON text.
"""

import json
from pathlib import Path

from splatctrl_cli.errors import refuse_if
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.formats.grid.grid_format import (
    CHANNELS,
    GridFormat,
    check_grid,
    file_header,
    header_facts,
    json_value,
    x_fastest,
)
from splatctrl_cli.formats.unpacking import read_bytes
from splatctrl_cli.records import DistanceGrid

PREFIX = "splatctrl."
_TYPES = {"<f4": "float", "|u1": "uint8"}


def write_nrrd(path: Path, grid: DistanceGrid, channel: str) -> None:
    """Write a channel; NaN is kept."""
    shape, kind, step = check_grid(grid), CHANNELS[channel], repr(float(grid.voxel))
    directions = [f"({step},0,0)", f"(0,{step},0)", f"(0,0,{step})"]
    sizes, kinds = [str(n) for n in shape], ["domain"] * 3
    if kind.components > 1:
        sizes, kinds = [str(kind.components), *sizes], ["vector", *kinds]
        directions = ["none", *directions]
    fields = {
        "type": _TYPES[kind.dtype],
        "dimension": str(len(sizes)),
        "space": "3D-right-handed",
        "sizes": " ".join(sizes),
        "space directions": " ".join(directions),
        "kinds": " ".join(kinds),
        **({"endian": "little"} if kind.dtype == "<f4" else {}),
        "encoding": "raw",
        "content": channel,
        **({"sample units": kind.unit} if kind.unit else {}),
        "space units": '"m" "m" "m"',
        "space origin": f"({','.join(repr(float(v)) for v in grid.origin)})",
    }
    pairs = {PREFIX + key: json.dumps(value, allow_nan=False) for key, value in file_header(grid).items()}
    lines = ["NRRD0005", *(f"{key}: {value}" for key, value in fields.items())]
    lines += [f"{key}:={value}" for key, value in pairs.items()]
    with path.open("wb") as stream:
        stream.write(("\n".join(lines) + "\n\n").encode("ascii"))
        stream.writelines(planes.tobytes() for planes in x_fastest(grid.channels[channel]))


def read_nrrd_head(path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Read an NRRD's fields and key/value pairs as text.

    Raises InputError for another file, or a header without an end.
    """
    text = read_bytes(path, 1 << 20)  # in which the header must end
    head, end, _ = text.partition(b"\n\n")
    lines = head.decode("utf-8", errors="replace").replace("\r\n", "\n").split("\n")
    refuse_if(
        not lines[0].startswith("NRRD000") or not end,
        f"{path}: expected NRRD and a header that ends, got neither",
        remedy="the file is damaged",
    )
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    for line in lines[1:]:
        if line.startswith("#"):
            continue
        key, mark, value = line.partition(":=")
        if mark and ": " not in key:
            pairs[key] = value
        else:
            key, _, value = line.partition(": ")
            fields[key] = value
    return fields, pairs


def describe_nrrd(path: Path, head: bytes) -> Summary | None:
    if not head.startswith(b"NRRD000"):
        return None
    fields, pairs = read_nrrd_head(path)
    header = {key.removeprefix(PREFIX): json_value(value) for key, value in pairs.items() if key.startswith(PREFIX)}
    others = {key: value for key, value in pairs.items() if not key.startswith(PREFIX)}
    return Summary(path=str(path), kind="NRRD", facts={**fields, **header_facts(header), **others})


def _write_all(path: Path, grid: DistanceGrid) -> None:
    for channel in grid.channels:
        write_nrrd(path.with_suffix(f".{channel}.nrrd"), grid, channel)


ENTRIES = (
    GridFormat(
        name="nrrd",
        order=2,
        suffix=".nrrd",
        write=_write_all,
        describe=describe_nrrd,
        is_per_channel=True,
        docs="""
`nrrd` | `field.CHANNEL.nrrd`: `data[x, y, z]`, a gradient `data[component, x, y, z]` | pynrrd 1.1.3; 3D Slicer, ITK
    not tried
""",
    ),
)
