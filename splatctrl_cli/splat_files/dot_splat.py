"""``.splat`` files, as the WebGL viewers read them: 32 bytes per Gaussian, no header.

Three float32 of the centre, three float32 of the sigmas, then bytes: red, green, blue, opacity (255 is 1), and a
quaternion w x y z as 128 q + 128. Colour by side, labels and comments have no place in it; the axes are world's.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import GaussianSet
from splatctrl_cli.splat_files.gaussian_ply import check_gaussians
from splatctrl_cli.splat_files.splat_format import (
    SH_C0,
    Differences,
    SplatFormat,
    check_finite,
    unit_quaternions,
    without_labels,
)

ROW = np.dtype([("center", "<f4", 3), ("sigma", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])


def write_splat(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    """Write `gaussians`, what of them the format can hold; `comments` are left out. Same input, same bytes.

    Of the two quaternions of a rotation the one whose largest component is negative: -1 has a byte, +1 has none.
    Raises InputError for a value that no Gaussian can have, naming its index.
    """
    check_gaussians("Gaussians to write", gaussians)
    rows = np.zeros(len(gaussians), dtype=ROW)
    held = held_by_splat(gaussians)
    rows["center"], rows["sigma"] = held.centers, held.scales
    rows["rgba"][:, :3] = np.rint(255.0 * (0.5 + SH_C0 * held.harmonics[:, 0].astype(np.float64)))
    rows["rgba"][:, 3] = np.rint(255.0 * held.opacities.astype(np.float64))
    quats = held.quats_wxyz.astype(np.float64)
    largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=1)[:, None], axis=1)
    rows["quat_wxyz"] = np.rint(128.0 - 128.0 * np.copysign(quats, quats * largest))
    path.write_bytes(rows.tobytes())


def read_splat(path: Path) -> tuple[GaussianSet, dict[str, str]]:
    """The Gaussians of a ``.splat`` file and no comments. Raises InputError for a file not whole, or no Gaussian."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) % ROW.itemsize:
        raise InputError(f"{path}: expected a multiple of 32 bytes, one row per splat, got {len(content)}")
    rows = np.frombuffer(content, dtype=ROW)
    check_finite(str(path), len(rows), {"center": rows["center"], "sigma": rows["sigma"]})
    quats = (rows["quat_wxyz"].astype(np.float64) - 128.0) / 128.0
    colors = rows["rgba"][:, :3].astype(np.float64) / 255.0
    gaussians = GaussianSet(
        centers=rows["center"].copy(),
        scales=rows["sigma"].copy(),
        quats_wxyz=unit_quaternions(str(path), quats),
        opacities=(rows["rgba"][:, 3] / 255.0).astype(np.float32),
        harmonics=((colors - 0.5) / SH_C0).astype(np.float32)[:, None, :],
        labels=np.zeros(len(rows), dtype=np.uint8),
    )
    check_gaussians(str(path), gaussians)
    return gaussians, {}


def held_by_splat(gaussians: GaussianSet) -> GaussianSet:
    """`gaussians` with colours of degree 0 alone, inside 0 to 1, and no labels: what a byte can be rounded from."""
    limit = 0.5 / SH_C0
    return replace(without_labels(gaussians), harmonics=np.clip(gaussians.harmonics[:, :1], -limit, limit))


def splat_bound(gaussians: GaussianSet) -> Differences:
    """Half a step of each byte: 1/510 of colour and opacity, 1/256 of each component of a quaternion.

    Four components of 1/256 move a unit quaternion by at most 2/256, which turns by twice that angle: 0.9 degrees.
    """
    return Differences(center=0.0, sigma=0.0, rotation=0.9, color=0.5001 / 255, opacity=0.5001 / 255, harmonics=0.0)


_DOCS = """
`.splat` | 32 bytes per Gaussian, no header | colour, opacity 1/510; rotation 0.9 degrees | labels, density,
    comments, view-dependent colour, colours outside 0 to 1
"""
ENTRIES = (
    SplatFormat(
        name=".splat, 32 bytes each",
        order=1,
        suffix=".splat",
        write=write_splat,
        read=read_splat,
        held=held_by_splat,
        bound=splat_bound,
        docs=_DOCS,
    ),
)
