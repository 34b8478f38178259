"""Why splats are removed, who gives a slot to surface that has none, and what idle slots become."""

from functools import partial
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import EVICT_EVERY, EVICT_NEARER
from splatctrl_cli.records import Box, Float64, Label, RgbdFrame, SplatSet
from splatctrl_cli.scene.buffer import SplatBuffer
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import View, make_view, seen_through
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.removal import (
    clone_shape,
    clone_sources,
    detail_seeds,
    distance_to_box,
    draw_indices,
    find_far,
    find_redundant,
    removals,
    room_for,
)
from splatctrl_cli.voxels import SWEPT
from tests.plain import plain_splats
from tests.reference.unrepresented import unrepresented
from tests.scene.wall import HEIGHT, INTRINSICS, WORKSPACE, frame, plain_seeds

FLOOR, AIR, OUTSIDE, BELOW = [0.2, 0.2, 0.0], [0.2, 0.2, 0.3], [3.0, 0.0, 0.0], [0.0, 0.0, 0.1]


NONE = np.zeros(6, bool)


def view(seen: RgbdFrame) -> View:
    return make_view(seen, seen.depth > 0)


def buffer(row: tuple[int, int] = (0, 3), value: float | None = None) -> SplatBuffer:
    """Four splats: on the floor, in the air, outside the workspace, inside a block that nobody looked into."""
    slots = SplatBuffer(6)
    slots.fill(plain_seeds([FLOOR, AIR, OUTSIDE, BELOW], 0.02), 0.5)
    if value is not None:
        slots.parameters[row] = value
    return slots


@pytest.fixture(scope="module", params=["observed", "literal"])
def grid(request: pytest.FixtureRequest) -> OccupancyMap:
    made = OccupancyMap(WORKSPACE, OccupancyConfig(rule=request.param, uncertain_patience=1), 1)
    for _ in range(3):
        made.integrate(frame(block=0.2))
    return made


@pytest.mark.parametrize(
    ("change", "trail", "expected"),
    [
        pytest.param({}, [], {"free": [1]}, id="surfaces stay"),
        pytest.param({"row": (0, 7), "value": -4.0}, [0, 4], {"opacity": [0], "free": [1]}, id="first reason only"),
        pytest.param({"row": (0, 1), "value": np.nan}, [], {"broken": [0], "free": [1]}, id="broken numbers"),
        pytest.param({}, [0], {"free": [1], "trail": [0]}, id="a trail from the surface it lies on"),
    ],
)
def test_the_literal_rule_removes_the_never_seen_too(
    grid: OccupancyMap, change: dict[str, Any], trail: list[int], expected: dict[str, list[int]]
) -> None:
    """Both take free air and what is outside, and leave dead slots alone."""
    slots, is_trail = buffer(**change), np.isin(np.arange(6), trail)
    reasons = removals(slots, grid, WORKSPACE, 0.1, is_trail=is_trail, is_floating=NONE)
    found = {reason: np.flatnonzero(mask).tolist() for reason, mask in reasons.items() if mask.any()}
    assert found == {"workspace": [2]} | expected | ({"uncertain": [3]} if grid.config.rule == "literal" else {})
    slots.kill(~NONE)
    assert not any(
        mask.any() for mask in removals(slots, grid, WORKSPACE, 0.1, is_trail=NONE, is_floating=NONE).values()
    )


@pytest.mark.parametrize("counts_time", [True, False])
def test_uncertainty_is_tolerated_for_a_while(counts_time: bool) -> None:
    """Only time steps count."""
    grid, slots = OccupancyMap(WORKSPACE, OccupancyConfig(uncertain_patience=2), 1), buffer()
    grid.integrate(frame())
    grid.log_odds[grid.num_updates > 0] = 0.0
    asking = partial(removals, slots, grid, WORKSPACE, 0.1, is_trail=NONE, is_floating=NONE, counts_time=counts_time)
    assert [bool(asking()["uncertain"].any()) for _ in range(3)] == [False, False, counts_time]
    assert slots.num_uncertain.any() == counts_time


