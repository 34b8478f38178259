"""Why splats are removed; and who gives a slot to surface that has none: what others stand for too, then what is far
from the robot's path.
"""

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import EVICT_EVERY, EVICT_NEARER
from splatctrl_cli.records import Bool, Box, Label, RgbdFrame, SplatSet
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import View, make_view, seen_through
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.removal import distance_to_box, far_away, redundant, removals, room_for
from splatctrl_cli.voxels import SWEPT
from tests.plain import plain_splats
from tests.reference.unrepresented import unrepresented
from tests.scene.wall import WORKSPACE, frame

FLOOR, AIR, OUTSIDE, BELOW = [0.2, 0.2, 0.0], [0.2, 0.2, 0.3], [3.0, 0.0, 0.0], [0.0, 0.0, 0.1]


def view(seen: RgbdFrame) -> View:
    return make_view(seen, seen.depth > 0)


def buffer() -> SplatBuffer:
    """Four splats: on the floor, in the air, outside the workspace, inside a block that nobody looked into."""
    slots = SplatBuffer(6)
    centers = np.array([FLOOR, AIR, OUTSIDE, BELOW], np.float32)
    slots.fill(Seeds(centers=centers, radii=np.full(4, 0.02, np.float32), colors=np.zeros((4, 3), np.float32)), 0.5)
    return slots


def removed(slots: SplatBuffer, rule: str = "observed", **masks: Bool) -> dict[str, list[int]]:
    grid = OccupancyMap(WORKSPACE, OccupancyConfig(rule=rule, uncertain_patience=1), 1)
    for _ in range(3):
        grid.integrate(frame(block=0.2))
    none = np.zeros(6, bool)
    chosen = {"is_trail": none, "is_floating": none} | masks
    reasons = removals(slots, grid, WORKSPACE, 0.1, **chosen)
    return {reason: np.flatnonzero(mask).tolist() for reason, mask in reasons.items() if mask.any()}


def test_free_air_and_outside_go_while_surfaces_and_the_never_seen_stay() -> None:
    assert removed(buffer()) == {"workspace": [2], "free": [1]}


def test_the_literal_rule_removes_the_never_seen_too() -> None:
    assert removed(buffer(), rule="literal") == {"workspace": [2], "free": [1], "uncertain": [3]}


def test_a_splat_goes_for_its_first_reason_only() -> None:
    slots = buffer()
    slots.parameters[0, 7] = -4.0
    trail = np.array([True, False, False, False, True, False])
    assert removed(slots, is_trail=trail) == {"workspace": [2], "opacity": [0], "free": [1]}


def test_broken_numbers_go() -> None:
    slots = buffer()
    slots.parameters[0, 1] = np.nan
    assert removed(slots)["broken"] == [0]


def test_dead_slots_are_never_removed_again() -> None:
    slots = buffer()
    slots.kill(np.array([True] * 6))
    assert removed(slots) == {}


def test_uncertainty_is_tolerated_for_a_while() -> None:
    grid = OccupancyMap(WORKSPACE, OccupancyConfig(uncertain_patience=2), 1)
    grid.integrate(frame())
    grid.log_odds[grid.num_updates > 0] = 0.0
    none = np.zeros(6, bool)
    slots = buffer()
    counts = [
        int(removals(slots, grid, WORKSPACE, 0.1, is_trail=none, is_floating=none)["uncertain"].sum())
        for _ in range(4)
    ]
    assert counts[:2] == [0, 0]
    assert counts[2] > 0


@pytest.mark.parametrize(("height", "floats"), [(0.0, False), (0.01, False), (0.03, True), (-0.1, False)])
def test_a_splat_that_a_camera_sees_through_floats(height: float, floats: bool) -> None:
    assert seen_through(np.float32([[0.1, 0.1, height]]), [view(frame())], 0.015).tolist() == [floats]


def test_a_silhouette_does_not_make_its_own_splats_float() -> None:
    rim = np.float32([[0.099, 0.0, 0.2], [0.105, 0.0, 0.2], [0.16, 0.0, 0.2]])
    assert seen_through(rim, [view(frame(block=0.2))], 0.015).tolist() == [False, False, True]


def test_beside_the_robot_only_what_is_no_robot_keeps_a_splat_that_a_pixel_looks_past() -> None:
    """The robot is the block; its own splats may stand three pixels beside its silhouette, an object's not."""
    seen = frame(block=0.2)
    beside = make_view(seen, seen.depth > 0, is_robot=seen.depth < 0.9, reach=0.04)
    points = np.float32([[0.105, 0.0, 0.2], [0.12, 0.0, 0.2], [0.12, 0.0, 0.0]])
    assert seen_through(points, [beside], 0.015).tolist() == [False, True, False]
    assert not seen_through(points, [beside], 0.015, label=Label.ROBOT).any()


def test_an_image_that_ends_without_depth_sees_through_nothing_there() -> None:
    seen = frame()
    seen.depth[:, :20] = 0.0
    at_the_border = np.float32([[-39.0 / 80.0 * 0.7, 0.0, 0.3]])
    assert not seen_through(at_the_border, [view(seen)], 0.015).any()


