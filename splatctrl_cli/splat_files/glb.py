"""The container of glTF 2.0 (``.glb``): a JSON document, one buffer, and tables of numbers in it."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Float32

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942  # glTF, JSON, BIN
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
ARRAY_BUFFER = 34962


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
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
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
