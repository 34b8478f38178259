"""The packed splat formats ``.splat`` and ``.spz``, in the world's axes.

``.splat`` has 32 bytes per Gaussian: float32 centre and sigmas; bytes of red, green, blue, opacity (255 is 1); a
quaternion w x y z as 128 q + 128.

``.spz`` (Niantic) is written in version 3, read in 2 to 4. A gzip stream has a header of 16 bytes, then by attribute
centres (24-bit fixed point), opacities, colours, log sigmas, rotations, harmonics above degree 0. Version 4 has a
plain header of 32 bytes, a table of two uint64 per attribute (bytes packed and unpacked), and a zstd stream for each.
Its axes are right, up, back; world axes are written unchanged, for reading back.
"""

import gzip
import struct
import zlib
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.formats.splat.gaussian_ply import (
    SH_C0,
    Differences,
    SplatFormat,
    check_finite,
    check_gaussians,
    drop_labels,
    unit_quaternions,
)
from splatctrl_cli.formats.unpacking import FREE_BYTES, BadBlockError, read_bytes, unpacked
from splatctrl_cli.records import Float32, GaussianSet, UInt8

ROW = np.dtype([("center", "<f4", 3), ("sigma", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])


def write_splat(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    """Write what `.splat` can represent of `gaussians`, without `comments`.

    A quaternion's largest component is made negative, as a byte can be -1 but not 1.
    """
    check_gaussians("Gaussians to write", gaussians)
    rows = np.zeros(len(gaussians), dtype=ROW)
    clipped = reduce_to_splat(gaussians)
    rows["center"], rows["sigma"] = clipped.centers, clipped.scales
    rows["rgba"][:, :3] = np.rint(255.0 * (0.5 + SH_C0 * clipped.harmonics[:, 0].astype(np.float64)))
    rows["rgba"][:, 3] = np.rint(255.0 * clipped.opacities.astype(np.float64))
    quats = clipped.quats_wxyz.astype(np.float64)
    largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=1)[:, None], axis=1)
    rows["quat_wxyz"] = np.rint(128.0 - 128.0 * np.copysign(quats, quats * largest))
    path.write_bytes(rows.tobytes())


def read_splat(path: Path) -> tuple[GaussianSet, dict[str, str]]:
    """Read a ``.splat``, without comments. Raises InputError if truncated or invalid."""
    content = read_bytes(path)
    refuse_if(
        len(content) % ROW.itemsize, f"{path}: expected a multiple of 32 bytes, one row per splat, got {len(content)}"
    )
    rows = np.frombuffer(content, dtype=ROW)
    check_finite(str(path), len(rows), {"center": rows["center"], "sigma": rows["sigma"]})
    quats = (rows["quat_wxyz"].astype(np.float64) - 128.0) / 128.0
    gaussians = GaussianSet(
        centers=rows["center"].copy(),
        scales=rows["sigma"].copy(),
        quats_wxyz=unit_quaternions(str(path), quats),
        opacities=(rows["rgba"][:, 3] / 255.0).astype(np.float32),
        harmonics=(((rows["rgba"][:, :3].astype(np.float64) / 255.0) - 0.5) / SH_C0).astype(np.float32)[:, None, :],
        labels=np.zeros(len(rows), dtype=np.uint8),
    )
    check_gaussians(str(path), gaussians)
    return gaussians, {}


def reduce_to_splat(gaussians: GaussianSet) -> GaussianSet:
    """Limit to degree-0 colours in 0 to 1, without labels."""
    limit = 0.5 / SH_C0
    return replace(drop_labels(gaussians), harmonics=np.clip(gaussians.harmonics[:, :1], -limit, limit))


# Half a step of each byte: 1/510 of colour and opacity, 1/256 of quaternions. Four of 1/256 move a unit quaternion by
# at most 2/256, and turn by twice that: 0.9 degrees.
SPLAT_BOUND = Differences(
    center=0.0, sigma=0.0, rotation=0.9, color=0.5001 / 255, opacity=0.5001 / 255, harmonics=0.0
)