def test_what_no_camera_looks_at_does_not_float() -> None:
    blind = frame()
    blind.depth[:] = 0.0
    points = np.float32([[0.1, 0.1, 0.3], [9.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    assert not seen_through(points, [view(blind)], 0.015).any()
    assert not seen_through(points[1:], [view(frame())], 0.015).any()
    assert not seen_through(points, [], 0.015).any()


def test_a_trail_goes_from_the_surface_it_lies_on() -> None:
    trail = np.array([True, False, False, False, False, False])
    assert removed(buffer(), is_trail=trail) == {"workspace": [2], "free": [1], "trail": [0]}


def test_what_is_no_time_step_does_not_try_the_patience() -> None:
    grid = OccupancyMap(WORKSPACE, OccupancyConfig(uncertain_patience=2), 1)
    grid.integrate(frame())
    grid.log_odds[grid.num_updates > 0] = 0.0
    none = np.zeros(6, bool)
    slots = buffer()
    for _ in range(5):
        reasons = removals(slots, grid, WORKSPACE, 0.1, is_trail=none, is_floating=none, counts_time=False)
        assert not reasons["uncertain"].any()
    assert not slots.num_uncertain.any()


PATH = Box(lower=np.zeros(3), upper=np.ones(3))


def floor(spacing: float) -> SplatSet:
    """Splats all over a square of 40 cm."""
    steps = np.arange(0.0, 0.4, spacing)
    return plain_splats([[x, y, 0.0] for x in steps for y in steps], 0.01)


def voxels() -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    steps = np.arange(0.0, 0.4, 0.02)
    return np.float32([[x, y, 0.004] for x in steps for y in steps])


def bare(splats: SplatSet, tolerance: float) -> int:
    return int(unrepresented(voxels(), splats.centers.astype(float), splats.radii.astype(float), tolerance).sum())


def test_what_is_given_up_leaves_no_surface_bare() -> None:
    splats = floor(0.02)
    order = np.random.default_rng(0).permutation(len(splats))
    gone = redundant(order, len(splats), splats, voxels(), 0.018)
    assert 50 < len(gone) < len(splats)
    kept = splats.select(~np.isin(np.arange(len(splats)), gone))
    assert bare(splats, 0.018) == bare(kept, 0.018) == 0
    assert len(redundant(np.arange(len(kept)), len(kept), kept, voxels(), 0.018)) == 0


def test_the_first_in_the_order_go_and_no_more_than_are_wanted() -> None:
    splats = floor(0.02)
    order = np.arange(len(splats))[::-1]
    gone = redundant(order, 3, splats, voxels(), 0.018)
    assert len(gone) == 3
    assert gone[0] == order[0]


def test_the_only_splat_of_a_surface_is_not_redundant() -> None:
    pair = plain_splats([[0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [0.3, 0.3, 0.0]], 0.01)
    surface = np.float32([[0.1, 0.1, 0.0], [0.3, 0.3, 0.0]])
    assert redundant(np.array([2, 0, 1]), 3, pair, surface, 0.018).tolist() == [0]


@pytest.mark.parametrize(("distance", "count"), [(EVICT_NEARER - 0.01, 0), (EVICT_NEARER + 0.01, 1)])
def test_a_surface_gives_way_to_one_that_is_much_nearer_to_the_path(distance: float, count: int) -> None:
    seeds = np.float32([[1.1, 0.5, 0.5]])
    centers = np.float32([[1.1 + distance, 0.5, 0.5], [0.5, 0.5, 0.5]])
    assert far_away(5, seeds, centers, PATH).tolist() == [0] * count


def test_the_farthest_go_first() -> None:
    centers = np.float32([[2.0, 0, 0], [4.0, 0, 0], [3.0, 0, 0]])
    assert far_away(2, np.float32([[0.5, 0, 0], [0.2, 0, 0], [0.1, 0, 0]]), centers, PATH).tolist() == [1, 2]
    assert distance_to_box(centers, PATH).tolist() == [1.0, 3.0, 2.0]


def test_people_and_the_robot_keep_their_splats() -> None:
    buffer, occupancy = (
        SplatBuffer(6),
        OccupancyMap(Box(lower=np.zeros(3), upper=np.full(3, 4.0)), OccupancyConfig(voxel=0.1), 1),
    )
    places = np.float32([[3.9, 3.9, 3.9]] * 6)
    buffer.fill(Seeds(centers=places, radii=np.full(6, 0.02, np.float32), colors=np.zeros((6, 3), np.float32)), 0.5)
    buffer.labels[:4] = [Label.ROBOT, Label.ROBOT, Label.HUMAN, Label.HUMAN]
    occupancy.entity[:3, :3, :3] = SWEPT
    seeds = Seeds(centers=places * 0.1, radii=np.full(6, 0.02, np.float32), colors=np.zeros((6, 3), np.float32))
    is_evicted, _ = room_for(seeds, 6, buffer, occupancy, np.zeros(6), 0.018)
    assert np.flatnonzero(is_evicted).tolist() == [4, 5]


def test_a_full_budget_makes_room_for_a_block_and_then_rests() -> None:
    config = SceneConfig(max_splats=300, first_iterations=30, iterations_per_step=4, gap_reserve=0.0, fill=1.0)
    fitter = SceneFitter(config, OccupancyConfig(), WORKSPACE)
    rows = [fitter.step([frame(i, y=0.05), frame(i, y=-0.05)]) for i in range(2)]
    assert (~fitter.buffer.is_alive).sum() < 30
    rows += [fitter.step([frame(i, block=0.15, y=0.05), frame(i, block=0.15, y=-0.05)]) for i in range(2, 26)]
    evicted = [row.evicted for row in rows]
    assert sum(evicted) > 0
    assert [row.removed["evicted"] for row in rows] == evicted
    assert {i % EVICT_EVERY for i, count in enumerate(evicted) if count} == {0}
    assert rows[-1].unrepresented < 0.5 * max(row.unrepresented for row in rows)
    assert sum(evicted[-10:]) <= 0.2 * sum(evicted)  # what was given up does not come back
