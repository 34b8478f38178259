"""A splat format's declaration, and the first one: 3D-GS PLY, the reference implementation's 62 properties.

``x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3``, all float. ``scale_*`` is log(sigma), ``rot_*``
a quaternion w x y z, ``opacity`` a logit. ``f_dc_*`` and ``f_rest_*`` are harmonics; f_rest has all of red, then
green, then blue. A ``label`` (uchar) follows only if some Gaussian is not an object. ``scale_0`` without the
others is for all axes.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from splatctrl_cli.config.fixed import CENTER_LENGTH, CENTER_SHARE, SPARSEST, SPARSEST_SAMPLE
from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.formats.ply import PlyFile, check_properties, read_table, write_table
from splatctrl_cli.records import Array, Bool, Float32, Float64, Floats, GaussianSet, Label, UInt8, Values

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
UNIT_TOLERANCE = 5e-7  # of a quaternion's length; float32 can do no better
LOGIT_OF_ONE = 20.0  # finite, and its sigmoid is exactly 1 in float32
LOGIT_OF_ZERO = -110.0  # finite, and its sigmoid is exactly 0 in float32
Comments = dict[str, str]


def logit(opacities: Float32) -> Float64:
    """log(p / (1 - p)) of (N,) in [0, 1], finite at 0 and 1 (`sigmoid` restores these)."""
    inside = (opacities > 0) & (opacities < 1)
    p = np.where(inside, opacities, 0.5).astype(np.float64)
    return np.where(inside, np.log(p) - np.log1p(-p), np.where(opacities > 0.5, LOGIT_OF_ONE, LOGIT_OF_ZERO))


def sigmoid(logits: Float64) -> Float32:
    """1 / (1 + exp(-x)) of (N,) logits."""
    decay = np.exp(-np.minimum(np.abs(logits), 700.0))
    return np.asarray(np.where(logits >= 0, 1.0, decay) / (1.0 + decay), dtype=np.float32)


def sigma_of_log(where: str, name: str, logs: Float64) -> Float32:
    """exp(x) as float32 [m]. Raises InputError for a value outside normal float32."""
    values = np.exp(np.clip(logs, -700.0, 700.0))
    limits = np.finfo(np.float32)
    refuse(where, name, values, (values > limits.max) | (values < limits.tiny), "a radius that float32 holds [m]")
    return values.astype(np.float32)


def unit_quaternions(where: str, quats: Floats) -> Float32:
    """Normalise (N, 4), unchanged if already unit. Raises InputError for zero length."""
    wide = quats.astype(np.float64)
    lengths = np.linalg.norm(wide, axis=1, keepdims=True)
    refuse(where, "rotation", quats, np.asarray(~(lengths[:, 0] > 1e-12)), "a quaternion that is not zero")
    return np.where(np.abs(lengths - 1.0) <= UNIT_TOLERANCE, wide, wide / lengths).astype(np.float32)


def refuse(where: str, name: str, values: Array, is_bad: Bool, expected: str) -> None:
    """Raise InputError naming the first splat where `is_bad` (N,)."""
    bad = np.flatnonzero(is_bad)
    if len(bad):
        value = values[bad[0]]
        shown = f"{value:g}" if value.ndim == 0 else str(value)
        raise InputError(f"{where}: splat {bad[0]}: {name}: expected {expected}, got {shown}")


def check_finite(where: str, num: int, groups: Mapping[str, Array]) -> None:
    """Raise InputError at the first non-finite value, or for an array without `num` rows."""
    for name, values in groups.items():
        refuse_if(len(values) != num, f"{where}: {name}: expected {num} values, got {len(values)}")
        is_finite = np.isfinite(values.reshape(num, -1 if num else 1)).all(axis=1)
        refuse(where, name, values, np.asarray(~is_finite), "finite")


@dataclass(frozen=True, kw_only=True)
class Differences:
    """Largest differences between Gaussians, or a format's bound on them.

    center [m]; sigma, relative; rotation [deg]; color and opacity, of 0 to 1; harmonics above degree 0.
    """

    center: float
    sigma: float
    rotation: float
    color: float
    opacity: float
    harmonics: float

    def beyond(self, bound: "Differences") -> list[str]:
        """Names beyond `bound`, with both values."""
        limits = asdict(bound)
        pairs = ((name, value, limits[name]) for name, value in asdict(self).items())
        return [f"{name} {value:.3g} (at most {limit:.3g})" for name, value, limit in pairs if not value <= limit]


def float32_bound(gaussians: GaussianSet) -> Differences:
    """A float32 format's bound: exact centres, one rounding of other values.

    A log sigma is at most 88, so half a unit of its last place is 5e-6 of sigma.
    """
    largest_color = float(np.abs(gaussians.harmonics[:, 0]).max(initial=1.0))
    return Differences(center=0.0, sigma=6e-6, rotation=1e-4, color=1e-6 * largest_color, opacity=1e-6, harmonics=0.0)


def differences(a: GaussianSet, b: GaussianSet, centers: Float64 | None = None) -> Differences:
    """Largest differences between Gaussians in the same order; centers (N, 3) [m]: of `a`."""
    return Differences(
        center=_largest((a.centers.astype(np.float64) if centers is None else centers) - b.centers),
        sigma=_largest(b.scales / a.scales.astype(np.float64) - 1.0),
        rotation=_largest(_angles(a.quats_wxyz, b.quats_wxyz)),
        color=SH_C0 * _largest(a.harmonics[:, 0].astype(np.float64) - b.harmonics[:, 0]),
        opacity=_largest(a.opacities.astype(np.float64) - b.opacities),
        harmonics=_largest(_pad(a.harmonics)[:, 1:] - _pad(b.harmonics)[:, 1:]),
    )


def _largest(values: Float64) -> float:
    return float(np.abs(values).max(initial=0.0))


def _pad(harmonics: Float32) -> Float64:
    padded = np.zeros((len(harmonics), 16, 3))
    padded[:, : harmonics.shape[1]] = harmonics
    return padded


def _angles(a: Float32, b: Float32) -> Float64:
    one, two = a.astype(np.float64), b.astype(np.float64)
    chord = np.minimum(np.linalg.norm(one - two, axis=1), np.linalg.norm(one + two, axis=1))
    return np.asarray(np.degrees(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))))


@dataclass(frozen=True, kw_only=True)
class SplatFormat:
    """A splat file format, in its module's ``ENTRIES``.

    `write`: same input, same bytes; InputError for an invalid value. `reduce`: the representable part of a set;
    `bound`: the largest rounding; `check` raises UsageError without its library. `docs`: rows in docs/artefacts.md,
    an empty line between: suffix | what it is | what it rounds to | what it cannot represent.
    """

    name: str
    order: int
    suffix: str
    write: Callable[[Path, GaussianSet, Mapping[str, str]], None]
    read: Callable[[Path], tuple[GaussianSet, Comments]]
    reduce: Callable[[GaussianSet], GaussianSet] = lambda gaussians: gaussians
    bound: Callable[[GaussianSet], Differences] = float32_bound
    check: Callable[[], object] = lambda: None
    docs: str = ""

    @property
    def is_rounded(self) -> bool:
        return self.bound is not float32_bound


def drop_labels(gaussians: GaussianSet) -> GaussianSet:
    return replace(gaussians, labels=np.zeros_like(gaussians.labels))


REST = tuple(f"f_rest_{index}" for index in range(45))
NAMES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *REST, "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
VALUES = (*(name for name in NAMES if name not in {"nx", "ny", "nz"}), "label")  # what a Gaussian says
SCALES = ("scale_0", "scale_1", "scale_2")
REQUIRED = tuple(name for name in NAMES if name not in {"nx", "ny", "nz", "scale_1", "scale_2", *REST})
REST_PER_DEGREE = {0: 0, 9: 1, 24: 2, 45: 3}  # number of f_rest_* -> degree of the harmonics
HEADER_COMMENTS = {
    "frame": "world",
    "units": "metre",
    "splat": "anisotropic Gaussian; exp(scale_*) are its sigmas [m]; rot is w x y z; opacity is a logit",
}


def write_gaussian_ply(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    """Write `gaussians`, with frame, units and `comments` in the header.

    Harmonics above the set's degree are 0; opacities 0 and 1 read back exactly. Raises UsageError for a comment of
    several lines.
    """
    check_gaussians("Gaussians to write", gaussians)
    has_labels = bool((gaussians.labels != Label.OBJECT).any())
    dtype = np.dtype([*((name, "<f4") for name in NAMES), *([("label", "u1")] if has_labels else [])])
    write_table(path, rows_of(gaussians, dtype), {**HEADER_COMMENTS, **comments})


def rows_of(gaussians: GaussianSet, dtype: "np.dtype[Any]") -> Array:
    """Rows (N,) of `dtype`; properties that Gaussians do not have are 0."""
    g = gaussians
    rest = np.zeros((len(g), 3, 15), dtype=np.float32)
    rest[:, :, : g.harmonics.shape[1] - 1] = g.harmonics[:, 1:].transpose(0, 2, 1)
    colors = [*g.harmonics[:, 0].T, *rest.reshape(len(g), 45).T]
    shapes = [logit(g.opacities), *np.log(g.scales.astype(np.float64)).T, *g.quats_wxyz.T]
    rows = np.zeros(len(g), dtype=dtype)
    for name, column in zip(VALUES, [*g.centers.T, *colors, *shapes, g.labels], strict=True):
        if name in (dtype.names or ()):
            rows[name] = column
    return rows


def read_gaussian_ply(path: Path) -> tuple[GaussianSet, dict[str, str]]:
    """Read a 3D-GS PLY (binary or ASCII, any property order) and its ``key: value`` comments.

    Harmonics have the degree of ``f_rest_*`` (0, 9, 24 or 45), less all-zero top degrees. Quaternions are normalised;
    a missing label is 0 (object). Raises InputError if truncated, invalid or without a `REQUIRED` property.
    """
    ply = read_table(path, "vertex", REQUIRED)
    return gaussians_of(ply), ply.pairs()


def gaussians_of(ply: PlyFile) -> GaussianSet:
    """A PLY table's Gaussians. Raises as `read_gaussian_ply`."""
    path = ply.path
    check_properties(path, ply.names, REQUIRED)
    logs = log_sigmas(ply)
    scales = np.column_stack([sigma_of_log(str(path), f"scale_{axis}", logs[:, axis]) for axis in range(3)])
    gaussians = GaussianSet(
        centers=centers_of(ply, scales),
        scales=scales,
        quats_wxyz=unit_quaternions(str(path), np.column_stack([ply.column(f"rot_{index}") for index in range(4)])),
        opacities=sigmoid(ply.column("opacity")),
        harmonics=drop_zero_degrees(_harmonics(ply)),
        labels=labels_of(ply),
    )
    check_gaussians(str(path), gaussians)
    return gaussians


