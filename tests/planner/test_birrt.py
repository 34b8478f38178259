from dataclasses import replace

import numpy as np
import pytest

from experiments.paths import joint_length
from splatctrl_cli.config import PlannerConfig
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.planner import birrt
from splatctrl_cli.planner.birrt import PlanOutcome, plan, shortened
from splatctrl_cli.planner.configuration_clearance import Clearance, EdgeCheck, OnlyDistance, check_edges
from splatctrl_cli.planner.planned import resampled
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm, Plane
from tests.planner.walls import clearance, closed_ring, one_wall, thin_post

CONFIG = PlannerConfig(max_iterations=300, max_time=60.0)
START, GOAL = np.array([0.7, 0.2]), np.array([-0.7, -0.2])


def densest(room: Clearance, waypoints: Float64) -> float:
    """The least clearance at samples 2 mrad apart."""
    return float(np.min(room.at(resampled(waypoints, 2e-3))))


def test_a_way_round_a_wall_is_found_and_is_free() -> None:
    room = clearance(one_wall())
    assert densest(room, np.array([START, GOAL])) < 0  # the straight edge is not
    found = plan(room, START, GOAL, CONFIG)
    assert found.is_solved
    np.testing.assert_array_equal(found.waypoints[[0, -1]], [START, GOAL])
    assert densest(room, found.waypoints) > 0
    assert densest(room, found.found) > 0


def test_a_margin_is_kept_everywhere() -> None:
    found = plan(clearance(one_wall(), margin=0.03), START, GOAL, CONFIG)
    assert found.is_solved
    assert densest(clearance(one_wall()), found.waypoints) > 0.03


def test_a_goal_behind_a_closed_wall_runs_out_of_iterations() -> None:
    config = replace(CONFIG, max_iterations=60)
    found = plan(clearance(closed_ring()), np.array([1.5, 0.1]), np.array([-1.5, 0.1]), config)
    assert found.outcome is PlanOutcome.OUT_OF_ITERATIONS
    assert found.num_iterations == 60
    assert not found.is_solved
    assert len(found.waypoints) == 0


def test_trees_join_only_where_the_whole_edge_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    num_asked = []

    def checked(_: Clearance, start: Float64, end: Float64, *, only_whole: bool, **__: object) -> EdgeCheck:
        num_asked.append(len(start))
        share = (
            0.999 if not only_whole else float(len(num_asked) > 1)
        )  # the straight edge is not free, the trees' are
        return EdgeCheck(free_share=np.full(len(start), share), num_checks=len(start))

    monkeypatch.setattr(birrt, "check_edges", checked)
    found = plan(clearance(one_wall()), START, GOAL, replace(CONFIG, max_iterations=5))
    assert found.outcome is PlanOutcome.OUT_OF_ITERATIONS


def test_the_clock_ends_a_search() -> None:
    rooms = clearance(closed_ring()), np.array([1.5, 0.1]), np.array([-1.5, 0.1])
    found = plan(*rooms, replace(CONFIG, max_time=0.0))
    assert found.outcome is PlanOutcome.OUT_OF_TIME
    assert found.num_iterations == 0


def test_of_several_goals_the_one_reached_is_named() -> None:
    room = clearance(closed_ring())
    goals = np.array([[-1.5, 0.1], [2.0, -0.3]])
    found = plan(room, np.array([1.5, 0.1]), goals, CONFIG)
    assert found.is_solved
    assert found.goal == 1
    np.testing.assert_array_equal(found.waypoints[-1], goals[1])


