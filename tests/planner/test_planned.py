"""A replay's task planned: postures at a goal pose, margins that start and goal allow, proved edges, times."""

from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest

from experiments.paths import approach_to, joint_length, least_clearance
from experiments.problems import simulated_arm
from experiments.solids import Ball, Solids
from splatctrl_cli.config import ControlConfig, PlannerConfig
from splatctrl_cli.control.goals import pose_error
from splatctrl_cli.control.replay import ReplayTask, is_at_goal
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.planner.birrt import plan
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.planner.planned import (
    GOAL_BLOCKED,
    NO_POSTURE,
    START_BLOCKED,
    PlannedPath,
    effector_rates,
    goal_postures,
    path_to_nearest,
    planned_detours,
    planned_path,
    resample,
    time_path,
)
from splatctrl_cli.records import Float64
from tests.control.fakes import PlanarArm
from tests.planner.walls import one_wall
from tests.refused import expect_refusal

ARM = PlanarArm()
CONFIG, PLANNER = ControlConfig(), PlannerConfig(max_iterations=300, max_time=60.0)
START, GOAL = np.array([0.7, 0.2]), np.array([-0.7, -0.2])


def task(start: Float64 = START, goal: Float64 = GOAL) -> ReplayTask:
    return ReplayTask(start=start, T_world_goal=ARM.frame_pose(goal, "tip"), frame="tip")


def ball(x: float, y: float, radius: float = 0.05) -> Solids:
    return Solids(solids=[Ball(center=np.array([x, y, 0.0]), radius=radius)])


def planned(
    scene: Solids, asked: ReplayTask | None = None, arm: PlanarArm = ARM, config: ControlConfig = CONFIG
) -> PlannedPath:
    return planned_path(arm, scene, asked or task(), PLANNER, config)


def test_goal_postures_bring_the_frame_to_the_pose_and_keep_the_limits() -> None:
    random = np.random.default_rng(0)
    for wanted in random.uniform(ARM.lower, ARM.upper, (20, 2)):
        T = ARM.frame_pose(wanted, "tip")
        guesses = np.vstack([wanted + random.normal(size=2) / 4, random.uniform(ARM.lower, ARM.upper, (12, 2))])
        found = goal_postures(ARM, "tip", T, guesses, CONFIG, at_most=5)
        assert 1 <= len(found) <= 5 and np.all((found >= ARM.lower) & (found <= ARM.upper))
        assert all(is_at_goal(10 * pose_error(ARM.frame_pose(q, "tip"), T), CONFIG) for q in found)


def test_a_pose_out_of_reach_has_no_posture() -> None:
    T = pose_at([1.5, 0.0, 0.0])
    assert goal_postures(ARM, "tip", T, np.array([[0.1, 0.2], [1.0, 1.0]]), CONFIG, at_most=5).shape == (0, 2)
    found = planned(one_wall(), replace(task(), T_world_goal=T))
    assert (found.outcome, found.path) == (NO_POSTURE, None)


def test_a_planned_path_keeps_the_controllers_margin_and_speed() -> None:
    """And is the same every time."""
    found, again = planned(one_wall()), planned(one_wall())
    assert found.outcome == "solved" and found.path is not None and again.path is not None
    np.testing.assert_array_equal(found.path.waypoints, again.path.waypoints)
    assert found.num_proved == found.num_edges == len(found.path.waypoints) - 1
    assert (found.margin, found.self_margin) == (CONFIG.margin, CONFIG.self_margin)
    assert least_clearance(found.clearance, found.path.waypoints).lower > -1e-3
    assert found.clearance.at(START[None])[0] < 0.5  # less its margin, of a wall that is there
    assert is_at_goal(pose_error(ARM.frame_pose(found.path.waypoints[-1], "tip"), task().T_world_goal), CONFIG)
    motion = zip(*found.path.at(np.arange(0.0, found.path.duration, 0.01)), strict=True)
    speeds = [np.linalg.norm((ARM.frame_jacobian(q, "tip") @ v)[:3]) for q, v in motion]
    assert max(speeds) < CONFIG.max_linear_speed * 1.01


