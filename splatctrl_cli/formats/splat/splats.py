"""Splat files: 3D-GS PLY, conversion from and to Gaussians, any format by suffix.

The PLY has the reference order without ``f_rest_*``: ``x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3``, then
``label`` (uchar) and ``density`` (float). Normals are zeros. ``scale_*`` are three equal log(radius), ``rot`` is 1 0
0 0, ``opacity`` a logit, ``f_dc`` ``(colour - 0.5) / C0``.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, SplatCtrlError, UsageError, refuse_if, require
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.formats.ply import PlyFile, read_table, write_table
from splatctrl_cli.formats.splat.gaussian_ply import (
    SH_C0,
    Comments,
    RoundedError,
    SplatFormat,
    centers_of,
    check_finite,
    exact_centers,
    gaussians_of,
    labels_of,
    log_sigmas,
    refuse,
    rows_of,
    sigma_of_log,
    sigmoid,
)
from splatctrl_cli.libraries import entries_of
from splatctrl_cli.records import Bool, Float32, Float64, Floats, GaussianSet, Label, SplatSet

MAX_SCALE_SPREAD = 1e-5  # largest difference of log scales that still reads as isotropic
NAMES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
DTYPE = np.dtype([*((name, "<f4") for name in NAMES), ("label", "u1"), ("density", "<f4")])
REQUIRED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0")
METRES = ("m", "metre", "metres", "meter", "meters")
ORIGIN = "origin"  # [m] that was taken off every centre
SHELL = {"shell": "beyond the robot's reach, for rendering only: distances ignore it"}
HEADER_COMMENTS = {
    "frame": "world",
    "units": "metre",
    "splat": "isotropic Gaussian; exp(scale_*) is its sigma [m]; opacity is a logit; f_dc (colour - 0.5) / 0.28209",
    "label": "0 object, 1 robot, 2 human; density is the kernel row sum, 0 where not computed",
}


def as_gaussians(splats: SplatSet) -> GaussianSet:
    coefficients = (splats.colors.astype(np.float64) - 0.5) / SH_C0
    return GaussianSet(
        centers=splats.centers,
        scales=np.repeat(splats.radii[:, None], 3, axis=1),
        quats_wxyz=np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (len(splats), 1)),
        opacities=splats.opacities,
        harmonics=coefficients.astype(np.float32)[:, None, :],
        labels=splats.labels,
    )


def as_splats(gaussians: GaussianSet, where: str) -> SplatSet:
    """Convert round Gaussians. Raises InputError counting stretched and view-dependent ones."""
    num_stretched = int(np.count_nonzero(_is_stretched(gaussians)))
    num_coloured = int(np.count_nonzero(gaussians.harmonics[:, 1:].any(axis=(1, 2))))
    refuse_if(
        num_stretched or num_coloured,
        f"{where}: expected isotropic splats, got {num_stretched} of {len(gaussians)} whose scales differ and "
        f"{num_coloured} whose colour depends on the view",
        remedy="'splatctrl export --isotropic' writes the nearest isotropic set",
    )
    return _round_splats(gaussians, gaussians.scales[:, 0])


def nearest_splats(gaussians: GaussianSet) -> SplatSet:
    """Splats of the Gaussians' volume (geometric mean of sigmas), opacity and mean colour."""
    return _round_splats(
        gaussians, np.exp(np.log(gaussians.scales.astype(np.float64)).mean(axis=1)).astype(np.float32)
    )


def _round_splats(gaussians: GaussianSet, radii: Float32) -> SplatSet:
    return SplatSet(
        centers=gaussians.centers,
        radii=np.ascontiguousarray(radii),
        colors=(0.5 + SH_C0 * gaussians.harmonics[:, 0].astype(np.float64)).astype(np.float32),
        opacities=gaussians.opacities,
        labels=gaussians.labels,
        density=np.zeros(len(gaussians), dtype=np.float32),
    )


def _is_stretched(gaussians: GaussianSet) -> Bool:
    logs = np.log(gaussians.scales.astype(np.float64))
    return np.asarray(logs.max(axis=1) - logs.min(axis=1) > MAX_SCALE_SPREAD)


