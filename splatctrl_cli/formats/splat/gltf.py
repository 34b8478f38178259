"""Gaussians as glTF 2.0 in one binary file (``.glb``), with KHR_gaussian_splatting.

A primitive of points has float32 centre, rotation (x y z w), sigmas (linear), opacity, harmonics of red, green, blue;
COLOR_0 serves plain point readers. Values are in world; the node turns its z axis to glTF's y.
"""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.formats.splat.gaussian_ply import SH_C0, SplatFormat, check_gaussians, refuse, unit_quaternions
from splatctrl_cli.formats.unpacking import read_bytes
from splatctrl_cli.records import Array, Float32, GaussianSet, Label

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942  # glTF, JSON, BIN
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
ARRAY_BUFFER = 34962
EXTENSION = "KHR_gaussian_splatting"
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))
Z_UP_TO_Y_UP = [-float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5))]  # x y z w: a quarter turn back about x
PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}


def _write(path: Path, document: Mapping[str, Any], tables: Sequence[Array]) -> None:
    views, accessors, binary = list[dict[str, Any]](), list[dict[str, Any]](), bytearray()
    for table in tables:
        is_float, content = table.dtype == np.float32, np.ascontiguousarray(table).tobytes()
        accessors.append(
            {
                "bufferView": len(views),
                "componentType": 5126 if is_float else 5121,
                "count": len(table),
                "type": TYPES[table.shape[1]],
                **({} if is_float else {"normalized": True}),
                **({} if views else {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}),
            }
        )
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(content), "target": ARRAY_BUFFER})
        binary += content
    whole = {**document, "buffers": [{"byteLength": len(binary)}], "bufferViews": views, "accessors": accessors}
    text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    with path.open("wb") as stream:
        stream.write(struct.pack("<III", MAGIC, 2, 12 + 8 + len(text) + 8 + len(binary)))
        stream.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
        stream.write(struct.pack("<II", len(binary), BINARY_CHUNK) + binary)


def read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """A ``.glb``'s document and buffer. Raises InputError if truncated, or not version 2."""
    content = read_bytes(path)
    refuse_if(
        len(content) < 20 or struct.unpack_from("<I", content)[0] != MAGIC,
        f"{path}: no .glb file: expected it to start with 'glTF', got {content[:4]!r}",
    )
    _, version, length, json_length, json_kind = struct.unpack_from("<IIIII", content)
    refuse_if(
        version != 2 or json_kind != JSON_CHUNK, f"{path}: expected glTF 2 with its JSON first, got version {version}"
    )
    refuse_if(
        length != len(content) or 20 + json_length > length,
        f"{path}: expected {length} bytes, got {len(content)}",
        remedy="copy or write the file again",
    )
    with refuse_faults(f"{path}: its JSON cannot be read", ValueError):
        document = json.loads(content[20 : 20 + json_length])
    refuse_if(not isinstance(document, dict), f"{path}: expected a JSON object, got {type(document).__name__}")
    rest = content[20 + json_length :]
    length, kind = struct.unpack_from("<II", rest) if len(rest) >= 8 else (0, 0)
    refuse_if(
        rest and (kind != BINARY_CHUNK or 8 + length > len(rest)),
        f"{path}: expected a chunk BIN of {length} bytes after the JSON, got {len(rest)} bytes",
    )
    return document, rest[8 : 8 + length]


def _table(path: Path, document: Mapping[str, Any], binary: bytes, index: int, width: int) -> Float32:
    accessor, where = document["accessors"][index], f"{path}: accessor {index}"
    dtype = np.dtype(COMPONENTS[accessor["componentType"]])
    refuse_if(
        accessor["type"] != TYPES[width] or "sparse" in accessor or "bufferView" not in accessor,
        f"{where}: expected a plain {TYPES[width]}, got {accessor['type']}",
    )
    view = document["bufferViews"][accessor["bufferView"]]
    refuse_if(view["buffer"] != 0 or "uri" in document["buffers"][0], f"{where}: expected its data inside the file")
    num, row = int(accessor["count"]), width * dtype.itemsize
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    stride = int(view.get("byteStride", row))
    refuse_if(
        min(num, start, stride - row) < 0 or start + (num - 1) * stride + row > len(binary),
        f"{where}: reaches beyond the {len(binary)} bytes of data",
    )
    values = np.ndarray((num, width), dtype, binary, start, (stride, dtype.itemsize))
    if accessor.get("normalized", False):
        return np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0)).astype(np.float32)
    return values.astype(np.float32)


