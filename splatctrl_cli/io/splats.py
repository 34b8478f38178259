"""Splat sets as 3D-GS PLY files: what stock viewers open, plus label and density.

Layout: the reference implementation's names and order without ``f_rest_*`` (degree-0 colour): ``x y z nx ny nz
f_dc_0..2 opacity scale_0..2 rot_0..3``, then ``label`` (uchar) and ``density`` (float). The normals are zeros:
readers that go by the header skip them, readers that go by the reference's order need them. ``scale_*`` are three
equal log(radius), ``rot`` is 1 0 0 0, ``opacity`` is a logit and ``f_dc`` is ``(colour - 0.5) / C0``.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.io.ply import PlyFile, read_table
from splatctrl_cli.records import Float32, Float64, SplatSet

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
LOGIT_OF_ONE = 20.0  # finite, and its sigmoid is exactly 1 in float32
LOGIT_OF_ZERO = -110.0  # finite, and its sigmoid is exactly 0 in float32
MAX_SCALE_SPREAD = 1e-5  # largest difference of log scales that still reads as isotropic

NAMES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
DTYPE = np.dtype([*((name, "<f4") for name in NAMES), ("label", "u1"), ("density", "<f4")])
REQUIRED = tuple(name for name in NAMES if name not in {"nx", "ny", "nz"} and not name.startswith("rot_"))
HEADER_COMMENTS = {
    "frame": "world",
    "units": "metre",
    "splat": "isotropic Gaussian; exp(scale_*) is its sigma [m]; opacity is a logit; f_dc (colour - 0.5) / 0.28209",
    "label": "0 object, 1 robot, 2 human; density is the kernel row sum, 0 where not computed",
}


def write_ply(path: Path, splats: SplatSet, comments: Mapping[str, str]) -> None:
    """Write `splats`; frame, units, what the scales mean and `comments` go in the header. Same input, same bytes.

    Opacities of exactly 0 and 1 are written as finite logits that read back as exactly 0 and 1. Characters outside
    ASCII in comments are written as backslash escapes, because readers of the format stop at them.
    Raises InputError for a value the format cannot hold, naming its index; UsageError for a comment of several lines.
    """
    _check_values(splats, "splats to write")
    vertices = np.zeros(len(splats), dtype=DTYPE)
    for axis, name in enumerate("xyz"):
        vertices[name] = splats.centers[:, axis]
    coefficients = (splats.colors.astype(np.float64) - 0.5) / SH_C0
    log_radii = np.log(splats.radii.astype(np.float64))
    for axis in range(3):
        vertices[f"f_dc_{axis}"] = coefficients[:, axis]
        vertices[f"scale_{axis}"] = log_radii
    vertices["opacity"] = _logit(splats.opacities)
    vertices["rot_0"] = 1.0
    vertices["label"] = splats.labels
    vertices["density"] = splats.density
    path.write_bytes(_header(len(splats), {**HEADER_COMMENTS, **comments}) + vertices.tobytes())


def read_ply(path: Path) -> tuple[SplatSet, dict[str, str]]:
    """The splat set of a 3D-GS PLY file (binary or ASCII, properties in any order) and its ``key: value`` comments.

    A comment without a colon is a key with an empty value. Other properties (normals, higher harmonics, rotation) are
    ignored; a missing label is 0 (object), a missing density 0 (not computed).
    Raises InputError for a file that is not whole, lacks a property, is anisotropic or holds no valid splat.
    """
    ply = read_table(path, "vertex", REQUIRED)
    _check_isotropic(path, ply)
    radii = _finite_cast(path, "scale_0", np.exp(np.clip(ply.column("scale_0"), -700.0, 700.0)))
    splats = SplatSet(
        centers=np.column_stack([ply.column(name) for name in "xyz"]).astype(np.float32),
        radii=radii,
        colors=np.column_stack([0.5 + SH_C0 * ply.column(f"f_dc_{axis}") for axis in range(3)]).astype(np.float32),
        opacities=_sigmoid(ply.column("opacity")),
        labels=_labels(path, ply),
        density=(ply.column("density") if "density" in ply else np.zeros(len(ply))).astype(np.float32),
    )
    _check_values(splats, str(path))
    return splats, _parse_comments(ply.comments)


def _header(num_splats: int, comments: Mapping[str, str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    for key, value in comments.items():
        if not key or ":" in key or any(mark in key + value for mark in "\r\n"):
            raise UsageError(f"PLY comment {key!r}: expected one line and a key without a colon, got {value!r}")
        lines.append(f"comment {key}: {value}".rstrip() if value else f"comment {key}")
    lines.append(f"element vertex {num_splats}")
    lines += [f"property float {name}" for name in NAMES]
    lines += ["property uchar label", "property float density", "end_header", ""]
    return "\n".join(lines).encode("ascii", "backslashreplace")


def _parse_comments(lines: tuple[str, ...]) -> dict[str, str]:
    comments = {}
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip():
            comments[key.strip()] = value.strip()
    return comments


def _logit(opacities: Float32) -> Float64:
    inside = (opacities > 0) & (opacities < 1)
    p = np.where(inside, opacities, 0.5).astype(np.float64)
    logit = np.log(p) - np.log1p(-p)
    return np.where(inside, logit, np.where(opacities > 0.5, LOGIT_OF_ONE, LOGIT_OF_ZERO))


def _sigmoid(logit: Float64) -> Float32:
    decay = np.exp(-np.minimum(np.abs(logit), 700.0))
    return np.asarray(np.where(logit >= 0, 1.0, decay) / (1.0 + decay), dtype=np.float32)


def _finite_cast(path: Path, name: str, values: Float64) -> Float32:
    """float32, refusing what becomes infinite or zero on the way."""
    limits = np.finfo(np.float32)
    bad = np.flatnonzero((values > limits.max) | (values < limits.tiny))
    if len(bad):
        raise InputError(f"{path}: splat {bad[0]}: {name} gives a radius of {values[bad[0]]:g} m, no finite radius")
    return values.astype(np.float32)


def _labels(path: Path, ply: PlyFile) -> NDArray[np.uint8]:
    if "label" not in ply:
        return np.zeros(len(ply), dtype=np.uint8)
    values = ply.column("label")
    bad = np.flatnonzero((values < 0) | (values > 255) | (values != np.floor(values)))
    if len(bad):
        raise InputError(f"{path}: splat {bad[0]}: label: expected a whole number 0 to 255, got {values[bad[0]]:g}")
    return values.astype(np.uint8)


def _check_isotropic(path: Path, ply: PlyFile) -> None:
    scales = np.column_stack([ply.column(f"scale_{axis}") for axis in range(3)])
    spread = scales.max(axis=1, initial=-np.inf) - scales.min(axis=1, initial=np.inf)
    num_anisotropic = int(np.count_nonzero(spread > MAX_SCALE_SPREAD))
    if num_anisotropic:
        raise InputError(
            f"{path}: expected isotropic splats (three equal scale_*), got {num_anisotropic} of {len(ply)} "
            "whose scales differ",
            remedy="distances are defined on spheres: export an isotropic set",
        )


def _check_values(splats: SplatSet, where: str) -> None:
    """Raise InputError at the first splat that has no place in the world: NaN, no radius, opacity outside [0, 1]."""
    groups = {
        "center": splats.centers,
        "radius": splats.radii,
        "colour": splats.colors,
        "opacity": splats.opacities,
        "density": splats.density,
    }
    for name, values in groups.items():
        if len(values) != len(splats):
            raise InputError(f"{where}: {name}: expected {len(splats)} values, got {len(values)}")
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), values[:1].size or 1)).all(axis=1))
        if len(bad):
            raise InputError(f"{where}: splat {bad[0]}: {name}: expected finite, got {values[bad[0]]}")
    for name, values, is_bad in (
        ("radius", splats.radii, splats.radii <= 0),
        ("opacity", splats.opacities, (splats.opacities < 0) | (splats.opacities > 1)),
    ):
        bad = np.flatnonzero(is_bad)
        if len(bad):
            expected = "more than 0 m" if name == "radius" else "0 to 1"
            raise InputError(f"{where}: splat {bad[0]}: {name}: expected {expected}, got {values[bad[0]]:g}")
