"""Motions side by side on the planar arm: the figures of IV, and a clearance that holds between the states too."""

import numpy as np
import pytest

from experiments.yardstick import Motion, Yardstick, proved_clearance
from splatctrl_cli.config import ControlConfig
from splatctrl_cli.planner.planned import resample
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm

ARM = PlanarArm()
BALL = Balls([[0.7, 0.3, 0.0]], [0.05])
FROM, TO = np.array([-0.5, 0.2]), np.array([-0.1, 0.3])
TICK = 10_000_000


def straight(num: int, end: Float64 = TO) -> Motion:
    position = FROM + np.linspace(0, 1, num)[:, None] * (end - FROM)
    return Motion(stamp_ns=TICK * np.arange(num), position=position)


def yardstick(field: Balls = BALL, later: Balls | None = None, *, from_ns: int = 0) -> Yardstick:
    """One field, or another from a stamp on."""

    def at(stamp_ns: int) -> Balls:
        return later if later is not None and stamp_ns >= from_ns else field

    functions = {id(balls): (lambda points, b=balls: b.query(points)[0]) for balls in (field, later) if balls}
    named = {key: {"exact": value, "barrier": value} for key, value in functions.items()}
    return Yardstick(
        model=ARM,
        frame="tip",
        T_world_goal=ARM.frame_pose(TO, "tip"),
        config=ControlConfig(),
        distances_at=lambda stamp: named[id(at(stamp))],
        certified_at=lambda stamp: functions[id(at(stamp))],
        truth=lambda points, stamp: at(stamp).query(points)[0] - 0.01,
    )


def least(position: Float64, field: Balls = BALL) -> float:
    centers = ARM.sphere_centers_batch(position)[:, 1:]
    return float(np.min(field.query(centers.reshape(-1, 3))[0].reshape(-1, 4) - ARM.sphere_set.radii[1:]))


def test_the_figures_of_a_straight_motion_are_its_lengths_and_its_least_distances() -> None:
    motion = straight(101)
    figures = yardstick().figures(motion)
    assert figures.has_arrived and figures.is_success and figures.duration == pytest.approx(1.0)
    assert figures.joint_path == pytest.approx(np.linalg.norm(TO - FROM))
    tips = np.array([ARM.frame_pose(q, "tip")[:3, 3] for q in motion.position])
    assert figures.effector_path == pytest.approx(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum())
    assert figures.effector_turn == pytest.approx(np.degrees(0.5))
    assert figures.clearance["exact"] == figures.clearance["barrier"] == pytest.approx(least(motion.position))
    assert figures.true_clearance == pytest.approx(least(motion.position) - 0.01)
    assert figures.num_interventions is None


def test_figures_do_not_depend_on_how_often_a_motion_is_sampled() -> None:
    coarse, fine = (yardstick().figures(straight(num)) for num in (51, 401))
    assert coarse.joint_path == pytest.approx(fine.joint_path)
    assert coarse.effector_path == pytest.approx(fine.effector_path, rel=1e-3)
    assert coarse.proved < fine.proved <= fine.clearance["exact"] <= coarse.clearance["exact"] + 1e-12


def test_an_end_beside_the_goal_and_a_state_in_collision_are_no_success() -> None:
    beside = yardstick().figures(straight(51, end=TO - 0.05))
    assert not beside.has_arrived and not beside.is_success
    through = yardstick(Balls([[0.75, -0.1, 0.0]], [0.05])).figures(straight(51))
    assert through.has_arrived and not through.is_success and through.clearance["barrier"] < 0


def test_every_state_counts_by_the_scene_of_its_time() -> None:
    far = Balls([[3.0, 0.0, 0.0]], [0.05])
    motion = straight(51)
    figures = yardstick(far, BALL, from_ns=30 * TICK).figures(motion)
    assert figures.clearance["exact"] == pytest.approx(least(motion.position[30:]))
    gone = yardstick(BALL, far, from_ns=30 * TICK).figures(motion)
    assert gone.clearance["exact"] == pytest.approx(least(motion.position[:30]))


def test_interventions_are_counted_as_intervals() -> None:
    motion = straight(6)
    flags = np.array([True, True, False, True, False, True])
    motion = Motion(stamp_ns=motion.stamp_ns, position=motion.position, is_intervened=flags)
    assert yardstick().figures(motion).num_interventions == 3


@pytest.mark.parametrize("seed", range(30))
def test_a_proved_clearance_is_not_above_any_posture_between_the_states(seed: int) -> None:
    random = np.random.default_rng(seed)
    position = random.uniform(ARM.lower, ARM.upper, (4, 2))
    field = Balls(np.c_[random.uniform(-1, 1, (3, 2)), np.zeros(3)].tolist(), [0.03] * 3)
    motion = Motion(stamp_ns=TICK * np.arange(4), position=position)
    proved = proved_clearance(ARM, motion, lambda stamp: lambda points: field.query(points)[0])
    assert proved <= least(resample(position, 2e-3), field)
    assert proved > -4  # it says something


def test_a_missing_distance_is_no_success_and_no_proof() -> None:
    def blank(points: Float64) -> Float64:
        return np.where(points[:, 0] > 0.6, np.nan, 1.0)

    judge = yardstick()
    unknown = Yardstick(
        model=ARM,
        frame="tip",
        T_world_goal=judge.T_world_goal,
        config=judge.config,
        distances_at=lambda stamp: {"exact": blank, "barrier": blank},
        certified_at=lambda stamp: blank,
    )
    figures = unknown.figures(straight(11))
    assert figures.has_arrived and not figures.is_success
    assert np.isnan(figures.proved) and figures.true_clearance is None
