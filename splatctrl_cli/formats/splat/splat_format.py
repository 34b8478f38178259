"""A splat format's declaration: writing, reading, representable values, precision."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.records import Array, Bool, Float32, Float64, Floats, GaussianSet

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
    """exp(x) as float32 [m]. Raises InputError for one outside normal float32."""
    values = np.exp(np.clip(logs, -700.0, 700.0))
    limits = np.finfo(np.float32)
    refuse(where, name, values, (values > limits.max) | (values < limits.tiny), "a radius that float32 holds [m]")
    return values.astype(np.float32)


def unit_quaternions(where: str, quats: Floats) -> Float32:
    """Normalise (N, 4), bit-exact if already unit. Raises InputError for zero length."""
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
    """A float32 format's bound: centres exact, one rounding of the rest.

    A log sigma is at most 88 in size: half a unit of its last place is 5e-6 of sigma.
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
    """Angle [deg] by the chord, precise where a cosine is not."""
    one, two = a.astype(np.float64), b.astype(np.float64)
    chord = np.minimum(np.linalg.norm(one - two, axis=1), np.linalg.norm(one + two, axis=1))
    return np.asarray(np.degrees(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))))


@dataclass(frozen=True, kw_only=True)
class SplatFormat:
    """A splat file format, in its module's ``ENTRIES``.

    `held`: the representable part of a set; `bound`: the largest rounding; `check` raises UsageError without its
    library. `docs`: rows in docs/artefacts.md, an empty line between: suffix | what it is | what it rounds to | what
    it cannot represent.
    """

    name: str
    order: int
    suffix: str
    write: Callable[[Path, GaussianSet, Mapping[str, str]], None]
    read: Callable[[Path], tuple[GaussianSet, Comments]]
    held: Callable[[GaussianSet], GaussianSet] = lambda gaussians: gaussians
    bound: Callable[[GaussianSet], Differences] = float32_bound
    check: Callable[[], object] = lambda: None
    docs: str = ""

    @property
    def is_rounded(self) -> bool:
        """True if coarser than float32."""
        return self.bound is not float32_bound


def without_labels(gaussians: GaussianSet) -> GaussianSet:
    return replace(gaussians, labels=np.zeros_like(gaussians.labels))
