"""Gaussians as glTF 2.0 in one binary file (``.glb``), with the extension KHR_gaussian_splatting.

One primitive of points whose attributes are float32: centre, rotation (x y z w), sigmas (linear), opacity, and every
harmonic's coefficient of red, green, blue; COLOR_0 holds the colour for readers that know points alone. The values
are in world as they are; glTF's up is y, so the node that holds them turns a world whose z is up. The container is a
JSON document, one buffer, and tables of numbers in it.
"""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.splat.gaussian_ply import check_gaussians
from splatctrl_cli.formats.splat.splat_format import SH_C0, SplatFormat, refuse, unit_quaternions
from splatctrl_cli.formats.unpacking import read_bytes
from splatctrl_cli.records import Float32, GaussianSet, Label

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


class GlbWriter:
    """Collects tables of attributes and writes them with a document."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, table: NDArray[Any], *, with_range: bool = False) -> int:
        """Add a table (N, 1 | 3 | 4) of float32, or of uint8 that stand for 0 to 1; returns its accessor's index."""
        content = np.ascontiguousarray(table).tobytes()
        is_float = table.dtype == np.float32
        accessor = {
            "bufferView": len(self._views),
            "componentType": 5126 if is_float else 5121,
            "count": len(table),
            "type": TYPES[table.shape[1]],
        }
        if not is_float:
            accessor["normalized"] = True
        if with_range:
            accessor |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(content), "target": ARRAY_BUFFER}
        self._views.append(view)
        self._accessors.append(accessor)
        self._parts.append(content)
        self._length += len(content)
        return len(self._accessors) - 1

    def write(self, path: Path, document: Mapping[str, Any]) -> None:
        """Write `document` and the tables. Same input, same bytes."""
        whole = {
            **document,
            "buffers": [{"byteLength": self._length}],
            "bufferViews": self._views,
            "accessors": self._accessors,
        }
        text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(self._parts)
        binary += bytes(-len(binary) % 4)
        length = 12 + 8 + len(text) + 8 + len(binary)
        with path.open("wb") as stream:
            stream.write(struct.pack("<III", MAGIC, 2, length))
            stream.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
            stream.write(struct.pack("<II", len(binary), BINARY_CHUNK) + binary)


