"""Why splats are removed."""

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.records import Bool, RgbdFrame
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.keyframes import View, make_view, seen_through
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.removal import removals
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
