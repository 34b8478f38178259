"""Checks that splats are dense and thick enough for a distance field."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from splatctrl_cli.config.fixed import MAX_RADIUS_SPREAD, ROUGH_LENGTH
from splatctrl_cli.records import Floats


@dataclass(frozen=True, kw_only=True)
class FieldHealth:
    """Ratios that decide a field's quality, with warnings.

    spacing: median distance to the nearest other splat [m], 0 for a single splat; radius: median [m];
    planar_zero_level: height [m] where a dense plane's kernel field is zero.
    """

    spacing: float
    radius: float
    spacing_per_length: float
    radius_per_spacing: float | None
    radius_per_length: float
    planar_zero_level: float
    warnings: tuple[str, ...]


def field_health(centers: Floats, radii: Floats, length: float, *, kernels: Collection[str]) -> FieldHealth:
    """Health of splats (N, 3), (N,) [m] for kernels (se, gpdf) of this length scale [m]."""
    spacing, radius = median_spacing(centers), float(np.median(radii))
    zero_level = planar_zero_level(radius, length)
    return FieldHealth(
        spacing=spacing,
        radius=radius,
        spacing_per_length=spacing / length,
        radius_per_spacing=radius / spacing if spacing > 0 else None,
        radius_per_length=radius / length,
        planar_zero_level=zero_level,
        warnings=(
            *_warnings(spacing, radius, length, zero_level, kernels),
            *_set_warnings(centers, radii, length, has_kernel=bool(kernels)),
        ),
    )


def _warnings(
    spacing: float, radius: float, length: float, zero_level: float, kernels: Collection[str]
) -> Iterable[str]:
    if radius < spacing / np.sqrt(2):
        yield (
            f"radius {radius * 1e3:.1f} mm is below spacing / sqrt 2 = {spacing / np.sqrt(2) * 1e3:.1f} mm: "
            "the exact field's surface has holes between splats; reconstruct with more splats (--max-splats)"
        )
    if kernels and spacing > length:
        yield (
            f"spacing {spacing * 1e3:.1f} mm exceeds the length scale {length * 1e3:.1f} mm: "
            "the kernel field does not join neighbouring splats; give a larger --length-scale, or more splats"
        )
    if "gpdf" in kernels and zero_level - radius > length:
        yield (
            f"the surface of gpdf stands {zero_level * 1e3:.1f} mm before a dense plane of splats, "
            f"{(zero_level - radius) * 1e3:.1f} mm beyond their radius; a smaller length scale brings it closer"
        )


def _set_warnings(centers: Floats, radii: Floats, length: float, *, has_kernel: bool) -> Iterable[str]:
    extent = float(np.ptp(centers.astype(np.float64), axis=0).max())
    if len(centers) > 1 and extent == 0.0:
        yield f"all {len(centers)} splats stand at one place: the field is that of the largest; check the file"
    elif has_kernel and len(centers) > 1 and length > extent:
        yield (
            f"the length scale {length:g} m exceeds the extent of the splats, {extent:.3g} m: "
            "the kernel field cannot tell them apart; give a smaller --length-scale"
        )
    if has_kernel and length >= ROUGH_LENGTH:
        yield f"the length scale {length:g} m is so large that rounding shows in the fields; give a smaller one"
    thick = radii[radii > 0]
    if len(thick) and thick.max() > MAX_RADIUS_SPREAD * thick.min():
        yield (
            f"radii from {thick.min() * 1e3:.3g} to {thick.max() * 1e3:.3g} mm in one set: "
            "the median radius and its ratios stand for neither end; check the splats' unit, metres"
        )


def median_spacing(centers: Floats) -> float:
    """Median distance from a splat (N, 3) [m] to the nearest other one; 0 for fewer than two."""
    if len(centers) < 2:
        return 0.0
    points = np.asarray(centers, dtype=np.float64)
    return float(np.median(np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1]))


def planar_zero_level(radius: float, length: float) -> float:
    """Height z [m] over a dense plane of splats where the Matern row-sum field is zero.

    The field is ``z - l log(1 + z / l) - r``. (The integral of ``e^(-d/l)`` over a plane is ``2 pi l (z + l)
    e^(-z/l)``, the row sum ``2 pi l^2``.) Newton's method starts above, where it is convex.
    """
    z = radius + length * (1.0 + np.sqrt(2.0 * radius / length))
    for _ in range(50):
        z -= (z - length * float(np.log1p(z / length)) - radius) / max(z / (length + z), 1e-12)
    return float(max(z, 0.0))
