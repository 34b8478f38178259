"""Where new splats are asked for."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.records import Float32
from splatctrl_cli.scene.render import Rendering
from splatctrl_cli.scene.seeding import (
    add_mask,
    candidates,
    inside_workspace,
    seeds_at,
    spacing_for,
    thin,
    world_points,
)
from tests.scene.wall import WORKSPACE, frame

CONFIG = SceneConfig()


def rendering(depth: Float32, opacity: float) -> Rendering:
    full = np.full_like(depth, opacity)
    return Rendering(color=np.zeros((*depth.shape, 3), np.float32), depth=depth * opacity, opacity=full)


def test_an_empty_map_asks_for_every_mappable_pixel() -> None:
    seen = frame()
    mappable = inside_workspace(seen, world_points(seen), WORKSPACE)
    mask = add_mask(seen, rendering(seen.depth, 0.0), mappable, CONFIG)
    assert mappable.any()
    assert np.array_equal(mask, mappable)


def test_a_perfect_map_asks_for_nothing() -> None:
    seen = frame()
    everywhere = np.ones(seen.depth.shape, bool)
    assert not add_mask(seen, rendering(seen.depth, 0.9), everywhere, CONFIG).any()


def test_what_appears_in_front_is_asked_for_and_what_vanished_is_not() -> None:
    floor, block = frame(), frame(block=0.2)
    everywhere = np.ones(floor.depth.shape, bool)
    appeared = add_mask(block, rendering(floor.depth, 0.9), everywhere, CONFIG)
    assert np.array_equal(appeared, block.depth < 0.9)
    assert not add_mask(floor, rendering(block.depth, 0.9), everywhere, CONFIG).any()


def test_invalid_depth_is_never_asked_for() -> None:
    seen = frame()
    seen.depth[:30] = 0.0
    mappable = inside_workspace(seen, world_points(seen), WORKSPACE)
    assert not mappable[:30].any()
    assert not add_mask(seen, rendering(seen.depth, 0.0), mappable, CONFIG)[:30].any()


def test_points_lie_on_the_floor_they_were_seen_on() -> None:
    seen = frame(x=0.1, y=-0.05)
    assert np.abs(world_points(seen)[..., 2]).max() < 1e-6


def test_thinning_keeps_one_point_per_cube() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)).astype(np.float32)
    kept = points[thin(points, 0.25, np.random.default_rng(1))]
    cubes = {tuple(cube) for cube in np.floor(kept / 0.25).astype(int)}
    assert len(cubes) == len(kept) == 512


def test_the_spacing_uses_the_budget() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (20000, 3)).astype(np.float32) * np.float32([1, 1, 0])
    rng = np.random.default_rng(1)
    count = len(thin(points, spacing_for(points, 1000, rng), rng))
    assert 850 < count <= 1000  # 33 x 33 = 1089 cubes are too many, 30 x 30 to 31 x 31 fit


def test_nothing_is_seeded_beside_a_live_splat() -> None:
    seen = frame()
    everywhere = np.ones(seen.depth.shape, bool)
    source = candidates(seen, world_points(seen), everywhere)
    rng = np.random.default_rng(0)
    nothing = np.zeros((0, 3), np.float32)
    first = seeds_at([source], nothing, 0.05, CONFIG, rng).centers
    second = seeds_at([source], first, 0.05, CONFIG, rng).centers
    assert len(second) < 0.15 * len(first)  # only the gaps between the first ones
    gaps = np.linalg.norm(second[:, None] - first[None], axis=2).min(axis=1)
    assert gaps.min() >= 0.7 * 0.05 - 1e-6


def test_the_radius_is_that_of_the_spacing_within_its_limits() -> None:
    seen = frame()
    source = candidates(seen, world_points(seen), np.ones(seen.depth.shape, bool))
    nothing, rng = np.zeros((0, 3), np.float32), np.random.default_rng(0)
    pixel = 1.0 / 80.0  # D / f
    fine = seeds_at([source], nothing, 0.001, replace(CONFIG, max_radius=0.5), rng)
    coarse = seeds_at([source], nothing, 0.1, replace(CONFIG, max_radius=0.5), rng)
    capped = seeds_at([source], nothing, 0.1, CONFIG, rng)
    assert np.allclose(fine.radii, pixel)
    assert np.allclose(coarse.radii, 0.06)
    assert np.allclose(capped.radii, 0.02)
