"""A post in the way of an arm, which two cameras look at."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.environments import drawn_texture
from experiments.problems import Problem, Views, simulated_arm, views_of
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.primitives import Primitive
from tests.cli.conftest import arm, desk, few_points
from tests.conftest import plain_arm
from tests.jobs.conftest import stage
from tests.quick import painted, parsed_once, unpainted

__all__ = ["arm", "desk", "few_points", "painted", "parsed_once", "plain_arm", "stage", "unpainted"]

HOME = np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785])
TURN = np.array([0.8, 0, 0, 0, 0, 0, 0])  # [rad] from either side of the post to the other


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return simulated_arm()


def post(model: RobotModel, radius: float = 0.03) -> Primitive:
    """A post that the hand sweeps half way, and that neither end is near."""
    T = np.eye(4)
    T[:3, 3] = model.frame_pose(HOME, "hand")[:3, 3]
    texture = drawn_texture(np.random.default_rng(0))
    return Primitive(name="post", kind="cylinder", size=(radius, 0.3), T_world_shape=T, texture=texture)


@pytest.fixture(scope="module")
def problem(model: RobotModel) -> Problem:
    return Problem(
        environment="tabletop", number=0, model=model, things=(post(model),), start=HOME - TURN, goal=HOME + TURN
    )


@pytest.fixture(scope="module")
def views(problem: Problem) -> Views:
    return views_of(problem, 2, width=160, num_steps=1)


def blind(views: Views) -> Views:
    """The same frames without depth."""
    return Views(steps=tuple(tuple(replace(f, depth=0 * f.depth) for f in step) for step in views.steps))
