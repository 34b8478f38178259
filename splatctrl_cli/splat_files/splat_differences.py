"""By how much two sets of Gaussians differ, value by value, in units that a format's bound can be argued in."""

from dataclasses import asdict, dataclass

import numpy as np

from splatctrl_cli.records import Float32, Float64, GaussianSet
from splatctrl_cli.splat_files.splat_values import SH_C0


@dataclass(frozen=True, kw_only=True)
class Differences:
    """Largest difference of any Gaussian, or the largest that a format may cause.

    center [m]; sigma, relative; rotation [deg]; color and opacity, of 0 to 1; harmonics, coefficients above degree 0.
    """

    center: float
    sigma: float
    rotation: float
    color: float
    opacity: float
    harmonics: float

    def beyond(self, bound: "Differences") -> list[str]:
        """The names of what exceeds `bound`, each with its value and the bound."""
        limits = asdict(bound)
        pairs = ((name, value, limits[name]) for name, value in asdict(self).items())
        return [f"{name} {value:.3g} (at most {limit:.3g})" for name, value, limit in pairs if not value <= limit]


def float32_bound(gaussians: GaussianSet) -> Differences:
    """What a format of float32 values may cause: centres as they are, one rounding of everything else.

    A sigma's logarithm is at most 88 in size, so half a unit of its last place is 88 * 2^-24 = 5e-6 of the sigma.
    """
    largest_color = float(np.abs(gaussians.harmonics[:, 0]).max(initial=1.0))
    return Differences(center=0.0, sigma=6e-6, rotation=1e-4, color=1e-6 * largest_color, opacity=1e-6, harmonics=0.0)


def differences(a: GaussianSet, b: GaussianSet) -> Differences:
    """The largest differences between two sets of the same Gaussians in the same order."""
    return Differences(
        center=_largest(a.centers.astype(np.float64) - b.centers),
        sigma=_largest(b.scales / a.scales.astype(np.float64) - 1.0),
        rotation=_largest(_angles(a.quats_wxyz, b.quats_wxyz)),
        color=SH_C0 * _largest(a.harmonics[:, 0].astype(np.float64) - b.harmonics[:, 0]),
        opacity=_largest(a.opacities.astype(np.float64) - b.opacities),
        harmonics=_largest(_padded(a.harmonics)[:, 1:] - _padded(b.harmonics)[:, 1:]),
    )


def _largest(values: Float64) -> float:
    return float(np.abs(values).max(initial=0.0))


def _padded(harmonics: Float32) -> Float64:
    padded = np.zeros((len(harmonics), 16, 3))
    padded[:, : harmonics.shape[1]] = harmonics
    return padded


def _angles(a: Float32, b: Float32) -> Float64:
    """Angle [deg] between rotations of unit quaternions; a chord keeps its digits where a cosine has none."""
    one, two = a.astype(np.float64), b.astype(np.float64)
    chord = np.minimum(np.linalg.norm(one - two, axis=1), np.linalg.norm(one + two, axis=1))
    return np.asarray(np.degrees(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))))