def test_the_same_seed_gives_the_same_path_and_another_seed_another() -> None:
    room = clearance(one_wall())
    one, again, other = (plan(room, START, GOAL, CONFIG, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.waypoints, again.waypoints)
    assert (one.num_checks, one.num_edges) == (again.num_checks, again.num_edges)
    assert one.waypoints.shape != other.waypoints.shape or not np.array_equal(one.waypoints, other.waypoints)


def test_no_waypoint_leaves_the_limits() -> None:
    arm = PlanarArm()
    for seed in range(5):
        found = plan(clearance(one_wall()), START, GOAL, CONFIG, seed=seed)
        assert np.all(found.found >= arm.lower)
        assert np.all(found.found <= arm.upper)
        assert np.all(found.waypoints >= arm.lower)
        assert np.all(found.waypoints <= arm.upper)


def test_a_start_in_collision_names_the_sphere_and_its_depth() -> None:
    room = clearance(one_wall())
    with pytest.raises(NotEvaluableError, match=r"start: .*got fore\[\d\] at -0\.0\d+ m"):
        plan(room, np.array([0.0, 0.0]), GOAL, CONFIG)
    with pytest.raises(NotEvaluableError, match=r"goal 1: .*got fore\[\d\] at -0\.0\d+ m"):
        plan(room, START, np.array([GOAL, [0.0, 0.0]]), CONFIG)


def test_a_posture_outside_the_limits_names_the_joint() -> None:
    with pytest.raises(InputError, match=r"goal: joint elbow: expected within \[-2.6000, 2.6000\] rad, got 2.7000"):
        plan(clearance(one_wall()), START, np.array([0.7, 2.7]), CONFIG)
    with pytest.raises(InputError, match="start: joint shoulder is nan"):
        plan(clearance(one_wall()), np.array([np.nan, 0.0]), GOAL, CONFIG)


def test_shortcuts_are_proved_and_never_longer() -> None:
    room = clearance(one_wall())
    for seed in range(8):
        found = plan(room, START, GOAL, replace(CONFIG, shortcut_rounds=0), seed=seed).found
        short, _, _ = shortened(room, found, CONFIG, np.random.default_rng(seed))
        np.testing.assert_array_equal(short[[0, -1]], found[[0, -1]])
        assert joint_length(short) <= joint_length(found) + 1e-12
        assert densest(room, short) > 0


def test_the_fast_kinematics_of_the_test_arm_are_its_slow_ones() -> None:
    arm, q = PlanarArm(), random_edges(20)[0]
    np.testing.assert_allclose(arm.sphere_centers_batch(q), [arm.sphere_centers(row) for row in q], atol=1e-15)


def random_edges(num: int) -> tuple[Float64, Float64]:
    arm = PlanarArm()
    rng = np.random.default_rng(7)
    return rng.uniform(arm.lower, arm.upper, (num, 2)), rng.uniform(arm.lower, arm.upper, (num, 2))


@pytest.mark.parametrize("room", [one_wall(), closed_ring(), thin_post()], ids=["wall", "ring", "needle"])
def test_no_edge_is_accepted_that_dense_samples_find_in_collision(room: object) -> None:
    free = clearance(room)  # type: ignore[arg-type]
    start, end = random_edges(120)
    check = check_edges(free, start, end, contact=1e-4)
    dense = np.array([densest(free, np.array(edge)) for edge in zip(start, end, strict=True)])
    assert np.all(dense[check.is_free] > 0)
    assert 0.1 < check.is_free.mean() < 0.9  # the edges try both
    assert np.all(check.is_free[dense > 0.01])  # and no edge with room to spare is refused


def test_a_needle_between_samples_is_not_stepped_over() -> None:
    free = clearance(thin_post(radius=1e-3))
    slim = replace(free, taken=np.full_like(free.taken, 1e-3))
    angle = np.arctan2(0.31, 0.62) + np.array([-0.37, 0.33])
    near = np.hypot(0.62, 0.31)
    bend = np.arccos((near**2 - 0.5**2 - 0.4**2) / (2 * 0.5 * 0.4))  # the tip's sphere sweeps through the needle
    reach = np.arctan2(0.4 * np.sin(bend), 0.5 + 0.4 * np.cos(bend))
    start, end = np.array([[angle[0] - reach, bend]]), np.array([[angle[1] - reach, bend]])
    samples = start + np.linspace(0, 1, 15)[:, None] * (end - start)  # 0.05 rad apart
    assert np.min(slim.at(samples)) > 0
    assert not check_edges(slim, start, end, contact=1e-5).is_free[0]


def test_the_free_share_of_an_edge_is_free_and_ends_at_the_wall() -> None:
    free = clearance(one_wall())
    start, end = random_edges(120)
    share = check_edges(free, start, end, contact=1e-4, give_up=0.02, only_whole=False).free_share
    for a, b, part in zip(start, end, share, strict=True):
        if part > 0:
            assert densest(free, np.array([a, a + part * (b - a)])) > 0
        if part < 1:
            beyond = a + np.clip(part + 0.1 / np.linalg.norm(b - a), 0, 1) * (b - a)
            assert densest(free, np.array([a + part * (b - a), beyond])) < 0.05


def test_pairs_of_the_robots_own_spheres_count() -> None:
    folded, free = np.array([[0.0, 2.6]]), clearance(thin_post())
    tip = free.rows(folded)[0][free.names.index("base[0]~fore[1]")]
    own = PlanarArm().sphere_centers(folded[0])
    assert tip == pytest.approx(np.linalg.norm(own[0] - own[4]) - 0.06 - 0.04, abs=1e-12)


def test_a_field_without_a_distance_is_an_error_that_says_where() -> None:
    class Nowhere:
        def distance(self, points: Float64) -> Float64:
            return np.full(len(points), np.nan)

    with pytest.raises(NotEvaluableError, match=r"sphere upper\[0\] at \(0.250, 0.000, 0.000\) m: the field has no"):
        Clearance.of(PlanarArm(), Nowhere()).at(np.zeros((1, 2)))


def test_a_distance_field_is_a_scene_as_solids_are() -> None:
    q = random_edges(50)[0]
    field = OnlyDistance(field=Balls([[0.62, 0.31, 0.0]], [0.002]))
    np.testing.assert_allclose(Clearance.of(PlanarArm(), field).rows(q), clearance(thin_post()).rows(q), atol=1e-12)


def test_a_field_steeper_than_a_distance_is_checked_with_its_own_slope() -> None:
    steep = OnlyDistance(field=Plane([0.0, 1.0, 0.0], -0.5, scale=3.0))
    trusting, wary = (Clearance.of(PlanarArm(), steep, lipschitz=slope) for slope in (1.0, 3.0))
    start, end = random_edges(100)
    dense = np.array([densest(wary, np.array(edge)) for edge in zip(start, end, strict=True)])
    assert np.all(dense[check_edges(wary, start, end, contact=1e-4).is_free] > 0)
    ratio = wary.speeds(end - start) / np.maximum(trusting.speeds(end - start), 1e-12)
    assert np.allclose(ratio[:, :4], 3.0)
