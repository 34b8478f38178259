"""Rows of what a step would meet beside its own, and of links whose spheres stick out."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import BallDistance
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.qp_rows import RowBuilder
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.control.terms import State
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm, far_away, num_on_rung, sample_arm, scene_of

ARM = PlanarArm()
CONFIG = ControlConfig(solver="daqp")
BOX = (-ARM.velocity_limit, ARM.velocity_limit)
TIP = 4  # the last sphere
BEAM = Balls([[r * np.cos(1.15), r * np.sin(1.15), 0.0] for r in (0.64, 0.72, 0.8, 0.88, 0.96)], [0.04] * 5)
TASK = ReplayTask(
    start=np.array([0.2, 0.3]),
    T_world_goal=ARM.frame_pose(np.array([1.6, 0.3]), "tip"),
    frame="tip",
    home=np.array([1.6, 0.3]),
)


def state_at(q: np.ndarray, rate: float | np.ndarray = 0.0) -> State:
    return State(model=ARM, frame="tip", q=q, box=BOX, distance_rate=rate)


@pytest.mark.parametrize("max_cuts", [0, CONFIG.max_cuts])
def test_an_arm_pressed_against_a_row_of_balls_keeps_its_margin(
    max_cuts: int,
) -> None:
    trace = closed_loop(ARM, replace(CONFIG, max_cuts=max_cuts), TASK, lambda _: BEAM)
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - CONFIG.promise_tolerance
    assert any(step.scale < 1.0 for step in trace.steps) is (max_cuts == 0)
    assert not max_cuts or all(step.rung is Rung.SOLVED for step in trace.steps)


def test_a_cut_is_the_row_of_what_is_met_after_a_period() -> None:
    q, velocity, builder = np.array([0.7, 0.5]), np.array([0.9, -0.4]), RowBuilder(ARM, CONFIG, BEAM)
    state, later, step = state_at(q), q + CONFIG.period * velocity, 1e-6 * np.eye(2)
    rows = builder.cut(builder.at(state), state, velocity, np.array([3]))
    assert list(rows.cuts.index) == [3]

    def clearance(posture: np.ndarray) -> float:
        return float(BEAM.query(ARM.sphere_centers(posture)[[TIP]])[0][0] - ARM.sphere_set.radii[TIP])

    slope = np.array([(clearance(later + d) - clearance(later - d)) / 2e-6 for d in step])
    np.testing.assert_allclose(rows.cuts.G[0], -slope, rtol=1e-6)
    now = max(clearance(later) - CONFIG.period * slope @ velocity, rows.external.distance[3])
    np.testing.assert_allclose(rows.cuts.distance[0], now, rtol=1e-9)
    np.testing.assert_allclose(rows.cuts.h[0], CONFIG.barrier_gain * (now - CONFIG.margin), rtol=1e-9)


def test_a_cut_counts_the_rate_of_its_own_sphere() -> None:
    builder, q, velocity = RowBuilder(ARM, CONFIG, BEAM), np.array([0.7, 0.5]), np.array([0.9, -0.4])
    rate = np.array([0.0, -0.1, -0.2, -0.3])
    states = state_at(q), state_at(q, rate)
    still, moving = (builder.cut(builder.at(state), state, velocity, np.array([1, 3])).cuts for state in states)
    assert still is not None and moving is not None
    np.testing.assert_allclose(moving.h - still.h, rate[[1, 3]])


def test_cuts_add_up_and_give_their_slack_to_the_row_they_belong_to() -> None:
    builder, state, velocity = RowBuilder(ARM, CONFIG, BEAM), state_at(np.array([0.7, 0.5])), np.array([0.9, -0.4])
    rows = builder.at(state)
    cut = builder.cut(builder.cut(rows, state, velocity, np.array([3])), state, velocity, np.array([2, 3]))
    assert list(cut.cuts.index) == [3, 2, 3]
    spread = cut.spread(np.concatenate([np.zeros(int(rows.in_qp.sum())), [0.1, 0.2, 0.3]]))
    assert spread[2] == 0.2 and spread[3] == 0.3 and np.count_nonzero(spread) == 2


def test_far_from_everything_a_step_asks_the_field_twice() -> None:
    field = far_away()
    QpIkController(ARM, CONFIG, field, frame="tip").step(TASK.start, TASK.T_world_goal)
    assert field.num_queries == 2


def test_a_corner_stops_an_arm_at_both_of_its_sides() -> None:
    """The tip is driven into the gap between two balls, too narrow for it; one cut a step has to do."""
    q, end = np.array([0.6, 0.0]), np.array([1.2, 0.0])
    along, across = np.array([np.cos(0.6), np.sin(0.6), 0.0]), np.array([-np.sin(0.6), np.cos(0.6), 0.0])
    tip = ARM.frame_pose(q, "tip")[:3, 3]
    gap = Balls([tip + 0.19 * across + 0.012 * s * along for s in (-6, 6)], [0.08, 0.08])
    task = ReplayTask(start=q, T_world_goal=ARM.frame_pose(end, "tip"), frame="tip", home=end)
    trace = closed_loop(ARM, replace(CONFIG, max_cuts=1), task, lambda _: gap)
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - CONFIG.promise_tolerance


def test_an_arm_inside_a_shell_of_balls_gets_out(plain_arm: Path) -> None:
    """A cylinder of splats appears around the hand: every motion brings some sphere of it nearer to one of them."""
    arm, q = sample_arm(plain_arm), np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.0])
    T_world_goal = arm.frame_pose(np.array([0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 1.6]), "hand")
    turn, height = np.meshgrid(np.arange(0.0, 2 * np.pi, 0.5), np.arange(-0.12, 0.12, 0.03), indexing="ij")
    shell = np.stack([0.06 * np.cos(turn), 0.06 * np.sin(turn), height], axis=-1).reshape(-1, 3)
    around_hand = shell + arm.frame_pose(q, "hand")[:3, 3] + np.array([0.05, 0.03, 0.0])
    cylinder = SphereField(Spheres.of(around_hand.astype(np.float32), np.full(len(shell), 0.02, np.float32)))
    task = ReplayTask(start=q, T_world_goal=T_world_goal, frame="hand")
    trace = closed_loop(arm, CONFIG, task, lambda t: cylinder if t >= 50_000_000 else far_away())
    clearance = np.array([step.clearance for step in trace.steps])
    assert clearance[5] < -0.05 and trace.outcome is Outcome.GOAL_REACHED
    assert np.all(clearance[60:] >= CONFIG.margin - CONFIG.promise_tolerance)


DRIVEN = ControlConfig(goal_position=0.002, goal_rotation=0.002, max_time=8.0)
MARGIN = DRIVEN.margin
START, ASIDE = np.array([0.0, 0.0]), np.array([0.3, 0.4])
EVERY = ("upper[0]", "upper[1]", "fore[0]", "fore[1]")


class BallArm(PlanarArm):
    """Each link's own surface is a ball for each sphere: so much smaller, and this far to the link's left [m]."""

    def __init__(self, smaller: float, left: float = 0.0, radius: float = 0.04) -> None:
        super().__init__(radius=radius)
        self.smaller, self.left = smaller, left

    def surface_gaps(
        self, positions: Float64, centers: Float64, radii: Float64, links: Collection[str] | None = None
    ) -> dict[str, Float64]:
        names = np.array(self.sphere_set.links)
        turns = np.stack([positions[:, 0], positions.sum(axis=1)])[(names == "fore").astype(int)].T
        left = np.stack([-np.sin(turns), np.cos(turns), np.zeros_like(turns)], axis=2)
        there = self.sphere_centers_batch(positions) + self.left * left
        away = np.linalg.norm(there[:, :, None] - centers, axis=3) - radii
        gap = away.min(axis=2) - self.sphere_set.radii + self.smaller
        return {link: gap[:, names == link].min(axis=1) for link in links or {"upper", "fore"}}


def half_space(axis: int, top: float) -> tuple[Balls, BallDistance]:
    """A thing `top` [m] below the base along an axis, flat to 8 mm over the arm's length. Of a table, below along z,
    the slope is half a degree: no joint does much about it.
    """
    down = np.array([0.0, -1.0, 0.0]) if axis == 1 else np.array([0.0, 0.01, -1.0])
    center = (50.0 + top) * down / np.linalg.norm(down)
    return Balls([center.tolist()], [50.0]), scene_of([center.tolist()], [50.0])


def driven(
    arm: PlanarArm,
    scene: tuple[Balls, BallDistance],
    end: Float64,
    *,
    by_surface: bool = True,
    seconds: float = 8.0,
    since: int = 0,
) -> ReplayTrace:
    """A closed loop from START, in a scene that is there from a stamp on."""
    task = ReplayTask(start=START, T_world_goal=arm.frame_pose(end, "tip"), frame="tip", home=end)
    fields, balls = (far_away(), scene[0]), (None, scene[1] if by_surface else None)
    config = replace(DRIVEN, max_time=seconds)
    return closed_loop(arm, config, task, lambda t: fields[t >= since], balls_at=lambda t: balls[t >= since])


def least_gaps(arm: BallArm, trace: ReplayTrace, scene: tuple[Balls, BallDistance]) -> dict[str, float]:
    gaps = arm.surface_gaps(np.asarray(trace.position), scene[1].centers, scene[1].radii)
    return {link: float(gap.min()) for link, gap in gaps.items()}


def test_an_arm_starts_whose_spheres_alone_are_within_the_margin_of_its_table() -> None:
    """Its spheres are 5 mm above it, its surfaces 29 mm, and no joint lifts them."""
    arm, table = BallArm(0.024), half_space(2, 0.045)
    trace = driven(arm, table, ASIDE)
    assert trace.outcome is Outcome.GOAL_REACHED and num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert trace.by_surface == EVERY
    assert min(step.clearance for step in trace.steps) == pytest.approx(0.029, abs=1e-3)


def test_the_surface_keeps_the_margin_where_the_arm_is_driven_against_the_thing() -> None:
    arm, centers = BallArm(0.02), [[0.0, -50.05, 0.0], [0.0, 50.05, 0.0]]  # a gap that has no room for the spheres
    gap, end = (Balls(centers, [50.0, 50.0]), scene_of(centers, [50.0, 50.0])), np.array([-0.3, -0.2])
    trace = driven(arm, gap, end)
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert min(least_gaps(arm, trace, gap).values()) == pytest.approx(MARGIN, abs=1e-3)
    assert num_on_rung(driven(arm, gap, end, by_surface=False, seconds=0.2), Rung.RELAXED)


def test_a_surface_that_turns_towards_the_thing_within_its_sphere_keeps_the_margin() -> None:
    arm, wall = BallArm(0.03, left=0.03, radius=0.06), half_space(1, 0.065)
    arm.sphere_set.centers[3, 0] = 0.0  # about the elbow: turned in place, it sticks out by 6 cm, then by nothing
    arm.velocity_limit[0] = 1e-3
    trace = driven(arm, wall, np.array([0.0, 2.5]), seconds=5.0)
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert "fore[0]" in trace.by_surface and trace.position[-1][1] > 1.5
    assert least_gaps(arm, trace, wall)["fore"] == pytest.approx(MARGIN, abs=1e-3)


@pytest.mark.parametrize(
    ("smaller", "by_surface", "clearance"),
    [(0.01, True, 0.015), (0.01, False, 0.005), (0.0, True, 0.005)],  # of spheres that do not stick out
)
def test_a_surface_within_the_margin_is_what_a_row_lacks(smaller: float, by_surface: bool, clearance: float) -> None:
    trace = driven(BallArm(smaller), half_space(2, 0.045), ASIDE, by_surface=by_surface, seconds=0.01)
    (first,) = trace.steps
    assert first.rung is Rung.RELAXED and bool(trace.by_surface) is (smaller > 0 and by_surface)
    assert first.clearance == pytest.approx(clearance, abs=1e-3)
    asked = DRIVEN.barrier_gain * (MARGIN - clearance)
    assert max(row.slack for row in first.relaxed) == pytest.approx(asked, abs=0.02)


def test_rows_by_surface_are_less_the_derivative_of_their_distance() -> None:
    arm, wall, q = BallArm(0.02, left=0.01), half_space(1, 0.05), np.array([0.01, -0.02])
    every, box = np.ones(4, dtype=np.bool_), (-arm.velocity_limit, arm.velocity_limit)
    builder = RowBuilder(arm, DRIVEN, wall[0]).replace_field(*wall)
    rows = builder.at(State(model=arm, frame="tip", q=q, box=box, by_surface=every))
    steps = 1e-5 * np.eye(2)
    slopes = [(builder.distances(q + e, every) - builder.distances(q - e, every)) / 2e-5 for e in steps]
    np.testing.assert_allclose(rows.external.G, -np.stack(slopes, axis=1)[:4], atol=1e-5)
    np.testing.assert_array_equal(rows.distance, builder.distances(q, every))
    gaps = arm.surface_gaps(q[None], wall[1].centers, wall[1].radii)
    np.testing.assert_allclose(rows.external.distance, np.repeat([gaps["upper"][0], gaps["fore"][0]], 2))


@pytest.mark.parametrize(("axis", "top", "names"), [(2, 0.045, EVERY), (1, 0.058, ())])
def test_spheres_that_can_keep_their_margin_from_a_newer_scene_do(
    axis: int, top: float, names: tuple[str, ...]
) -> None:
    trace = driven(BallArm(0.024), half_space(axis, top), np.array([0.0, 0.4]), since=100_000_000)
    assert set(trace.by_surface) == set(names)
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