class RoundedError(InputError):
    """Centres that float32 would move."""


def exact_centers(ply: PlyFile) -> Float64:
    """(N, 3) float64 [m], as in the file."""
    return np.column_stack([ply.column(name) for name in "xyz"])


def centers_of(ply: PlyFile, sigmas: Float32) -> Float32:
    """Centres (N, 3) float32 [m]. Raises InputError if rounding moves splats too far.

    The limit follows from `sigmas` (N,) or (N, 3) [m] and their box's length.
    """
    exact = exact_centers(ply)
    centers = exact.astype(np.float32)
    if not len(ply):
        return centers
    size = max(float(np.median(sigmas)), CENTER_LENGTH * float(np.ptp(exact, axis=0).max()))
    largest, moved = float(np.abs(exact).max()), float(np.abs(exact - centers).max())
    step = float(np.spacing(np.float32(largest)))
    places = f"{ply.path}: centres up to {largest:.0f} m"
    refuse_if(
        moved > CENTER_SHARE * size,
        f"{places}: float32, in which splats are stored, has steps of {step:g} m there and would move them by"
        f" {moved:.3g} m",
        remedy=f"'splatctrl export {ply.path} -o OUT.ply' takes an origin off and names it; give OUT.ply",
        error=RoundedError,
    )
    refuse_if(
        step > size,
        f"{places}: were rounded to float32, whose steps of {step:g} m there are larger than the splats"
        f" (sigma {float(np.median(sigmas)):.3g} m)",
        remedy="write x, y and z again, as double or less an origin",
    )
    return centers


