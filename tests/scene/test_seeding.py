"""Where new splats are asked for."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import SceneConfig, fixed
from splatctrl_cli.kernels.points import Cubes
from splatctrl_cli.records import Bool, Float32, RgbdFrame
from splatctrl_cli.scene.buffer import Seeds
from splatctrl_cli.scene.render import Rendering
from splatctrl_cli.scene.seeding import (
    SeedDensity,
    add_mask,
    candidates,
    cube_levels,
    gap_seeds,
    inside_workspace,
    leaves,
    seeds_at,
    thin_mask,
    thinning,
    tolerance_for,
    world_points,
)
from tests.plain import plain_splats
from tests.reference import images
from tests.scene.wall import WORKSPACE, frame

CONFIG = SceneConfig()


NOTHING = np.zeros((0, 3), np.float32)


def rendering(depth: Float32, opacity: float) -> Rendering:
    return Rendering(
        color=np.zeros((*depth.shape, 3), np.float32), depth=depth * opacity, opacity=np.full_like(depth, opacity)
    )


def asked(seen: RgbdFrame, shown: Float32, opacity: float, mappable: Bool) -> Bool:
    return add_mask(seen, rendering(shown, opacity), mappable, CONFIG)


def mappable_in(seen: RgbdFrame, *least: float) -> Bool:
    return inside_workspace(seen, WORKSPACE, *least)


def seeds_of(edge: float, beside: Float32 = NOTHING, config: SceneConfig = CONFIG) -> Seeds:
    """Seeds of the floor, one in each cube of a given edge."""
    return seeds_at(
        [candidates(frame(), np.ones((60, 80), bool))], beside, SeedDensity(edge=edge, tolerance=1e9), config
    )


@pytest.mark.parametrize("lambda_mde", [1.0, 40.0])
def test_seeded_pixels_are_those_of_the_reference(lambda_mde: float) -> None:
    """Random opacity about both thresholds, and a threshold between its floor and its ceiling."""
    rng, seen, config = np.random.default_rng(1), frame(), CONFIG.derived(lambda_mde=lambda_mde)
    opacity = rng.uniform(0.3, 1.0, seen.depth.shape).astype(np.float32)
    depth = (seen.depth * opacity * rng.normal(1.0, 0.02, opacity.shape)).astype(np.float32)
    mappable = rng.random(opacity.shape) < 0.8
    shown = Rendering(color=np.zeros((*depth.shape, 3), np.float32), depth=depth, opacity=opacity)
    wide = (image.astype(np.float64) for image in (depth, opacity, seen.depth))
    expected = images.add_mask(*wide, mappable, config, fixed.OPAQUE_ENOUGH)
    assert (add_mask(seen, shown, mappable, config) == expected).all()
    assert 100 < np.count_nonzero(expected) < 0.95 * np.count_nonzero(mappable)


FLOOR, BLOCK = frame(), frame(block=0.2)
EVERYWHERE = np.ones((60, 80), bool)


@pytest.mark.parametrize(
    ("seen", "shown", "opacity", "mappable", "expected"),
    [
        pytest.param(FLOOR, FLOOR, 0.0, mappable_in(FLOOR), mappable_in(FLOOR), id="all of an empty map"),
        pytest.param(FLOOR, FLOOR, 0.9, EVERYWHERE, ~EVERYWHERE, id="nothing of a perfect map"),
        pytest.param(BLOCK, FLOOR, 0.9, EVERYWHERE, BLOCK.depth < 0.9, id="what appears in front"),
        pytest.param(FLOOR, BLOCK, 0.9, EVERYWHERE, ~EVERYWHERE, id="not what vanished"),
    ],
)
def test_what_the_map_lacks_is_asked_for(
    seen: RgbdFrame, shown: RgbdFrame, opacity: float, mappable: Bool, expected: Bool
) -> None:
    assert np.array_equal(asked(seen, shown.depth, opacity, mappable), expected) and mappable.any()


def test_invalid_depth_is_never_asked_for() -> None:
    seen = frame()
    seen.depth[:30] = 0.0
    assert not mappable_in(seen)[:30].any() and not asked(seen, seen.depth, 0.0, mappable_in(seen))[:30].any()


def test_what_is_nearer_than_the_least_range_is_not_mapped() -> None:
    seen = frame(block=0.4)
    is_near, far = seen.depth < 0.7, mappable_in(seen, 0.7)
    assert mappable_in(seen)[is_near].all() and not far[is_near].any() and far.any()


def test_points_lie_on_the_floor_they_were_seen_on() -> None:
    assert np.abs(world_points(frame(x=0.1, y=-0.05))[..., 2]).max() < 1e-6


def coloured(count: int = 20000) -> tuple[Float32, Float32]:
    """Points on the plane z = 0, grey but for a chequered square at x, y > 0.5."""
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3)).astype(np.float32) * np.float32([1, 1, 0])
    checks = (np.floor(points[:, 0] / 0.02) + np.floor(points[:, 1] / 0.02)) % 2
    value = np.where((points[:, :2] > 0.5).all(axis=1), checks, 0.5)
    return points, np.repeat(value[:, None], 3, axis=1).astype(np.float32)


def test_cubes_are_split_where_the_colour_varies_and_nowhere_else() -> None:
    levels = cube_levels(*coloured(), 0.1, 3)
    coarse, middle, fine = leaves(levels, tolerance=1.0)
    assert (levels[0].points[coarse] < 0.51).any(axis=1).all() and not middle.any()
    assert (levels[2].points[fine, :2] > 0.5).all()
    count = sum(int(mask.sum()) for mask in leaves(levels, tolerance_for(levels, 900)))
    assert 700 < count <= 900  # the tolerance uses the budget


def test_cubes_are_split_at_an_edge_in_space() -> None:
    points, _ = coloured()
    bent = np.concatenate([points, points[:, [2, 1, 0]] * np.float32([1, 1, 0.2])])
    for at, is_split in ((bent, True), (points, False)):
        levels = cube_levels(at + np.float32(0.03), np.full_like(at, 0.5), 0.1, 2)
        assert leaves(levels, tolerance=0.5)[1].any() == is_split


def test_every_point_has_one_standing_cube() -> None:
    points, colors = coloured(3000)
    levels = cube_levels(points, colors, 0.1, 3)
    for tolerance in (0.01, 0.1, 1.0, 100.0):
        standing = leaves(levels, tolerance)
        held = np.zeros(len(points), int)
        for level, mask in zip(levels, standing, strict=True):
            cubes = {tuple(c) for c in np.floor(level.points[mask].astype(float) / level.edge).astype(int)}
            held += [tuple(c) in cubes for c in np.floor(points.astype(float) / level.edge).astype(int)]
        assert (held == 1).all()


def test_a_cube_stands_on_a_measured_point() -> None:
    points, colors = coloured(500)
    measured = {tuple(p) for p in points.tolist()}
    assert all(tuple(p) in measured for p in cube_levels(points, colors, 0.2, 1)[0].points.tolist())
    assert len(Cubes(NOTHING, 0.1, 2)) == 0


def test_nothing_is_seeded_beside_a_live_splat() -> None:
    first = seeds_of(0.05).centers
    for beside in (first, first + np.float32([0.015, 0.0, 0.0])):
        assert len(seeds_of(0.05, beside)) == 0
    half = first[first[:, 0] < 0]
    again = seeds_of(0.05, half).centers
    assert len(again) > 0.4 * len(first)
    assert np.linalg.norm(again[:, None] - half[None], axis=2).min() >= 0.7 * 0.05 - 1e-6


@pytest.mark.parametrize(("edge", "most", "radius"), [(0.004, 0.5, 1.0 / 80.0), (0.1, 0.5, 0.045), (0.1, 0.02, 0.02)])
def test_the_radius_is_that_of_the_cube_within_its_limits(edge: float, most: float, radius: float) -> None:
    """The least is that of one pixel: D / f."""
    assert np.allclose(seeds_of(edge, config=replace(CONFIG, max_radius=most)).radii, radius)


def test_a_measured_surface_far_from_every_sphere_is_seeded() -> None:
    seen, forgotten = frame(), np.float32([[0.3, 0.3, 0.4], [0.3, 0.3, 0.0]])
    points = world_points(seen).reshape(-1, 3)
    splats = plain_splats(points[np.linalg.norm(points[:, :2], axis=1) > 0.12], 0.02)  # of all but a hole
    seeds = gap_seeds([(seen, mappable_in(seen))], NOTHING, 0.02, splats, CONFIG)
    assert 5 < len(seeds) < 60 and np.linalg.norm(seeds.centers[:, :2], axis=1).max() < 0.12
    assert gap_seeds([], forgotten, 0.02, splats, CONFIG).centers.tolist() == forgotten[:1].tolist()


@pytest.mark.parametrize("half", [0, 1])
def test_the_two_halves_of_the_rows_are_looked_at_in_turn(half: int) -> None:
    seen, occupied = frame(), np.float32([[0, 0, 0.3], [0.1, 0, 0.3], [0.2, 0, 0.3], [0.3, 0, 0.3]])
    centers = gap_seeds([(seen, seen.depth > 0)], occupied, 0.02, plain_splats([], 0.02), CONFIG, half=half).centers
    in_air = centers[:, 2] > 0.2
    assert sorted(centers[in_air, 0].tolist()) == sorted(occupied[:, 0].tolist())
    rows = np.round(-centers[~in_air, 1] * 80.0 + 29.5)  # of the floor, 1 m below the camera
    assert len(rows) > 20 and (rows % 6 == 3 * half).all()


def test_more_pixels_than_are_looked_at_together_are_thinned_in_each_view(monkeypatch: pytest.MonkeyPatch) -> None:
    masks = [np.ones((60, 80), bool), np.zeros((60, 80), bool), np.eye(60, 80) > 0]
    assert thinning(masks) == 1 and thin_mask(masks[0], 1) is masks[0]
    monkeypatch.setattr("splatctrl_cli.config.fixed.SEED_MOST_PIXELS", 1000)
    assert (thinning(masks), [int(thin_mask(mask, 5).sum()) for mask in masks]) == (5, [960, 0, 12])
    assert not (thin_mask(masks[2], 5) & ~masks[2]).any()