def write_ply(path: Path, splats: SplatSet, comments: Mapping[str, str]) -> None:
    """Write `splats`, with frame, units and `comments` in the header.

    Opacities 0 and 1 read back exactly. Raises InputError for an invalid value, UsageError for a comment of several
    lines.
    """
    check_splats("splats to write", splats)
    rows = rows_of(as_gaussians(splats), DTYPE)
    rows["density"] = splats.density
    write_table(path, rows, {**HEADER_COMMENTS, **comments})


def read_ply(path: Path) -> tuple[SplatSet, dict[str, str]]:
    """Read a 3D-GS PLY (binary or ASCII, any property order) and its ``key: value`` comments.

    Ignores other properties; a missing label is 0 (object), a missing density 0 (not computed). Raises InputError if
    truncated, anisotropic, invalid or without a `REQUIRED` property.
    """
    ply = read_table(path, "vertex", REQUIRED)
    return splats_of(ply), ply.pairs()


def read_world_splats(path: Path) -> SplatSet:
    """Read a PLY; comments name no unit but metres, no frame but world.

    Raises InputError as `read_ply` and `check_world`.
    """
    splats, comments = read_ply(path)
    check_world(path, comments)
    return splats


def check_world(path: Path, comments: Mapping[str, str]) -> None:
    """Raise InputError for comments of another unit or frame, or a shell."""
    check_no_shell(path, comments)
    for key, known in (("units", METRES), ("frame", ("world",))):
        comment = comments.get(key)
        refuse_if(
            comment is not None and comment.lower() not in known,
            f"{path}: comment '{key}: {comment}': expected {known[0]}",
            remedy="distances are in metres in the world: transform the splats, and correct the comment",
        )


def check_no_shell(path: Path, comments: Mapping[str, str]) -> None:
    """Raise InputError for a shell, which is only rendered."""
    refuse_if(
        SHELL.keys() & comments.keys(),
        f"{path}: the shell beyond the robot's reach, which is rendered only and has no distances",
        remedy="give the scene's folder, or its splats.ply",
    )


def read_shell(path: Path) -> SplatSet:
    """Read a shell. Raises InputError for other splats, or an invalid PLY."""
    splats, comments = read_ply(path)
    refuse_if(
        not SHELL.keys() <= comments.keys(),
        f"{path}: expected a shell, got other splats",
        remedy="reconstruct the scene again",
    )
    return splats


def splats_of(ply: PlyFile) -> SplatSet:
    """A PLY table's splats. Raises as `read_ply`."""
    path = ply.path
    num = num_stretched(ply)
    refuse_if(
        num,
        f"{path}: expected isotropic splats (three equal scale_*), got {num} of {len(ply)} whose scales differ",
        remedy="distances are defined on spheres: 'splatctrl export --isotropic' writes the nearest such set;"
        " score renders them as they are",
    )
    radii = sigma_of_log(str(path), "scale_0", log_sigmas(ply)[:, 0])
    splats = SplatSet(
        centers=centers_of(ply, radii),
        radii=radii,
        colors=np.column_stack([0.5 + SH_C0 * ply.column(f"f_dc_{axis}") for axis in range(3)]).astype(np.float32),
        opacities=sigmoid(ply.column("opacity")),
        labels=labels_of(ply),
        density=(ply.column("density") if "density" in ply.names else np.zeros(len(ply))).astype(np.float32),
    )
    check_splats(str(path), splats)
    return splats


def num_stretched(ply: PlyFile) -> int:
    scales = log_sigmas(ply)
    spread = scales.max(axis=1, initial=-np.inf) - scales.min(axis=1, initial=np.inf)
    return int(np.count_nonzero(spread > MAX_SCALE_SPREAD))


def check_splats(where: str, splats: SplatSet) -> None:
    """Raise InputError at the first splat with invalid numbers, radius or opacity."""
    groups = {
        "center": splats.centers,
        "radius": splats.radii,
        "colour": splats.colors,
        "opacity": splats.opacities,
        "density": splats.density,
    }
    check_finite(where, len(splats), groups)
    refuse(where, "radius", splats.radii, splats.radii <= 0, "more than 0 m")
    refuse(where, "opacity", splats.opacities, (splats.opacities < 0) | (splats.opacities > 1), "0 to 1")


FORMATS: Mapping[str, SplatFormat] = {kind.suffix: kind for kind in entries_of(__package__, SplatFormat)}


