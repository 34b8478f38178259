"""What is asked of many points has NumPy's bytes, at any thread count."""

import numpy as np
import pytest

from splatctrl_cli.geometry import invert_transform, look_at, transform_points
from splatctrl_cli.kernels import points as kernels
from splatctrl_cli.kernels.raster import pack_camera
from splatctrl_cli.records import Box, Float32, Float64, Intrinsics, RgbdFrame
from tests.plain import plain_frame
from tests.reference import points as reference

RNG = np.random.default_rng(7)
THREADS = (1, 2, 5)
needs_fma = pytest.mark.skipif(kernels.native.x86_64_level() < 3, reason="BLAS adds up otherwise without FMA")


def frame(width: int, height: int) -> RgbdFrame:
    """A camera somewhere, a depth of noise with holes."""
    depth = np.where(RNG.random((height, width)) < 0.8, RNG.uniform(0.5, 3.0, (height, width)), 0.0)
    intrinsics = Intrinsics(fx=71.3, fy=69.9, cx=width / 2 + 0.3, cy=height / 3, width=width, height=height)
    return plain_frame(depth, intrinsics, look_at(RNG.normal(size=3), RNG.normal(size=3)))


def packed(seen: RgbdFrame, T: Float64) -> Float64:
    k = seen.intrinsics
    return pack_camera(k.fx, k.fy, k.cx, k.cy, k.width, k.height, T)