def test_a_hand_comes_straight_to_its_goal_as_far_as_that_is_free() -> None:
    """Along the z axis of its frame; a ball where it would be 12 cm before the goal, and not at 4, leaves 4 or 8."""
    model = simulated_arm()
    start, goal = np.array([[0.8, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785], [-0.8, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785]])
    pose = model.frame_pose(goal, "hand")
    asked = ReplayTask(start=start, T_world_goal=pose, frame="hand", home=goal)
    ending = partial(approach_to, frame="hand", length=0.12, planner=PLANNER, control=CONFIG)

    def before(scene: Solids) -> list[float]:
        path = planned_path(model, scene, asked, PLANNER, CONFIG, ending=ending).path
        T_goal = np.linalg.inv(pose) @ [model.frame_pose(q, "hand") for q in path.waypoints]
        np.testing.assert_allclose(T_goal[-1], np.eye(4), atol=2e-3)
        is_on_axis = np.linalg.norm(T_goal[:, :2, 3], axis=1) < 1e-3
        is_turned = np.linalg.norm(T_goal[:, :3, :3] - np.eye(3), axis=(1, 2)) > 2e-3
        return np.round(T_goal[is_on_axis & ~is_turned, 2, 3], 2).tolist()

    assert before(ball(3.0, 3.0)) == pytest.approx([-0.12, -0.08, -0.04, 0.0])
    whole = ending(Clearance.of(model, ball(3.0, 3.0)), goal)
    centers, radii = model.sphere_centers_batch(whole), model.sphere_set.radii
    away = (np.linalg.norm(centers[0][:, None, None] - centers[None, 2:], axis=3) - radii).min(axis=(1, 2))
    assert away.max() > CONFIG.margin + 0.01
    left = before(Solids(solids=[Ball(center=centers[0][np.argmax(away)], radius=0.005)]))
    assert left in ([-0.04, 0.0], [-0.08, -0.04, 0.0])


def test_a_start_within_the_margin_is_planned_from_with_as_much_as_it_keeps() -> None:
    tip = ARM.frame_pose(START, "tip")[:2, 3]
    found = planned(ball(*(tip * (1 + (0.04 + 0.05 + 0.012) / np.linalg.norm(tip)))))
    assert (found.outcome, found.margin) == ("solved", pytest.approx(0.012 - 0.001, abs=1e-6))


@pytest.mark.parametrize(("posture", "outcome"), [(START, START_BLOCKED), (GOAL, GOAL_BLOCKED)])
def test_a_start_and_a_goal_in_collision_are_named(posture: Float64, outcome: str) -> None:
    found = planned(ball(*ARM.frame_pose(posture, "tip")[:2, 3]))
    assert (found.outcome, found.path, found.num_edges) == (outcome, None, 0)


def test_a_path_leads_to_the_nearest_goal_though_a_farther_one_is_found_at_once() -> None:
    """Without iterations for the nearest goal, the path leads to another."""
    room, beyond = Clearance.of(ARM, one_wall(), margin=CONFIG.margin), np.array([2.3, 0.5])
    goals, hopeless = np.array([beyond, GOAL]), replace(PLANNER, max_iterations=0)
    assert np.linalg.norm(beyond - START) > np.linalg.norm(GOAL - START)
    at_once, found = plan(room, START, goals, PLANNER), path_to_nearest(room, START, goals, PLANNER)
    assert (at_once.goal, at_once.num_iterations) == (0, 0) and found.is_solved and found.num_iterations > 0
    np.testing.assert_array_equal(found.waypoints[-1], GOAL)
    assert not plan(room, START, GOAL[None], hopeless).is_solved
    np.testing.assert_array_equal(path_to_nearest(room, START, goals, hopeless).waypoints[-1], beyond)


def test_what_the_spheres_leave_uncovered_is_kept_as_well_where_the_controller_keeps_it() -> None:
    bare = PlanarArm()
    bare.sphere_deficit = np.full(5, 0.03)
    thin, kept = (planned(one_wall(), arm=bare, config=replace(CONFIG, coverage=c)) for c in ("report", "margin"))
    assert thin.margin == kept.margin == CONFIG.margin
    np.testing.assert_allclose(thin.clearance.at(START[None]) - kept.clearance.at(START[None]), 0.03)