def format_of(path: Path, error: type[SplatCtrlError] = UsageError) -> SplatFormat:
    """The suffix's format, PLY without one. Raises `error` if unknown."""
    what = f"{path}: expected a suffix of {', '.join(FORMATS)}, got {path.suffix}"
    return require(FORMATS.get(path.suffix.lower() or ".ply"), what, error=error)


def read_splats(path: Path) -> tuple[SplatSet | GaussianSet, Comments]:
    """Read any splat file and its comments, as a SplatSet if isotropic with constant colour.

    Raises InputError if missing, truncated, unknown or invalid.
    """
    kind = format_of(path, InputError)
    if kind is not FORMATS[".ply"]:
        gaussians, comments = kind.read(path)
        is_round = not (_is_stretched(gaussians).any() or gaussians.harmonics[:, 1:].any())
        return (as_splats(gaussians, str(path)) if is_round else gaussians), comments
    ply = read_table(path, "vertex", REQUIRED)
    return _splats_or_gaussians(ply), ply.pairs()


def read_source(path: Path) -> tuple[SplatSet | GaussianSet, Comments, Float64]:
    """Read as `read_splats`, with the centres (N, 3) float64 [m] in the file's precision.

    If float32 would move the centres, an origin is subtracted, which comment `ORIGIN` gives. Raises InputError as
    `read_splats`.
    """
    if format_of(path, InputError) is not FORMATS[".ply"]:
        splats, comments = read_splats(path)
        return splats, comments, splats.centers.astype(np.float64)
    ply = read_table(path, "vertex", REQUIRED)
    comments, exact = ply.pairs(), exact_centers(ply)
    try:
        return _splats_or_gaussians(ply), comments, exact
    except RoundedError:
        if ORIGIN in comments:
            raise
        origin = np.round((exact.min(axis=0) + exact.max(axis=0)) / 2, -2)
        fields = [(name, "<f8" if name in "xyz" else ply.rows.dtype[name]) for name in ply.names]
        moved = replace(ply, rows=ply.rows.astype(np.dtype(fields)))
        for name, column in zip("xyz", (exact - origin).T, strict=True):
            moved.rows[name] = column
        named = " ".join(f"{value:.0f}" for value in origin)
        return _splats_or_gaussians(moved), {**comments, ORIGIN: named}, exact - origin


def _splats_or_gaussians(ply: PlyFile) -> SplatSet | GaussianSet:
    has_rest = any(name.startswith("f_rest_") and ply.column(name).any() for name in ply.names)
    return splats_of(ply) if num_stretched(ply) == 0 and not has_rest else gaussians_of(ply)


def read_spheres(path: Path) -> SplatSet:
    """Read any splat file as spheres in the world, dropping view-dependent colour.

    Raises InputError if invalid, anisotropic, or in another unit or frame.
    """
    if (path.suffix.lower() or ".ply") == ".ply":
        return read_world_splats(path)
    splats, comments = read_splats(path)
    check_world(path, comments)
    if isinstance(splats, GaussianSet):
        splats = as_splats(replace(splats, harmonics=splats.harmonics[:, :1]), str(path))
    return splats


def describe_splats(path: Path, _head: bytes) -> Summary:
    """Summarise a splat file. Raises InputError for another kind."""
    splats, comments = read_splats(path)
    gaussians = as_gaussians(splats) if isinstance(splats, SplatSet) else splats
    ranges: dict[str, Floats] = (
        {}
        if not len(gaussians)
        else {
            "lower_m": gaussians.centers.min(axis=0),
            "upper_m": gaussians.centers.max(axis=0),
            "sigma_m": np.percentile(gaussians.scales, [0, 50, 100]),
            "opacity": np.percentile(gaussians.opacities, [0, 50, 100]),
        }
    )
    labels = {label.name.lower(): int(np.count_nonzero(gaussians.labels == label)) for label in Label}
    facts: dict[str, object] = {
        "format": format_of(path).name,
        "splats": len(gaussians),
        "shape": "isotropic" if isinstance(splats, SplatSet) else "anisotropic",
        "degree_of_harmonics": int(np.sqrt(gaussians.harmonics.shape[1])) - 1,
        **({"labels": labels} if (gaussians.labels != Label.OBJECT).any() else {}),
        **{name: [float(f"{value:.4g}") for value in values] for name, values in ranges.items()},
        "comments": comments,
    }
    return Summary(path=str(path), kind="splats", facts=facts)