def crowd(count: int) -> tuple[Float32, Float32]:
    """Points of which many share a cube, and some a place; their colours."""
    points = (RNG.normal(size=(count, 3)) * [1.0, 2.0, 0.3]).astype(np.float32)
    points[::3, 2] = 0.25
    points[count // 2 : count // 2 + count // 10] = points[: count // 10]
    return points, RNG.random((count, 3)).astype(np.float32)


@needs_fma
@pytest.mark.parametrize(("width", "height"), [(64, 48), (7, 33)])
def test_pixels_are_back_projected_row_after_row(width: int, height: int) -> None:
    seen, chosen = frame(width, height), RNG.random((height, width)) < 0.3
    wanted, camera = reference.world_points(seen), packed(seen, seen.T_world_camera)
    for threads in THREADS:
        np.testing.assert_array_equal(kernels.back_projected(camera, seen.depth, chosen, threads), wanted[chosen])
    np.testing.assert_array_equal(kernels.back_projected(camera, seen.depth), wanted.reshape(-1, 3))
    assert len(kernels.back_projected(camera, seen.depth, np.zeros_like(chosen))) == 0


@needs_fma
@pytest.mark.parametrize(("width", "height"), [(64, 48), (7, 33)])
def test_pixels_inside_a_box_are_those_whose_points_are(width: int, height: int) -> None:
    seen = frame(width, height)
    points = reference.world_points(seen)[seen.depth > 0]
    lower, upper = np.percentile(points, [10, 90], axis=0, method="nearest")  # points on its sides
    box = Box(lower=lower, upper=upper)
    camera, wanted = packed(seen, seen.T_world_camera), reference.are_inside(seen, box, 1.5)
    assert 0 < np.count_nonzero(wanted) < np.count_nonzero(reference.are_inside(seen, box, 0.0))
    for threads in THREADS:
        np.testing.assert_array_equal(
            kernels.are_inside(camera, seen.depth, box.lower, box.upper, 1.5, threads), wanted
        )


@needs_fma
@pytest.mark.parametrize("count", [0, 1, 64, 3000])
def test_points_are_shown_by_the_pixels_of_their_rays(count: int) -> None:
    """Also behind the camera and beside the image."""
    seen = frame(80, 60)
    points = RNG.normal(size=(count, 3)).astype(np.float32)
    points[::3] = reference.world_points(seen).reshape(-1, 3)[: len(points[::3])]
    pixel, z = kernels.pixels_at(points, packed(seen, invert_transform(seen.T_world_camera)))
    wanted = reference.pixels_at(seen, points)
    np.testing.assert_array_equal(pixel, wanted[0])
    np.testing.assert_array_equal(z, wanted[1].astype(np.float32))
    assert count < 3000 or 500 < np.count_nonzero(pixel < 0) < 2500


@needs_fma
def test_a_point_is_seen_through_where_any_view_looks_past_it() -> None:
    views = [frame(80, 60) for _ in range(4)]
    nearest = [np.where(view.depth > 0, view.depth, np.float32(np.inf)) for view in views]
    points = np.concatenate([reference.world_points(view).reshape(-1, 3) * RNG.uniform(0.9, 1.1) for view in views])
    points = points.astype(np.float32)
    each = [reference.seen_through(points, view, depth, 0.015) for view, depth in zip(views, nearest, strict=True)]
    assert 0 < np.mean(each) < 1
    cameras = [packed(view, invert_transform(view.T_world_camera)) for view in views]
    for threads in THREADS:
        np.testing.assert_array_equal(
            kernels.seen_through(points, cameras, nearest, 0.015, threads), np.any(each, axis=0)
        )


@pytest.mark.parametrize(("count", "edge"), [(1, 0.1), (7, 0.1), (40000, 0.08), (40000, 3.0), (5000, 1e-4)])
def test_cubes_have_the_sums_of_their_points_in_order(count: int, edge: float) -> None:
    points, colors = crowd(count)
    wanted = reference.cube_means(points, colors, edge)
    for threads in THREADS:
        cubes = kernels.Cubes(points, edge, threads)
        of_point, first = cubes.members()
        np.testing.assert_array_equal(of_point, wanted["of_point"])
        np.testing.assert_array_equal(first, np.unique(of_point, return_index=True)[1])
        means = cubes.means(colors)
        for name in ("count", "center", "color", "square", "covariance", "nearest"):
            np.testing.assert_array_equal(getattr(means, name), wanted[name], err_msg=name)


def test_a_cube_is_found_however_far_its_points_lie() -> None:
    """Where cubes cannot be numbered in 64 bits, as long as they are not 2^21 of an axis apart."""
    points = np.float32([[-0.5, 0.5, 0.5], [1e6, 0.5, 0.5], [1e6, -1e6, 0.5], [1e6, 0.5, 1e6], [-0.5, 0.5, 0.6]])
    assert len(kernels.Cubes(points, 1.0, 1)) == 4


@pytest.mark.parametrize(("count", "gap"), [(1, 0.1), (5, 0.1), (3000, 0.02), (3000, 0.0)])
def test_points_are_further_than_the_eight_nearest_balls(count: int, gap: float) -> None:
    """The ninth does not count, however large it is."""
    centers, radii = RNG.random((count, 3)).astype(np.float32), (0.06 * RNG.random(count)).astype(np.float32)
    radii[0] = 0.5
    points = RNG.uniform(-0.2, 1.2, (4000, 3))
    wanted = reference.are_further(centers, radii, points, gap)
    for threads in THREADS:
        np.testing.assert_array_equal(kernels.SplatTree(centers, radii, threads).are_further(points, gap), wanted)
    if count == 3000:
        all_balls = (np.linalg.norm(points[:, None] - centers[:1], axis=2) - radii[:1])[:, 0] > gap
        assert (wanted & ~all_balls).any()


def test_without_balls_everything_is_further() -> None:
    none = np.zeros((0, 3), np.float32)
    assert kernels.SplatTree(none, np.zeros(0, np.float32), 1).are_further(np.zeros((3, 3)), 1.0).all()
    with pytest.raises(ValueError, match="finite"):
        kernels.SplatTree(np.float32([[np.nan, 0, 0]]), np.ones(1, np.float32), 1)


@needs_fma
def test_distances_to_solids_are_the_least_of_each() -> None:
    solids, wanted, points = [], [], RNG.normal(size=(3000, 3))
    for kind in (0.0, 1.0, 2.0, 3.0, 3.0, 0.0):
        T, size = look_at(RNG.normal(size=3), RNG.normal(size=3)), RNG.uniform(0.1, 0.5, 3)
        solids.append([kind, *T[:3, :3].ravel(), *T[:3, 3], *size])
        wanted.append(reference.solid_distance(kind, size, transform_points(T, points)))
    for threads in THREADS:
        np.testing.assert_array_equal(
            kernels.solid_distance(points, np.array(solids), threads), np.min(wanted, axis=0)
        )
    assert (np.min(wanted, axis=0) < 0).any()
    assert np.all(kernels.solid_distance(points, np.zeros((0, 16))) == np.inf)