MAGIC = 0x5053474E  # NGSP
HEADER = struct.Struct("<IIIBBBB")  # magic, version, number, degree, fraction bits, flags, reserved
GZIP, PLAIN = b"\x1f\x8b", MAGIC.to_bytes(4, "little")  # a file of versions 2 and 3 begins so, one of version 4
PLAIN_HEADER = 32  # bytes
WAS_ANTIALIASED = 0x1  # of the flags: how it was trained, which changes no value
SPZ_RATIO = 100  # times the file's size, that splats unpack to beside FREE_BYTES: measured 2 to 9
FRACTION_BITS = 12  # steps of 0.24 mm up to 2 km, what other writers use; fewer for what is farther
COLOR_SCALE = 0.15 * 255.0  # steps per unit of an f_dc coefficient
LOG_SIGMAS = (-10.0, 255.0 / 16.0 - 10.0)  # of a byte / 16 - 10: 0.045 mm to 377 m
HARMONICS = (-1.0, 127.0 / 128.0)  # of (byte - 128) / 128
SQRT_HALF = float(np.sqrt(0.5))  # no component but the largest exceeds it


def write_spz(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    """Write what `.spz` can represent of `gaussians`, without `comments`."""
    check_gaussians("Gaussians to write", gaussians)
    clipped, bits = reduce_to_spz(gaussians), _fraction_bits(gaussians.centers)
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[clipped.harmonics.shape[1]]
    fixed = np.rint(np.ldexp(clipped.centers.astype(np.float64), bits)).astype("<i4")
    parts = [
        HEADER.pack(MAGIC, 3, len(clipped), degree, bits, 0, 0),
        fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
        np.rint(255.0 * clipped.opacities.astype(np.float64)).astype(np.uint8).tobytes(),
        np.rint(clipped.harmonics[:, 0] * COLOR_SCALE + 127.5).astype(np.uint8).tobytes(),
        np.rint(16.0 * (np.log(clipped.scales.astype(np.float64)) + 10.0)).astype(np.uint8).tobytes(),
        _packed_quaternions(clipped.quats_wxyz).tobytes(),
        np.rint(128.0 * clipped.harmonics[:, 1:] + 128.0).astype(np.uint8).tobytes(),
    ]
    path.write_bytes(gzip.compress(b"".join(parts), compresslevel=6, mtime=0))


def read_spz(path: Path) -> tuple[GaussianSet, dict[str, str]]:
    """Read an ``.spz`` file, in its own axes; comments are empty.

    Raises InputError if truncated, invalid, or not of version 2 to 4.
    """
    bits, (centers, opacities, colors, sigmas, quats, rest) = _columns(path, read_bytes(path))
    wide = np.zeros((len(centers), 3, 4), dtype=np.uint8)
    wide[:, :, 1:] = centers.reshape(-1, 3, 3)  # in the upper bytes: the shift back keeps the sign
    constant = ((colors / 255.0 - 0.5) / 0.15)[:, None]
    further = (rest / 128.0 - 1.0).reshape(len(rest), rest.shape[1] // 3, 3)
    gaussians = GaussianSet(
        centers=np.ldexp((wide.view("<i4")[:, :, 0] >> 8).astype(np.float64), -bits).astype(np.float32),
        scales=np.exp(sigmas / 16.0 - 10.0).astype(np.float32),
        quats_wxyz=_quaternions(quats),
        opacities=(opacities[:, 0] / 255.0).astype(np.float32),
        harmonics=np.concatenate([constant, further], axis=1).astype(np.float32),
        labels=np.zeros(len(centers), dtype=np.uint8),
    )
    check_gaussians(str(path), gaussians)
    return gaussians, {}


def reduce_to_spz(gaussians: GaussianSet) -> GaussianSet:
    """Clip to the format's ranges, without labels."""
    harmonics = np.clip(gaussians.harmonics, *HARMONICS)
    harmonics[:, 0] = np.clip(gaussians.harmonics[:, 0], -127.5 / COLOR_SCALE, 127.5 / COLOR_SCALE)
    return replace(
        drop_labels(gaussians),
        harmonics=harmonics,
        scales=np.clip(gaussians.scales, *np.exp(LOG_SIGMAS)).astype(np.float32),
    )


def spz_bound(gaussians: GaussianSet) -> Differences:
    """Half a step of each value, with a margin for float32.

    Sigma: a factor exp(1/32). Rotation: half a step of sqrt(1/2) / 511 in three components is 1.2e-3; the fourth
    doubles this, and the angle again: 0.28 degrees.
    """
    return Differences(
        center=0.5001 * (2.0 ** -_fraction_bits(gaussians.centers)),
        sigma=float(np.expm1(1 / 32)) + 1e-5,
        rotation=0.28,
        color=0.5001 * SH_C0 / COLOR_SCALE,
        opacity=0.5001 / 255,
        harmonics=0.5001 / 128,
    )


def _columns(path: Path, content: bytes) -> tuple[int, list[UInt8]]:
    """Fraction bits and bytes (N, width) by attribute."""
    start = content[:4]
    if start == PLAIN:
        num, bits, widths = _parse_head(path, content, (4,), len(content))
        parts = _streams(path, content, [num * width for width in widths])
    elif start[:2] == GZIP:
        num, bits, widths, body = _unzip(path, content)
        parts = [body[i:j] for i, j in pairwise(np.cumsum([0, *widths]) * num)]
    else:
        raise InputError(f"{path}: no .spz file: expected it to start as gzip or with NGSP, got {start.hex()}")
    return bits, [np.frombuffer(part, np.uint8).reshape(num, w) for part, w in zip(parts, widths, strict=True)]


def _parse_head(path: Path, head: bytes, versions: tuple[int, ...], size: int) -> tuple[int, int, tuple[int, ...]]:
    refuse_if(
        len(head) < HEADER.size or HEADER.unpack_from(head)[0] != MAGIC,
        f"{path}: no .spz file: expected it to start with {MAGIC:#x}, got {head[:4].hex()}",
    )
    _, version, num, degree, bits, flags, _ = HEADER.unpack_from(head)
    refuse_if(
        version not in versions,
        f"{path}: .spz version: expected 2 or 3 in gzip and 4 in plain, got {version}",
        remedy="write it as version 3",
    )
    refuse_if(
        degree > 3 or bits > 23, f"{path}: expected degree 0 to 3 and 0 to 23 fraction bits, got {degree} and {bits}"
    )
    refuse_if(
        flags & ~WAS_ANTIALIASED,
        f"{path}: has vendor extensions (flags {flags:#x}), expected none",
        remedy="write it without them",
    )
    widths = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * ((degree + 1) ** 2 - 1))
    refuse_if(
        num * sum(widths) > FREE_BYTES + SPZ_RATIO * size,
        f"{path}: announces {num} splats, more than a file of {size} bytes holds",
    )
    return num, bits, widths


def _unzip(path: Path, content: bytes) -> tuple[int, int, tuple[int, ...], bytes]:
    with (
        refuse_faults(
            f"{path}: no whole .spz file",
            gzip.BadGzipFile,
            EOFError,
            zlib.error,
            remedy="copy or write the file again",
        ),
        gzip.GzipFile(fileobj=BytesIO(content)) as stream,
    ):
        num, bits, widths = _parse_head(path, stream.read(HEADER.size), (2, 3), len(content))
        expected = num * sum(widths)
        body = stream.read(expected + 1)
    got = "more" if len(body) > expected else len(body)
    refuse_if(len(body) != expected, f"{path}: expected {expected} bytes for {num} splats, got {got}")
    return num, bits, widths, body


def _streams(path: Path, content: bytes, sizes: list[int]) -> list[bytes]:
    num_streams, place = content[HEADER.size - 1], int.from_bytes(content[HEADER.size : HEADER.size + 4], "little")
    start = place + 16 * num_streams
    refuse_if(
        num_streams not in (len(sizes), 5 if sizes[5] == 0 else 6) or not PLAIN_HEADER <= place <= len(content) - 16,
        f"{path}: .spz version 4: expected 6 streams after {PLAIN_HEADER} bytes, got {num_streams}",
    )
    table = np.frombuffer(content[place:start].ljust(16 * num_streams, b"\0"), "<u8").reshape(-1, 2).tolist()
    refuse_if(
        (expected := start + sum(packed for packed, _ in table)) != len(content),
        f"{path}: expected {expected} bytes, got {len(content)}",
        remedy="copy or write the file again",
    )
    parts = [b""] * len(sizes)
    for index, (packed, size) in enumerate(table):
        refuse_if(size != sizes[index], f"{path}: stream {index}: expected {sizes[index]} bytes unpacked, got {size}")
        with refuse_faults(f"{path}: stream {index}", BadBlockError, remedy="copy or write the file again"):
            parts[index] = unpacked(content[start : start + packed], "zstd", size, size)
        start += packed
    return parts


def _fraction_bits(centers: Float32) -> int:
    largest = float(np.abs(centers).max(initial=0.0))
    bits = FRACTION_BITS
    while largest * 2.0**bits > 2**23 - 1:
        bits -= 1
    refuse_if(bits < 0, f".spz: expected coordinates up to 8388 km, got {largest:g} m")
    return bits


def _packed_quaternions(quats_wxyz: Float32) -> NDArray[np.uint32]:
    """Little-endian words (N,).

    2 bits index the largest of x y z w; 10 bits (sign, size) follow for each other.
    """
    quats = np.roll(quats_wxyz.astype(np.float64), -1, axis=1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    sizes = np.rint(511.0 * np.minimum(np.abs(others) / SQRT_HALF, 1.0)).astype(np.uint32)
    words = largest.astype(np.uint32)
    for index in range(3):
        words = (words << np.uint32(10)) | (np.uint32(others[:, index] < 0) << np.uint32(9)) | sizes[:, index]
    return np.asarray(words, dtype="<u4")


def _quaternions(table: UInt8) -> Float32:
    if table.shape[1] == 3:
        xyz = table / 127.5 - 1.0
        quats = np.column_stack([xyz, np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1)))])
    else:
        words = np.ascontiguousarray(table).view("<u4")[:, 0]
        largest = (words >> np.uint32(30)).astype(np.intp)[:, None]
        fields = np.stack([(words >> np.uint32(shift)) & np.uint32(0x3FF) for shift in (20, 10, 0)], axis=1)
        others = SQRT_HALF * (fields & np.uint32(0x1FF)) / 511.0 * np.where(fields >> np.uint32(9), -1.0, 1.0)
        quats = np.zeros((len(words), 4))
        quats[np.arange(4) != largest] = others.ravel()
        np.put_along_axis(quats, largest, np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))[:, None], axis=1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return np.roll(quats, 1, axis=1).astype(np.float32)


ENTRIES = (
    SplatFormat(
        name=".splat, 32 bytes each",
        order=1,
        suffix=".splat",
        write=write_splat,
        read=read_splat,
        reduce=reduce_to_splat,
        bound=lambda _: SPLAT_BOUND,
        docs="""
`.splat` | 32 bytes per Gaussian, no header | colour, opacity 1/510; rotation 0.9 degrees | labels, density,
    comments, view-dependent colour, colours outside 0 to 1
""",
    ),
    SplatFormat(
        name=".spz",
        order=2,
        suffix=".spz",
        write=write_spz,
        read=read_spz,
        reduce=reduce_to_spz,
        bound=spz_bound,
        docs="""
`.spz` | version 3 (gzip); 2 to 4 are read | centre 0.12 mm (within 2 km), sigma 3.2 %, colour 0.0037, opacity
    1/510, rotation 0.28 degrees, harmonics 1/256 | labels, density, comments, sigmas below 0.045 mm, colours
    outside -0.44 to 1.44, harmonics outside -1 to 1
""",
    ),
)
