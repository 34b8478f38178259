"""People and the truth in a replay, and figures that have no value."""

import numpy as np
import pytest

from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import START
from tests.jobs.stage import FAR, Ball, Stage, decisive, resting

pytestmark = pytest.mark.usefixtures("without_plots")


@pytest.mark.parametrize(("human_margin", "code"), [(0.02, 0), (0.055, 0), (0.065, 1)])
def test_people_are_kept_at_a_margin_of_their_own(stage: Stage, human_margin: float, code: int) -> None:
    stage.people = [stage.ball_at_the_end(0.06)]
    found, verdict = stage.judged("--set", f"control.human_margin={human_margin}")
    assert (found, decisive(verdict)) == (code, {"clearance of people": "failed"} if code else {})


def test_things_are_not_kept_at_the_margin_of_people(stage: Stage) -> None:
    stage.balls = [FAR, stage.ball_at_the_end(0.06)]
    assert stage.judged("--set", "control.human_margin=0.1")[0] == 0


def nearest_to(stage: Stage, ball: Ball) -> float:
    """Of the moving arm's surface over the logged motion [m]."""
    moving = np.flatnonzero(stage.arm.moving_spheres)
    centers = stage.arm.sphere_centers_batch(np.array([s.position for s in stage.states]))[:, moving]
    gaps = np.linalg.norm(centers - np.array(ball[0]), axis=2) - stage.arm.sphere_set.radii[moving] - ball[1]
    return float(gaps.min())


def test_the_truth_is_that_of_the_nearest_surface_not_of_the_nearest_centre(stage: Stage, arm: RobotModel) -> None:
    stage.states = resting(num=3)
    ball = deceiving(arm, START)
    stage.balls = [FAR]
    stage.judged("--truth", str(stage.truth(ball)))
    assert stage.desk.metrics()["min_clearance_true"] == pytest.approx(nearest_to(stage, ball), abs=1e-9)


def deceiving(arm: RobotModel, q: Float64) -> Ball:
    """A ball whose nearest sphere by the centre is not the one whose surface is nearest."""
    moving = np.flatnonzero(arm.moving_spheres)
    centers, radii = arm.sphere_centers(q)[moving], arm.sphere_set.radii[moving]
    for point in np.random.default_rng(0).uniform(-1, 1, (5000, 3)):
        gaps = np.linalg.norm(centers - point, axis=1)
        if (gaps - radii)[np.argmin(gaps)] > (gaps - radii).min() + 0.005 and (gaps - radii).min() > 0.15:
            return (float(point[0]), float(point[1]), float(point[2])), 0.05
    raise AssertionError