def write_glb(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    """Write `gaussians`; `comments` become the asset's extras.

    ``_LABEL`` is written if some Gaussian is not an object.
    """
    check_gaussians("Gaussians to write", gaussians)
    colors = np.clip(0.5 + SH_C0 * gaussians.harmonics[:, 0].astype(np.float64), 0.0, 1.0)
    tables: dict[str, Array] = {  # the first has its range beside it
        "POSITION": gaussians.centers,
        "COLOR_0": np.rint(255.0 * np.column_stack([colors, gaussians.opacities])).astype(np.uint8),
        ROTATION: np.roll(gaussians.quats_wxyz, -1, axis=1),
        SCALE: gaussians.scales,
        OPACITY: gaussians.opacities[:, None],
        **{coefficient_name(k): gaussians.harmonics[:, k] for k in range(gaussians.harmonics.shape[1])},
    }
    if (gaussians.labels != Label.OBJECT).any():
        tables["_LABEL"] = gaussians.labels[:, None].astype(np.float32)
    primitive = {
        "mode": 0,
        "attributes": {name: number for number, name in enumerate(tables)},
        "extensions": {EXTENSION: PROPERTIES},
    }
    document = {
        "asset": {"version": "2.0", "generator": "splatctrl", "extras": {"frame": "world", **comments}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "splats", "mesh": 0, "rotation": Z_UP_TO_Y_UP}],
        "meshes": [{"primitives": [primitive]}],
    }
    _write(path, document, [*tables.values()])


def read_gltf(path: Path) -> tuple[GaussianSet, dict[str, str]]:
    """Read a ``.glb`` file in its mesh's axes (ignoring nodes' transforms), and its extras.

    Raises InputError if truncated, packed, or without exactly one Gaussian primitive.
    """
    document, binary = read_glb(path)
    primitive = _primitive(path, document)
    with refuse_faults(
        lambda error: f"{path}: glTF not understood: {type(error).__name__}: {error}",
        KeyError,
        IndexError,
        TypeError,
        ValueError,
        AttributeError,
    ):
        gaussians = _gaussians(path, primitive["attributes"], partial(_table, path, document, binary))
        extras = document["asset"].get("extras", {})
    check_gaussians(str(path), gaussians)
    return gaussians, {key: str(value) for key, value in extras.items()}


def coefficient_name(index: int) -> str:
    """Attribute of coefficient `index`, counted through all degrees."""
    degree = int(np.sqrt(index))
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index - degree * degree}"


def _primitive(path: Path, document: Mapping[str, Any]) -> dict[str, Any]:
    with refuse_faults(
        lambda error: f"{path}: glTF not understood: {type(error).__name__}: {error}",
        KeyError,
        TypeError,
        AttributeError,
    ):
        primitives = [primitive for mesh in document.get("meshes", []) for primitive in mesh["primitives"]]
        splat_primitives = [primitive for primitive in primitives if EXTENSION in primitive.get("extensions", {})]
        names = [
            name
            for primitive in splat_primitives
            for name in primitive["extensions"][EXTENSION].get("extensions", {})
        ]
    refuse_if(
        len(splat_primitives) != 1,
        f"{path}: expected one primitive with {EXTENSION}, got {len(splat_primitives)} of {len(primitives)}",
    )
    refuse_if(names, f"{path}: its Gaussians are packed by {''.join(names[:1])}, expected plain attributes")
    primitive: dict[str, Any] = splat_primitives[0]
    kernel = primitive["extensions"][EXTENSION].get("kernel")
    refuse_if(
        kernel != PROPERTIES["kernel"],
        f"{path}: kernel of its Gaussians: expected {PROPERTIES['kernel']}, got {kernel}",
    )
    return primitive


def _gaussians(path: Path, attributes: Mapping[str, int], table: Callable[[int, int], Float32]) -> GaussianSet:
    missing = [name for name in ("POSITION", ROTATION, SCALE, OPACITY, coefficient_name(0)) if name not in attributes]
    refuse_if(missing, f"{path}: its Gaussians have no {', '.join(missing)} (they have {', '.join(attributes)})")
    num = 1
    while coefficient_name(num) in attributes:
        num += 1
    refuse_if(num not in (1, 4, 9, 16), f"{path}: harmonics: expected 1, 4, 9 or 16 coefficients, got {num}")
    centers, scales = table(attributes["POSITION"], 3), table(attributes[SCALE], 3)
    if (scales < 0).any():
        where = np.flatnonzero((scales < 0).any(axis=1))[0]
        raise InputError(
            f"{path}: splat {where}: {SCALE}: expected no negative sigma, got {scales[where]}",
            remedy="drafts of the extension stored logarithms there: write it again with a newer tool",
        )
    labels = table(attributes["_LABEL"], 1)[:, 0] if "_LABEL" in attributes else np.zeros(len(centers))
    refuse(str(path), "_LABEL", labels, (labels < 0) | (labels > 255) | (labels % 1 != 0), "a whole number 0 to 255")
    return GaussianSet(
        centers=centers,
        scales=scales,
        quats_wxyz=unit_quaternions(str(path), np.roll(table(attributes[ROTATION], 4), 1, axis=1)),
        opacities=table(attributes[OPACITY], 1)[:, 0],
        harmonics=np.stack([table(attributes[coefficient_name(k)], 3) for k in range(num)], axis=1),
        labels=labels.astype(np.uint8),
    )


ENTRIES = (
    SplatFormat(
        name="glTF with KHR_gaussian_splatting",
        order=3,
        suffix=".glb",
        write=write_glb,
        read=read_gltf,
        docs="""
`.glb` | glTF 2.0 with
    [KHR_gaussian_splatting](https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting)
    | float32 | density
""",
    ),
)
