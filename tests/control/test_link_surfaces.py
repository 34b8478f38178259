"""Spheres that stick out of their links: where they start within the margin the links' own surfaces keep it."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import BallDistance
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.qp_rows import RowBuilder
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.control.terms import State
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm, far_away, num_on_rung, scene_of

CONFIG = ControlConfig(goal_position=0.002, goal_rotation=0.002, max_time=8.0)
MARGIN = CONFIG.margin
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
    arm: PlanarArm, scene: tuple[Balls, BallDistance], end: Float64, *, by_surface: bool = True, **changes: object
) -> ReplayTrace:
    task = ReplayTask(start=START, T_world_goal=arm.frame_pose(end, "tip"), frame="tip", home=end)
    task = replace(task, **changes)  # type: ignore[arg-type]
    balls = scene[1] if by_surface else None
    return closed_loop(arm, CONFIG, task, lambda _: scene[0], balls_at=lambda _: balls)


def least_gaps(arm: BallArm, trace: ReplayTrace, scene: tuple[Balls, BallDistance]) -> dict[str, float]:
    gaps = arm.surface_gaps(np.asarray(trace.position), scene[1].centers, scene[1].radii)
    return {link: float(gap.min()) for link, gap in gaps.items()}


def test_an_arm_starts_whose_spheres_alone_are_within_the_margin_of_its_table() -> None:
    arm, table = (
        BallArm(0.024),
        half_space(2, 0.045),
    )  # spheres 5 mm above it, surfaces 29 mm, and no joint lifts them
    trace = driven(arm, table, ASIDE)
    assert trace.outcome is Outcome.GOAL_REACHED and num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert trace.by_surface == EVERY
    assert min(step.clearance for step in trace.steps) == pytest.approx(0.029, abs=1e-3)
    before = driven(arm, table, ASIDE, by_surface=False)
    assert num_on_rung(before, Rung.RELAXED) and not before.by_surface


def test_the_surface_keeps_the_margin_where_the_arm_is_driven_against_the_thing() -> None:
    arm, centers = BallArm(0.02), [[0.0, -50.05, 0.0], [0.0, 50.05, 0.0]]  # a gap that has no room for the spheres
    gap = Balls(centers, [50.0, 50.0]), scene_of(centers, [50.0, 50.0])
    trace = driven(arm, gap, np.array([-0.3, -0.2]))
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert min(least_gaps(arm, trace, gap).values()) == pytest.approx(MARGIN, abs=1e-3)
    assert num_on_rung(driven(arm, gap, np.array([-0.3, -0.2]), by_surface=False), Rung.RELAXED)


def test_a_surface_that_turns_towards_the_thing_within_its_sphere_keeps_the_margin() -> None:
    arm, wall = BallArm(0.03, left=0.03, radius=0.06), half_space(1, 0.065)
    arm.sphere_set.centers[3, 0] = 0.0  # about the elbow: turned in place, it sticks out by 6 cm, then by nothing
    arm.velocity_limit[0] = 1e-3
    trace = driven(arm, wall, np.array([0.0, 2.5]))
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert "fore[0]" in trace.by_surface
    least = least_gaps(arm, trace, wall)
    assert least["fore"] == pytest.approx(MARGIN, abs=1e-3)
    assert trace.position[-1][1] > 1.5


def test_spheres_that_do_not_stick_out_keep_their_margin() -> None:
    arm, table = BallArm(0.0), half_space(2, 0.045)
    trace = driven(arm, table, ASIDE)
    assert trace.by_surface == () and num_on_rung(trace, Rung.RELAXED)


def test_a_surface_within_the_margin_is_what_a_row_lacks() -> None:
    arm, table = BallArm(0.01), half_space(2, 0.045)  # 5 mm and 15 mm
    for by_surface, clearance in ((True, 0.015), (False, 0.005)):
        first = driven(arm, table, ASIDE, by_surface=by_surface).steps[0]
        assert first.rung is Rung.RELAXED
        assert first.clearance == pytest.approx(clearance, abs=1e-3)
        asked = CONFIG.barrier_gain * (MARGIN - clearance)
        assert max(row.slack for row in first.relaxed) == pytest.approx(asked, abs=0.02)


def test_rows_by_surface_are_less_the_derivative_of_their_distance() -> None:
    arm, wall, q = BallArm(0.02, left=0.01), half_space(1, 0.05), np.array([0.01, -0.02])
    every, box = np.ones(4, dtype=np.bool_), (-arm.velocity_limit, arm.velocity_limit)
    builder = RowBuilder(arm, CONFIG, wall[0]).with_field(*wall)
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
    arm, scene = BallArm(0.024), half_space(axis, top)
    fields, end = (far_away(), scene[0]), np.array([0.0, 0.4])
    task = ReplayTask(start=START, T_world_goal=arm.frame_pose(end, "tip"), frame="tip", home=end)
    trace = closed_loop(
        arm,
        CONFIG,
        task,
        lambda t: fields[t >= 100_000_000],
        balls_at=lambda t: scene[1] if t >= 100_000_000 else None,
    )
    assert set(trace.by_surface) == set(names)
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
