"""Every field moves, turns and scales with its splats, does not care for their order, and has its own gradient.

Kernels compute in float32 relative to the middle of the splats: within half a metre of it a coordinate, and so a
distance, is off by 3e-8 m at most, a few of which add up. Terms are left out down to `TRUNCATION`, which moves a
kernel's distance by that much and its gradient by the share left out, TRUNCATION / l.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SafeField, SeField, SphereField
from splatctrl_cli.records import DistanceField, Float64
from tests.field.scenes import cloud, queries
from tests.reference import field as reference

LENGTH, TRUNCATION = 0.02, 1e-7  # [m]
DISTANCE, GRADIENT = 1e-6, 2e-4  # tolerances: rounding and truncation together [m], and of unit vectors
CG_NOISE = (
    1e-2  # with less the system is so ill-conditioned that rounding of the centres moves its solution by 0.1 mm
)
Make = Callable[[Float64, Float64, float], DistanceField]


def gpdf(centers: Float64, radii: Float64, scale: float, **more: Any) -> GpdfField:
    return GpdfField(
        Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH * scale, truncation=TRUNCATION * scale, **more)
    )


def se(centers: Float64, radii: Float64, scale: float, **more: Any) -> SeField:
    return SeField(
        Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH * scale, truncation=TRUNCATION * scale, **more)
    )


FIELDS: dict[str, Make] = {
    "hard": lambda centers, radii, scale: SphereField(Spheres.of(centers, radii)),
    "gpdf": gpdf,
    "se": se,
    "safe": lambda centers, radii, scale: SafeField(
        SphereField(Spheres.of(centers, radii)), se(centers, radii, scale)
    ),
    "gpdf of the full process": partial(gpdf, noise=CG_NOISE, weights="cg"),
    "se of the full process": partial(se, noise=CG_NOISE, weights="cg"),
}
each_field = pytest.mark.parametrize("make", FIELDS.values(), ids=FIELDS)


@cache
def smooth_points(margin: float) -> Float64:
    """Queries at least 1 cm outside the splats, where no field of the four has a kink within `margin` [m].

    Kinks are where two spheres are as near, and where se and hard change places.
    """
    centers, radii = cloud()
    points = queries(1500)
    each = np.sort(reference.distances(points, centers) - radii, axis=1)
    is_single = (each[:, 0] > 0.01) & (each[:, 1] - each[:, 0] > 2 * margin)
    kernel = SeField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH, truncation=TRUNCATION))
    has_value = np.isfinite(kernel.query_raw(points)[0])
    return points[is_single & has_value & (np.abs(kernel.query(points)[0] - each[:, 0]) > 2 * margin)]


def rotation() -> Float64:
    turned = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    return np.asarray(turned * np.sign(np.linalg.det(turned)))


@each_field
@pytest.mark.parametrize("scale", [1.0, 0.01, 40.0])
def test_the_distance_scales_with_the_scene_and_the_gradient_turns_with_it(make: Make, scale: float) -> None:
    centers, radii = cloud()
    points, R = smooth_points(1e-5), rotation() if scale == 1.0 else np.eye(3)
    shift = np.array([3.0, -2.0, 0.7]) if scale == 1.0 else np.zeros(3)
    before, gradient = make(centers, radii, 1.0).query(points)
    moved, there = scale * centers @ R.T + shift, scale * points @ R.T + shift
    after, turned = make(moved, scale * radii, scale).query(there)
    assert len(points) > 500
    np.testing.assert_allclose(after / scale, before, atol=DISTANCE)
    np.testing.assert_allclose(turned, gradient @ R.T, atol=GRADIENT)


@each_field
def test_the_order_of_the_splats_does_not_matter(make: Make) -> None:
    """To the bit for hard, a least of numbers; a sum rounds by its order, so within the tolerance for the others."""
    centers, radii = cloud()
    order = np.random.default_rng(8).permutation(len(radii))
    points = smooth_points(1e-5)
    before, gradient = make(centers, radii, 1.0).query(points)
    after, same = make(centers[order], radii[order], 1.0).query(points)
    if make is FIELDS["hard"]:
        np.testing.assert_array_equal(after, before)
        np.testing.assert_array_equal(same, gradient)
    np.testing.assert_allclose(after, before, atol=DISTANCE)
    np.testing.assert_allclose(same, gradient, atol=GRADIENT)


@each_field
def test_the_gradient_is_the_central_difference_of_the_distance(make: Make) -> None:
    """Of fourth order, from steps of h = 0.5 mm and h / 2.

    Far away se passes from one group of splats to another within millimetres, so that its third derivative makes a
    plain difference at h / 2 err by 1e-3. Rounding of each distance to 1e-7 adds at most (4 * 2 + 1) / 3 * 2e-4.
    """
    centers, radii = cloud()
    step, field = 5e-4, make(centers, radii, 1.0)
    points = smooth_points(2 * step)
    if isinstance(field, SeField):  # which takes the exact distance where it has none: a jump, with signed weights
        around = [
            field.query_raw(points + s * h * np.eye(3)[a])[0] for a in range(3) for s in (-1, 1) for h in (step, 0)
        ]
        points = points[~np.isnan(around).any(axis=0)]
    assert len(points) > 300
    gradient = field.query(points)[1]
    for axis in range(3):
        wide, narrow = (central_difference(field, points, h * np.eye(3)[axis]) for h in (step, step / 2))
        np.testing.assert_allclose(gradient[:, axis], (4 * narrow - wide) / 3, atol=6e-4)


def central_difference(field: DistanceField, points: Float64, shift: Float64) -> Float64:
    return (field.query(points + shift)[0] - field.query(points - shift)[0]) / (2 * np.linalg.norm(shift))
