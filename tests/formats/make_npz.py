"""Writes .npz files with arrays of zeros that are a thousand times smaller than what they hold."""

import struct
import zlib
from collections.abc import Mapping
from io import BytesIO
from math import prod
from pathlib import Path

import numpy as np

PIECE = 1 << 20
_DEFLATED = 8

Zeros = tuple[tuple[int, ...], str]  # shape and type


def write_zeros(path: Path, zeros: Mapping[str, Zeros], **arrays: object) -> Path:
    """A .npz of `arrays` and of arrays of zeros, with wrong checksums: those of gigabytes would take seconds."""
    local, central, num = b"", b"", 0
    for name, (data, size) in {**_packed_arrays(arrays), **_packed_zeros(zeros)}.items():
        file = f"{name}.npy".encode()
        extra = struct.pack("<HHQQ", 1, 16, size, len(data))
        fields = struct.pack(
            "<HHHHHIIIHH", 45, 0, _DEFLATED, 0, 33, _crc(arrays, name), *[0xFFFFFFFF] * 2, len(file), 20
        )
        place = struct.pack("<HHHII", 0, 0, 0, 0, len(local))
        central += b"PK\x01\x02" + struct.pack("<H", 45) + fields + place + file + extra
        local += b"PK\x03\x04" + fields + file + extra + data
        num += 1
    end = b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, num, num, len(central), len(local), 0)
    path.write_bytes(local + central + end)
    return path


def _crc(arrays: Mapping[str, object], name: str) -> int:
    return zlib.crc32(_npy(arrays[name])) if name in arrays else 0


def _npy(array: object) -> bytes:
    stream = BytesIO()
    np.save(stream, np.asarray(array))
    return stream.getvalue()


def _packed_arrays(arrays: Mapping[str, object]) -> dict[str, tuple[bytes, int]]:
    found = {}
    for name, array in arrays.items():
        pack = zlib.compressobj(9, zlib.DEFLATED, -15)
        found[name] = (pack.compress(_npy(array)) + pack.flush(), len(_npy(array)))
    return found


def _packed_zeros(zeros: Mapping[str, Zeros]) -> dict[str, tuple[bytes, int]]:
    found = {}
    for name, (shape, dtype) in zeros.items():
        stream = BytesIO()
        np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
        size = prod(shape) * np.dtype(dtype).itemsize
        assert size % PIECE == 0
        pack = zlib.compressobj(9, zlib.DEFLATED, -15)
        data = pack.compress(stream.getvalue()) + pack.flush(zlib.Z_FULL_FLUSH)
        piece = pack.compress(bytes(PIECE)) + pack.flush(zlib.Z_FULL_FLUSH)  # nothing refers back over a full flush
        found[name] = (data + piece * (size // PIECE) + pack.flush(), len(stream.getvalue()) + size)
    return found
