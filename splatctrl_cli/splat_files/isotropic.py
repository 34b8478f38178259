"""Isotropic splats as Gaussians, and back: exactly where they are round, else by a rule that says what it loses."""

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Bool, Float32, GaussianSet, SplatSet
from splatctrl_cli.splat_files.splat_values import SH_C0

MAX_SCALE_SPREAD = 1e-5  # largest difference of log scales that still reads as isotropic


def as_gaussians(splats: SplatSet) -> GaussianSet:
    """`splats` as Gaussians of one sigma and one colour; the density has no place there."""
    quats = np.zeros((len(splats), 4), dtype=np.float32)
    quats[:, 0] = 1.0
    coefficients = (splats.colors.astype(np.float64) - 0.5) / SH_C0
    return GaussianSet(
        centers=splats.centers,
        scales=np.repeat(splats.radii[:, None], 3, axis=1),
        quats_wxyz=quats,
        opacities=splats.opacities,
        harmonics=coefficients.astype(np.float32)[:, None, :],
        labels=splats.labels,
    )


def is_isotropic(gaussians: GaussianSet) -> bool:
    """True where every Gaussian is round and looks the same from every side."""
    return not (_is_stretched(gaussians).any() or gaussians.harmonics[:, 1:].any())


def as_splats(gaussians: GaussianSet, where: str) -> SplatSet:
    """Gaussians that are round, as splats. Raises InputError with how many are not, or change colour by side."""
    num_stretched = int(np.count_nonzero(_is_stretched(gaussians)))
    num_coloured = int(np.count_nonzero(gaussians.harmonics[:, 1:].any(axis=(1, 2))))
    if num_stretched or num_coloured:
        raise InputError(
            f"{where}: expected isotropic splats, got {num_stretched} of {len(gaussians)} whose scales differ and "
            f"{num_coloured} whose colour depends on the side",
            remedy="'splatctrl export --isotropic' writes the nearest isotropic set",
        )
    return _splats(gaussians, gaussians.scales[:, 0])


def nearest_splats(gaussians: GaussianSet) -> SplatSet:
    """Splats of the Gaussians' volume (radius: geometric mean of sigmas), opacity, and mean colour over all sides.

    What is lost: orientation, flatness (a flat Gaussian becomes thicker and narrower), colour by side.
    """
    return _splats(gaussians, np.exp(np.log(gaussians.scales.astype(np.float64)).mean(axis=1)).astype(np.float32))


def _splats(gaussians: GaussianSet, radii: Float32) -> SplatSet:
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