BLOCK = frame(block=0.2)
ROBOT = make_view(BLOCK, BLOCK.depth > 0, is_robot=BLOCK.depth < 0.9, reach=0.04)
IN_THE_AIR = [[0.1, 0.1, 0.0], [0.1, 0.1, 0.01], [0.1, 0.1, 0.03], [0.1, 0.1, -0.1]]
AT_THE_RIM = [[0.099, 0.0, 0.2], [0.105, 0.0, 0.2], [0.16, 0.0, 0.2]]
AT_THE_ROBOT = [[0.105, 0.0, 0.2], [0.12, 0.0, 0.2], [0.12, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("points", "seen", "label", "floats"),
    [
        pytest.param(IN_THE_AIR, view(frame()), Label.OBJECT, [False, False, True, False], id="above a floor"),
        pytest.param(AT_THE_RIM, view(BLOCK), Label.OBJECT, [False, False, True], id="beside a silhouette"),
        pytest.param(AT_THE_ROBOT, ROBOT, Label.OBJECT, [False, True, False], id="beside the robot"),
        pytest.param(AT_THE_ROBOT, ROBOT, Label.ROBOT, [False, False, False], id="of the robot"),
    ],
)
def test_a_splat_that_a_camera_sees_through_floats(
    points: list[list[float]], seen: View, label: Label, floats: list[bool]
) -> None:
    """The robot's own splats may stand three pixels beside its silhouette, an object's not."""
    assert seen_through(np.float32(points), [seen], 0.015, label=label).tolist() == floats


def test_what_no_camera_looks_at_does_not_float() -> None:
    blind, ending = frame(), frame()
    blind.depth[:], ending.depth[:, :20] = 0.0, 0.0
    points = np.float32([[0.1, 0.1, 0.3], [9.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    at_the_border = np.float32([[-39.0 / 80.0 * 0.7, 0.0, 0.3]])  # where an image ends without depth
    for where, views in ((points, [blind]), (points[1:], [frame()]), (points, []), (at_the_border, [ending])):
        assert not seen_through(where, [view(seen) for seen in views], 0.015).any()


PATH = Box(lower=np.zeros(3), upper=np.ones(3))


def floor(spacing: float) -> SplatSet:
    """Splats all over a square of 40 cm."""
    steps = np.arange(0.0, 0.4, spacing)
    return plain_splats([[x, y, 0.0] for x in steps for y in steps], 0.01)


VOXELS = floor(0.02).centers + np.float32([0.0, 0.0, 0.004])


def bare(splats: SplatSet, tolerance: float) -> int:
    return int(unrepresented(VOXELS, splats.centers.astype(float), splats.radii.astype(float), tolerance).sum())


def test_what_is_given_up_leaves_no_surface_bare() -> None:
    """The first in the order go, and no more than are wanted."""
    splats = floor(0.02)
    order, num = np.random.default_rng(0).permutation(len(splats)), len(splats)
    gone = find_redundant(order, num, splats, VOXELS, 0.018)
    assert 50 < len(gone) < num
    kept = splats.select(~np.isin(np.arange(num), gone))
    assert bare(splats, 0.018) == bare(kept, 0.018) == 0
    assert len(find_redundant(np.arange(len(kept)), len(kept), kept, VOXELS, 0.018)) == 0
    few = find_redundant(order, 3, splats, VOXELS, 0.018)
    assert len(few) == 3 and few[0] == order[0]


def test_the_only_splat_of_a_surface_is_not_redundant() -> None:
    pair = plain_splats([[0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [0.3, 0.3, 0.0]], 0.01)
    assert find_redundant(np.array([2, 0, 1]), 3, pair, pair.centers[1:], 0.018).tolist() == [0]


@pytest.mark.parametrize(("distance", "count"), [(EVICT_NEARER - 0.01, 0), (EVICT_NEARER + 0.01, 1)])
def test_a_surface_gives_way_to_one_that_is_much_nearer_to_the_path(distance: float, count: int) -> None:
    seeds = np.float32([[1.1, 0.5, 0.5]])
    assert find_far(5, seeds, np.float32([[1.1 + distance, 0.5, 0.5], [0.5, 0.5, 0.5]]), PATH).tolist() == [0] * count


def test_the_farthest_go_first() -> None:
    centers = np.float32([[2.0, 0, 0], [4.0, 0, 0], [3.0, 0, 0]])
    assert find_far(2, np.float32([[0.5, 0, 0], [0.2, 0, 0], [0.1, 0, 0]]), centers, PATH).tolist() == [1, 2]
    assert distance_to_box(centers, PATH).tolist() == [1.0, 3.0, 2.0]


def test_people_and_the_robot_keep_their_splats() -> None:
    box = Box(lower=np.zeros(3), upper=np.full(3, 4.0))
    buffer, occupancy = SplatBuffer(6), OccupancyMap(box, OccupancyConfig(voxel=0.1), 1)
    buffer.fill(plain_seeds([[3.9, 3.9, 3.9]] * 6, 0.02), 0.5)
    buffer.labels[:4] = [Label.ROBOT, Label.ROBOT, Label.HUMAN, Label.HUMAN]
    occupancy.entity[:3, :3, :3] = SWEPT
    is_evicted, _ = room_for(plain_seeds([[0.39, 0.39, 0.39]] * 6, 0.02), 6, buffer, occupancy, np.zeros(6), 0.018)
    assert np.flatnonzero(is_evicted).tolist() == [4, 5]


def test_a_full_budget_makes_room_for_a_block_and_then_rests() -> None:
    config = SceneConfig(max_splats=300, first_iterations=30, iterations_per_step=4, gap_reserve=0.0, fill=1.0)
    fitter, rows = SceneFitter(config, OccupancyConfig(), WORKSPACE), []
    for i in range(26):
        block = 0.15 * (i > 1)
        assert i != 2 or (~fitter.buffer.is_alive).sum() < 30
        rows.append(fitter.step([frame(i, block=block, y=0.05), frame(i, block=block, y=-0.05)]))
    evicted = [row.evicted for row in rows]
    assert sum(evicted) > 0 and [row.removed["evicted"] for row in rows] == evicted
    assert {i % EVICT_EVERY for i, count in enumerate(evicted) if count and i != 2} == {0}  # and as it comes
    assert rows[-1].unrepresented < 0.5 * max(row.unrepresented for row in rows)
    assert sum(evicted[-10:]) <= 0.2 * sum(evicted)  # what was given up does not come back


CONFIG = SceneConfig()


SCREEN = np.hypot(*np.mgrid[-0.12:0.12:0.0002, -0.12:0.12:0.0002])


def blended(opacity: float, radius: float, count: int) -> Float64:
    """Opacity over the screen of `count` coinciding splats in its middle, without dilation or cut-offs."""
    return 1.0 - (1.0 - opacity * np.exp(-0.5 * np.square(SCREEN / radius))) ** count


@pytest.mark.parametrize("count", [1, 2, 3, 20])
@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.99])
def test_clones_keep_the_peak_and_the_opacity_summed_over_the_screen(opacity: float, count: int) -> None:
    """The copies' sum is no Gaussian."""
    a, r = (float(value[0]) for value in clone_shape(np.array([opacity]), np.array([0.01]), np.array([count])))
    before, after = blended(opacity, 0.01, 1), blended(a, r, count)
    assert after.max() == pytest.approx(before.max(), abs=1e-6)
    assert after.sum() == pytest.approx(before.sum(), rel=0.005)
    assert 0.01 * opacity * (count > 1 and opacity > 0.5) <= np.abs(after - before).max() < 0.2 * opacity


def test_the_one_dimensional_rule_would_lose_opacity() -> None:
    a = 1.0 - (1.0 - 0.9) ** (1.0 / 3.0)
    factor = 0.9 / sum((-1) ** k * n * a ** (k + 1) / np.sqrt(k + 1) for k, n in enumerate((3, 3, 1)))
    assert abs(1.0 - blended(a, 0.01 * factor, 3).sum() / blended(0.9, 0.01, 1).sum()) > 0.02


def test_sources_of_clones_are_drawn_in_proportion_to_opacity() -> None:
    counts = np.bincount(clone_sources(np.array([0.0, 0.1, 0.3]), 4000, np.random.default_rng(0)), minlength=3)
    assert (counts[0], counts[2] / counts[1]) == (0, pytest.approx(3.0, rel=0.15))
    assert len(clone_sources(np.zeros(3), 10, np.random.default_rng(0))) == 0


def test_copies_take_dead_slots_and_start_without_moments() -> None:
    buffer, copies = SplatBuffer(5), [1, 3, 4]  # 0 and 2 are not copied
    buffer.fill(plain_seeds(np.eye(3), 0.01), 0.5)
    buffer.labels[1] = Label.HUMAN
    for array in (buffer.moments.first, buffer.moments.second, buffer.moments.num_steps):
        array[...] = 7
    assert buffer.copy(np.array([1, 1, 1, 0]), np.full(5, 0.25), np.full(5, 0.02)) == 2 and buffer.is_alive.all()
    assert np.array_equal(buffer.centers[copies], np.tile([0, 1, 0], (3, 1)))
    assert buffer.opacities == pytest.approx(np.array([0.5, 0.25, 0.5, 0.25, 0.25]))
    assert buffer.radii[copies] == pytest.approx(0.02) and (buffer.labels[copies] == Label.HUMAN).all()
    assert not buffer.moments.first[copies].any() and not buffer.moments.num_steps[copies].any()
    assert (buffer.moments.first[[0, 2]] == 7).all()


def test_detail_is_seeded_where_the_colours_are_wrong_and_nowhere_else() -> None:
    error, pixel = np.zeros((60, 80), np.float32), HEIGHT / INTRINSICS.fx
    assert len(detail_seeds([(frame(), error)], 30, CONFIG, np.random.default_rng(0))) == 0
    error[20:30, 40:60] = 0.3
    seeds = detail_seeds([(frame(), error)], 30, CONFIG, np.random.default_rng(0))
    assert 10 <= len(seeds) <= 30 and seeds.radii == pytest.approx(pixel)
    u, v = seeds.centers[:, 0] / pixel + INTRINSICS.cx, -seeds.centers[:, 1] / pixel + INTRINSICS.cy
    assert ((u > 39.5) & (u < 59.5) & (v > 19.5) & (v < 29.5)).all()
    assert (
        np.linalg.norm(seeds.centers[:, None] - seeds.centers[None], axis=2) + np.eye(len(seeds))
    ).min() >= 2 * pixel - 1e-6


def test_pixels_are_drawn_as_numpy_draws_them() -> None:
    """Heavy ones are drawn again and again, which takes several rounds."""
    weight = np.random.default_rng(1).random(500) ** 8
    weight[::7] = 0.0
    for count in (1, 30, int(np.count_nonzero(weight))):
        wanted = np.random.default_rng(2).choice(500, count, replace=False, p=weight / weight.sum())
        np.testing.assert_array_equal(draw_indices(weight, count, np.random.default_rng(2)), wanted)


def test_a_block_in_free_space_is_in_the_map_of_its_first_frames() -> None:
    config = SceneConfig(max_splats=230, first_iterations=30, iterations_per_step=4, gap_reserve=0.05, fill=1.0)
    fitter = SceneFitter(config, OccupancyConfig(), WORKSPACE)
    for i in range(3):
        assert not i or (fitter.buffer.is_alive.all() and not (fitter.splats().centers[:, 2] > 0.1).any())
        fitter.step([frame(i, block=0.15 * (i > 1), y=0.05), frame(i, block=0.15 * (i > 1), y=-0.05)])
    assert (fitter.splats().centers[:, 2] > 0.1).sum() > 20