def test_a_way_out_is_planned_in_the_scene_of_the_stall_and_waits_as_configured() -> None:
    scene_at = Mock(return_value=one_wall())
    detour = planned_detours(ARM, scene_at, "tip", PLANNER, CONFIG)(7, START, task().T_world_goal)
    scene_at.assert_called_once_with(7)
    assert (detour.wait_distance, detour.clock) == (PLANNER.wait_distance, 0.0)
    np.testing.assert_array_equal(detour.path.waypoints[0], START)


def test_a_plan_is_made_with_the_margin_of_the_arm_to_itself() -> None:
    found = planned(one_wall(), config=replace(CONFIG, self_margin=0.07))
    centers, radii = ARM.sphere_centers(START), ARM.sphere_set.radii
    apart = [np.linalg.norm(centers[a] - centers[b]) - radii[a] - radii[b] for a, b in ARM.pairs]
    own = found.clearance.rows(START[None])[0, len(found.clearance.moving) :]
    assert found.self_margin == 0.07 and own == pytest.approx(np.array(apart) - 0.07)


PATH = np.array([[0.7, 0.2], [0.9, 2.0], [-0.4, 1.5], [-0.42, 1.5]])


def test_resampling_keeps_waypoints_length_and_spacing() -> None:
    rows = resample(PATH, 0.05)
    assert joint_length(rows) == pytest.approx(joint_length(PATH))
    assert np.max(np.linalg.norm(np.diff(rows, axis=0), axis=1)) <= 0.05 + 1e-12
    assert all(np.any(np.all(np.abs(rows - q) < 1e-12, axis=1)) for q in PATH)


def test_a_timed_path_keeps_its_limits_and_its_edges() -> None:
    """And uses them."""
    path = time_path(PATH, ARM.velocity_limit, 3.0)
    clock = np.linspace(0, path.duration, 20_001)
    position, velocity = path.at(clock)
    assert np.all(np.abs(velocity) <= ARM.velocity_limit + 1e-12)
    assert np.max(np.abs(np.diff(velocity, axis=0) / np.diff(clock)[:, None])) <= 3.0 + 1e-6
    middle = (velocity[1:] + velocity[:-1]) / 2 * np.diff(clock)[:, None]
    np.testing.assert_allclose(np.diff(position, axis=0), middle, atol=1e-6)
    np.testing.assert_allclose(position[[0, -1]], PATH[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(path.at(path.start_time)[0], PATH, atol=1e-12)
    assert joint_length(position) == pytest.approx(joint_length(PATH))
    assert np.max(np.abs(velocity), axis=0) == pytest.approx(np.array([1.5, 1.5]), rel=0.2)


def test_a_path_of_one_place_or_without_limits_is_refused() -> None:
    expect_refusal("expected at least 2 waypoints, got 1", time_path, PATH[:1], ARM.velocity_limit, 3.0)
    expect_refusal("limits above 0", time_path, PATH, np.zeros(2), 3.0)


def test_a_path_keeps_the_speed_of_a_frame_too() -> None:
    """An edge that leaves a frame where it is has no rate."""
    rates = effector_rates(ARM, PATH, "tip", max_linear=0.2, max_angular=0.5)
    path = time_path(PATH, ARM.velocity_limit, 7.5, max_rate=rates)
    assert path.duration > time_path(PATH, ARM.velocity_limit, 7.5).duration
    motion = zip(*path.at(np.arange(0, path.duration, 0.01)), strict=True)
    twists = np.array([ARM.frame_jacobian(q, "tip") @ v for q, v in motion])
    linear, angular = (np.linalg.norm(part, axis=1).max() for part in (twists[:, :3], twists[:, 3:]))
    assert linear < 0.2 * 1.001 and angular < 0.5 * 1.001 and (linear > 0.199 or angular > 0.499)
    still = effector_rates(ARM, np.array([[0.1, 0.2], [0.1, 0.2]]), "tip", max_linear=0.2, max_angular=0.5)
    assert still == np.inf