def log_sigmas(ply: PlyFile) -> Float64:
    """(N, 3) log(sigma [m]). Raises InputError for two scales, or scales that are no logarithms.

    Scales are no logarithms if none is below 0 and 95 % of splats exceed SPARSEST times their spacing.
    """
    names = [name for name in SCALES if name in ply.names]
    refuse_if(
        len(names) == 2,
        f"{ply.path}: expected scale_0 alone or scale_0 to scale_2, got {' and '.join(names)}: the flat splats of"
        " 2D-GS have no third sigma",
        remedy="write the log of a thickness [m] as scale_2",
    )
    logs = np.column_stack([ply.column(name if len(names) == 3 else "scale_0") for name in SCALES])
    if len(ply) < 2 or logs.min() < 0:
        return logs
    centers = exact_centers(ply)
    nearest = cKDTree(centers).query(centers[:: -(-len(centers) // SPARSEST_SAMPLE)], k=2)[0]
    spacing = float(np.median(np.asarray(nearest)[:, 1]))
    refuse_if(
        spacing > 0 and np.percentile(logs.mean(axis=1), 5) > np.log(SPARSEST * spacing),
        f"{ply.path}: scale_*: expected log(sigma [m]), got {logs.min():.3g} to {logs.max():.3g}: splats of"
        f" {np.exp(min(float(np.median(logs)), 700.0)):.3g} m, {spacing:.3g} m apart",
        remedy="the scales look like sigmas: write their logarithms"
        if np.median(logs) < SPARSEST * spacing
        else "write scales and centres in one unit",
    )
    return logs


def labels_of(ply: PlyFile) -> UInt8:
    """Labels (N,), 0 (object) by default. Raises InputError unless whole numbers 0 to 255."""
    if "label" not in ply.names:
        return np.zeros(len(ply), dtype=np.uint8)
    values = ply.column("label")
    is_bad = (values < 0) | (values > 255) | (values != np.floor(values))
    refuse(str(ply.path), "label", values, is_bad, "a whole number 0 to 255")
    return values.astype(np.uint8)


def drop_zero_degrees(harmonics: Float32) -> Float32:
    """(N, K, 3) up to the last nonzero degree: the same colours."""
    degree = 3
    while degree and not harmonics[:, degree * degree :].any():
        degree -= 1
    return np.ascontiguousarray(harmonics[:, : (degree + 1) ** 2])


def check_gaussians(where: str, gaussians: GaussianSet) -> None:
    """Raise InputError naming the first invalid Gaussian's index."""
    g = gaussians
    groups: dict[str, Values] = {"center": g.centers, "sigma": g.scales, "rotation": g.quats_wxyz}
    groups |= {"opacity": g.opacities, "harmonics": g.harmonics}
    check_finite(where, len(g), groups)
    refuse_if(
        g.harmonics.shape[1] not in (1, 4, 9, 16),
        f"{where}: harmonics: expected 1, 4, 9 or 16 coefficients, got {g.harmonics.shape[1]}",
    )
    refuse(where, "sigma", g.scales, np.asarray((g.scales <= 0).any(axis=1)), "more than 0 m")
    refuse(where, "opacity", g.opacities, (g.opacities < 0) | (g.opacities > 1), "0 to 1")
    lengths = np.linalg.norm(g.quats_wxyz.astype(np.float64), axis=1)
    refuse(where, "rotation", g.quats_wxyz, np.abs(lengths - 1) > 1e-3, "a unit quaternion w x y z")


def _harmonics(ply: PlyFile) -> Float32:
    num_rest = sum(name.startswith("f_rest_") for name in ply.names)
    names = [f"f_rest_{index}" for index in range(num_rest)]
    refuse_if(
        num_rest not in REST_PER_DEGREE or not all(name in ply.names for name in names),
        f"{ply.path}: f_rest_*: expected {', '.join(map(str, REST_PER_DEGREE))} of them in a row from 0, got"
        f" {num_rest}",
    )
    channels = [[f"f_dc_{channel}", *names[channel * num_rest // 3 :][: num_rest // 3]] for channel in range(3)]
    values = [[ply.column(name).astype(np.float32) for name in channel] for channel in channels]
    return np.ascontiguousarray(np.array(values).transpose(2, 1, 0))


_PLY = SplatFormat(
    name="3D-GS PLY",
    order=0,
    suffix=".ply",
    write=write_gaussian_ply,
    read=read_gaussian_ply,
    docs="""
`.ply`, short | 3D-GS PLY with `label` and `density`, for isotropic splats | float32 | view-dependent colour

`.ply`, full | 3D-GS PLY, the reference's 62 properties | float32 | density; labels are a 63rd property unless
    `--layout full`
""",
)
REFERENCE_PLY = replace(
    _PLY,
    name="3D-GS PLY, 62 properties",
    write=lambda path, gaussians, comments: write_gaussian_ply(path, drop_labels(gaussians), comments),
    reduce=drop_labels,
)
ENTRIES = (_PLY,)
