"""What a grid certifies is never above the exact distance, nor is what `safe` reads; how far it is from solids."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.certificate import Verdict, ask, judge
from benchmarks.field_accuracy import BAND, planar_bias, shape_rows
from benchmarks.surfaces import (
    LONE_SPLATS,
    LoneSplat,
    Shape,
    exact_distance,
    lone_splat,
    points_around,
    random_balls,
    shapes,
    splats_on,
)
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SafeField, SeField, SphereField
from splatctrl_cli.field.grid_cells import LOSS, GridField, check_loss
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import Box, DistanceGrid, Float64
from tests.field.scenes import plane, splat_set
from tests.refused import expect_refusal

NUM = 4000


@pytest.mark.parametrize("shape", shapes(with_meshes=False), ids=lambda shape: shape.name)
@pytest.mark.parametrize("is_inset", [False, True])
def test_no_query_at_a_covered_solid_breaks_a_promise(shape: Shape, is_inset: bool) -> None:
    assert_holds(ask(shape.name, *splats_on(shape, 0.02, is_inset=is_inset, seed=0), 0.02, NUM))


@pytest.mark.parametrize("voxel", [0.02, 0.05])
def test_no_query_among_balls_of_1_mm_to_30_cm_breaks_a_promise(voxel: float) -> None:
    assert_holds(ask("balls", *random_balls(60, seed=4), voxel, NUM))


@pytest.mark.parametrize(("scale", "shift"), [(0.02, 100.0), (100.0, 0.0), (1.0, 5000.0)])
def test_the_bound_holds_for_parts_and_halls_and_far_from_the_origin(scale: float, shift: float) -> None:
    centers, radii = random_balls(60, seed=4)
    centers = (scale * centers + shift).astype(np.float32).astype(np.float64)
    radii = (scale * radii).astype(np.float32).astype(np.float64)
    box = Box(lower=np.full(3, shift - 1.2 * scale), upper=np.full(3, shift + 1.2 * scale))
    excess = judge(
        "scaled", bake(splat_set(centers, radii), box, FieldConfig(voxel=0.05 * scale)), centers, radii, 4 * NUM
    ).excess
    for promise in ("bound_at_cell", "bound_nearest_cell", "bound_interpolated", "certified"):
        assert excess[promise][0] == 0, (promise, excess[promise])
    assert excess["certified"][1] > -2e-3 * scale
    assert excess["sdf_at_cell"][1] < 5e-7 * scale + 1e-6  # hard itself, in float32


def assert_holds(verdict: Verdict) -> None:
    assert verdict.holds, verdict.excess
    assert verdict.excess["certified"][1] > -0.02  # it does not hold by giving everything away
    assert verdict.given_away["certified"] < verdict.given_away["bound_nearest_cell"]
    assert verdict.interpolated_max > 0.0  # which is why there is a bound at all


@pytest.mark.parametrize(
    ("promise", "share"),
    [
        ("bound_at_cell", 1.01),
        ("bound_nearest_cell", 1.0),
        ("bound_interpolated", 1.0),
        ("certified", 1.2),
        ("sdf_at_cell", 0.0),
    ],
)
def test_what_is_above_the_exact_distance_is_found_out(promise: str, share: float) -> None:
    grid, centers, radii = balls_grid()
    grid.channels["bound"] = grid.channels["bound"] + np.float32(share * np.float32(grid.header["bound_margin"]))
    grid.channels["sdf"] = grid.channels["sdf"] + np.float32(0.0 if share else 1e-5)
    verdict = judge("doctored", grid, centers, radii, NUM)
    assert not verdict.holds and verdict.excess[promise][0] > 0


def balls_grid() -> tuple[DistanceGrid, Float64, Float64]:
    centers, radii = random_balls(60, seed=5)
    box = Box(lower=np.full(3, -1.1), upper=np.full(3, 1.1))
    return bake(splat_set(centers, radii), box, FieldConfig(voxel=0.04)), centers, radii


def test_cells_lose_at_most_a_diagonal_and_all_of_it_between_eight_balls() -> None:
    voxel, middle = 0.04, np.full(3, 0.02)
    corners = voxel * np.array(np.meshgrid(*[[0, 1]] * 3)).reshape(3, -1).T
    box = Box(lower=np.full(3, -0.2), upper=np.full(3, 0.2))
    for centers, radii in [(corners, np.full(8, 1e-6)), (middle[None], np.array([0.001])), random_balls(60, seed=5)]:
        field = GridField(bake(splat_set(centers, radii), box, FieldConfig(voxel=voxel, distance="hard")))
        points = np.random.default_rng(1).uniform(-0.2, 0.2, (20 * NUM, 3))
        points[0] = middle
        exact = exact_distance(points, centers, radii)
        lost = exact - field.certified(points)
        assert lost.min() > -1e-6 and lost.max() < LOSS * voxel + 1e-5
        assert np.abs(field.query(points)[0] - exact).max() < 0.5 * LOSS * voxel + 1e-5
        if len(centers) == 8:
            assert lost[0] == pytest.approx(np.sqrt(3) * voxel, abs=1e-5), "in the middle of eight balls it is all"


def test_cells_that_lose_more_than_allowed_are_refused_with_the_largest_that_do_not() -> None:
    check_loss(0.02, 0.04)
    expect_refusal(r"at most 0\.023 m, .* got 0\.3 m, .* 0\.5196 m", check_loss, 0.3, 0.04, error=UsageError)
    check_loss(0.023, 0.04)
    expect_refusal(r"field\.max_loss = 0.04 m", check_loss, 0.0231, 0.04, error=UsageError)


@pytest.mark.parametrize("distance", ["safe", "safe_gpdf"])
def test_safe_at_a_cell_is_never_above_the_exact_distance(distance: str) -> None:
    centers, radii = lone_splat(0.02, wall_spacing=0.01, radius=0.004)
    config = replace(FieldConfig(voxel=0.02), distance=distance)
    grid = bake(
        splat_set(centers, radii), Box(lower=np.array([-0.1, -0.2, -0.2]), upper=np.array([0.25, 0.2, 0.2])), config
    )
    assert judge("lone", grid, centers, radii, NUM).excess["sdf_at_cell"][0] == 0


@pytest.mark.parametrize("case", LONE_SPLATS, ids=str)
def test_safe_reads_no_clearance_that_a_lone_splat_takes(case: LoneSplat) -> None:
    centers, radii = lone_splat(case.wall, wall_spacing=case.spacing, radius=case.radius)
    points = before_the_splat(case.radius)
    hard = exact_distance(points, centers, radii)
    exact = SphereField(Spheres.of(centers, radii))
    for kernel in (
        SeField(Spheres.of(centers, radii), FieldConfig(length_scale=case.length)),
        GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=case.length)),
    ):
        alone = kernel.query(points)[0]
        assert (alone - hard).max() > 2e-3  # the kernel alone reads clearance that is not there
        safe = SafeField(exact, kernel).query(points)[0]
        assert (safe <= exact.query(points)[0]).all() and (safe <= hard + 1e-6).all()


def before_the_splat(radius: float) -> Float64:
    """Points from 2 mm to 15 cm before the lone splat, on the side that the wall is not on."""
    rng = np.random.default_rng(6)
    direction = rng.normal(size=(400, 3))
    direction[:, 0] = np.abs(direction[:, 0])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    along = np.stack([radius + np.linspace(0.002, 0.15, 70), np.zeros(70), np.zeros(70)], axis=1)
    return np.concatenate([along, (radius + rng.uniform(0.002, 0.15, (400, 1))) * direction])


NUM_NEAR = 1500


@pytest.mark.parametrize("shape", shapes(with_meshes=False), ids=lambda shape: shape.name)
def test_safe_is_within_a_millimetre_and_a_third_of_the_spacing(shape: Shape) -> None:
    """No over-estimate exceeds the spacing; the kernel of the paper under-estimates far away."""
    rows = shape_rows(shape, NUM_NEAR, [FieldConfig.weights])
    judged = [row for row in rows if row.field == "safe"]
    assert [row.weights for row in judged] == [FieldConfig.weights] * 4
    for row in judged:
        assert row.whole.count == NUM_NEAR
        assert row.is_kept, (row.shape, row.spacing, row.is_inset, row.whole.rmse)
        assert row.whole.over_max < row.spacing
    assert all(
        mean is not None and mean < -0.01 for mean in [row.bands[-1].mean for row in rows if row.field == "gpdf"]
    )


@pytest.mark.parametrize("shape", shapes(with_meshes=False), ids=lambda shape: shape.name)
def test_balls_inside_a_solid_read_no_less_than_the_distance_to_it(shape: Shape) -> None:
    points, truth = points_around(shape, NUM_NEAR, *BAND, seed=3)
    np.testing.assert_allclose(shape.signed(points), truth, atol=0)
    assert truth.min() >= BAND[0] and truth.max() < BAND[1]
    hard = SphereField(Spheres.of(*splats_on(shape, 0.02, is_inset=True, seed=0))).query(points)[0]
    assert (hard - truth).min() > -2.1e-4  # the tolerance of inscribed balls
    assert (hard - truth).max() < 0.02


@pytest.mark.parametrize("length", [0.02, 0.04])
def test_over_a_plane_the_kernel_of_the_paper_reads_the_closed_form(length: float) -> None:
    bias = planar_bias(length)
    assert bias.largest_difference < 1e-4
    assert bias.at_10_cm == pytest.approx(0.10 - length * np.log1p(0.10 / length), abs=1e-4)


def test_over_a_plane_the_gaussian_kernel_has_no_bias() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.01, 0.01, (NUM_NEAR, 2)), rng.uniform(0.01, 0.2, NUM_NEAR)])
    for radius in (0.0, 0.005):
        distance = SeField(Spheres.of(*plane(radius, 0.01, 0.45))).query(points)[0]
        np.testing.assert_allclose(distance, points[:, 2] - radius, atol=5e-5 + 1e-6)  # the truncation, and float32