def read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document and the buffer of a ``.glb`` file. Raises InputError for one not whole, or not version 2."""
    content = read_bytes(path)
    if len(content) < 20 or struct.unpack_from("<I", content)[0] != MAGIC:
        raise InputError(f"{path}: no .glb file: expected it to start with 'glTF', got {content[:4]!r}")
    _, version, length, json_length, json_kind = struct.unpack_from("<IIIII", content)
    if version != 2 or json_kind != JSON_CHUNK:
        raise InputError(f"{path}: expected glTF 2 with its JSON first, got version {version}")
    if length != len(content) or 20 + json_length > length:
        raise InputError(
            f"{path}: expected {length} bytes, got {len(content)}", remedy="copy or write the file again"
        )
    try:
        document = json.loads(content[20 : 20 + json_length])
    except ValueError as error:
        raise InputError(f"{path}: its JSON cannot be read: {error}") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected a JSON object, got {type(document).__name__}")
    return document, _buffer(path, content[20 + json_length :])


def _buffer(path: Path, rest: bytes) -> bytes:
    if not rest:
        return b""
    length, kind = struct.unpack_from("<II", rest) if len(rest) >= 8 else (0, 0)
    if kind != BINARY_CHUNK or 8 + length > len(rest):
        raise InputError(f"{path}: expected a chunk BIN of {length} bytes after the JSON, got {len(rest)} bytes")
    return rest[8 : 8 + length]


class Accessors:
    """The tables of numbers of a document, by accessor."""

    def __init__(self, path: Path, document: Mapping[str, Any], binary: bytes) -> None:
        self._path = path
        self._document = document
        self._binary = binary

    def table(self, index: int, width: int) -> Float32:
        """(N, width) float32 values of an accessor. Raises InputError for a table of another width or cut short."""
        accessor = self._document["accessors"][index]
        dtype = np.dtype(COMPONENTS[accessor["componentType"]])
        if accessor["type"] != TYPES[width] or "sparse" in accessor or "bufferView" not in accessor:
            raise InputError(
                f"{self._path}: accessor {index}: expected a plain {TYPES[width]}, got {accessor['type']}"
            )
        view = self._document["bufferViews"][accessor["bufferView"]]
        if view["buffer"] != 0 or "uri" in self._document["buffers"][0]:
            raise InputError(f"{self._path}: accessor {index}: expected its data inside the file")
        num, row = int(accessor["count"]), width * dtype.itemsize
        start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
        stride = int(view.get("byteStride", row))
        if min(num, start, stride - row) < 0 or start + (num - 1) * stride + row > len(self._binary):
            raise InputError(f"{self._path}: accessor {index}: reaches beyond the {len(self._binary)} bytes of data")
        values = np.ndarray((num, width), dtype, self._binary, start, (stride, dtype.itemsize))
        if accessor.get("normalized", False):
            return np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0)).astype(np.float32)
        return values.astype(np.float32)


def write_glb(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    """Write `gaussians`; `comments` go in the asset's extras. Same input, same bytes.

    Labels are the attribute ``_LABEL``, where some Gaussian is not an object.
    Raises InputError for a value that no Gaussian can have, naming its index.
    """
    check_gaussians("Gaussians to write", gaussians)
    writer = GlbWriter()
    attributes = {"POSITION": writer.add(gaussians.centers, with_range=True)}
    attributes["COLOR_0"] = writer.add(_point_colors(gaussians))
    attributes[ROTATION] = writer.add(np.roll(gaussians.quats_wxyz, -1, axis=1))
    attributes[SCALE] = writer.add(gaussians.scales)
    attributes[OPACITY] = writer.add(gaussians.opacities[:, None])
    for index in range(gaussians.harmonics.shape[1]):
        attributes[coefficient_name(index)] = writer.add(gaussians.harmonics[:, index])
    if (gaussians.labels != Label.OBJECT).any():
        attributes["_LABEL"] = writer.add(gaussians.labels[:, None].astype(np.float32))
    primitive = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: PROPERTIES}}
    document = {
        "asset": {"version": "2.0", "generator": "splatctrl", "extras": {"frame": "world", **comments}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "splats", "mesh": 0, "rotation": Z_UP_TO_Y_UP}],
        "meshes": [{"primitives": [primitive]}],
    }
    writer.write(path, document)


def read_gltf(path: Path) -> tuple[GaussianSet, dict[str, str]]:
    """The Gaussians of a ``.glb`` file in the axes of their own mesh (a node's transform is not applied), and extras.

    Raises InputError for a file that is not whole, does not have exactly one primitive of Gaussians, or packs them.
    """
    document, binary = read_glb(path)
    primitive = _primitive(path, document)
    accessors = Accessors(path, document, binary)
    try:
        gaussians = _gaussians(path, primitive["attributes"], accessors)
        extras = document["asset"].get("extras", {})
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: glTF not understood: {type(error).__name__}: {error}") from None
    check_gaussians(str(path), gaussians)
    return gaussians, {key: str(value) for key, value in extras.items()}


def coefficient_name(index: int) -> str:
    """The attribute of coefficient `index` of the harmonics, counted through all degrees."""
    degree = int(np.sqrt(index))
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index - degree * degree}"


def _point_colors(gaussians: GaussianSet) -> NDArray[np.uint8]:
    """(N, 4) red, green, blue, opacity of 0 to 255: the colour that a plain point cloud shows."""
    colors = np.clip(0.5 + SH_C0 * gaussians.harmonics[:, 0].astype(np.float64), 0.0, 1.0)
    return np.rint(255.0 * np.column_stack([colors, gaussians.opacities])).astype(np.uint8)


def _primitive(path: Path, document: Mapping[str, Any]) -> dict[str, Any]:
    """The one primitive that is Gaussians."""
    try:
        primitives = [primitive for mesh in document.get("meshes", []) for primitive in mesh["primitives"]]
        found = [primitive for primitive in primitives if EXTENSION in primitive.get("extensions", {})]
        names = [name for primitive in found for name in primitive["extensions"][EXTENSION].get("extensions", {})]
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: glTF not understood: {type(error).__name__}: {error}") from None
    if len(found) != 1:
        raise InputError(f"{path}: expected one primitive with {EXTENSION}, got {len(found)} of {len(primitives)}")
    if names:
        raise InputError(f"{path}: its Gaussians are packed by {names[0]}, expected plain attributes")
    primitive: dict[str, Any] = found[0]
    kernel = primitive["extensions"][EXTENSION].get("kernel")
    if kernel != PROPERTIES["kernel"]:
        raise InputError(f"{path}: kernel of its Gaussians: expected {PROPERTIES['kernel']}, got {kernel}")
    return primitive


def _gaussians(path: Path, attributes: Mapping[str, int], accessors: Accessors) -> GaussianSet:
    required = ("POSITION", ROTATION, SCALE, OPACITY, coefficient_name(0))
    missing = [name for name in required if name not in attributes]
    if missing:
        raise InputError(f"{path}: its Gaussians have no {', '.join(missing)} (they have {', '.join(attributes)})")
    num = 1
    while coefficient_name(num) in attributes:
        num += 1
    if num not in (1, 4, 9, 16):
        raise InputError(f"{path}: harmonics: expected 1, 4, 9 or 16 coefficients, got {num}")
    centers, scales = accessors.table(attributes["POSITION"], 3), accessors.table(attributes[SCALE], 3)
    if (scales < 0).any():
        where = np.flatnonzero((scales < 0).any(axis=1))[0]
        raise InputError(
            f"{path}: splat {where}: {SCALE}: expected no negative sigma, got {scales[where]}",
            remedy="drafts of the extension held logarithms there: write it again with a newer tool",
        )
    labels = accessors.table(attributes["_LABEL"], 1)[:, 0] if "_LABEL" in attributes else np.zeros(len(centers))
    refuse(str(path), "_LABEL", labels, (labels < 0) | (labels > 255) | (labels % 1 != 0), "a whole number 0 to 255")
    return GaussianSet(
        centers=centers,
        scales=scales,
        quats_wxyz=unit_quaternions(str(path), np.roll(accessors.table(attributes[ROTATION], 4), 1, axis=1)),
        opacities=accessors.table(attributes[OPACITY], 1)[:, 0],
        harmonics=np.stack([accessors.table(attributes[coefficient_name(k)], 3) for k in range(num)], axis=1),
        labels=labels.astype(np.uint8),
    )


_DOCS = """
`.glb` | glTF 2.0 with
    [KHR_gaussian_splatting](https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting)
    | float32 | density
"""


ENTRIES = (
    SplatFormat(
        name="glTF with KHR_gaussian_splatting", order=3, suffix=".glb", write=write_glb, read=read_gltf, docs=_DOCS
    ),
)
