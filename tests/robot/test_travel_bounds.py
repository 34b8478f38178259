from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.kernels.chain import PRISMATIC, REVOLUTE, Chain
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.spheres import lever_arms


def random_chain(seed: int, num_joints: int = 6) -> tuple[Chain, np.ndarray, np.ndarray]:
    """A tree of joints with random places and axes, one of them prismatic, and three spheres on every body."""
    rng = np.random.default_rng(seed)
    B = num_joints + 1
    axis = rng.normal(size=(B, 3))
    placement = np.empty((B, 3, 4))
    for b in range(B):
        placement[b, :, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        placement[b, :, :3] *= np.sign(np.linalg.det(placement[b, :, :3]))
        placement[b, :, 3] = rng.normal(scale=0.3, size=3)
    kind = np.full(B, REVOLUTE)
    kind[3] = PRISMATIC
    body = np.repeat(np.arange(B), 3)
    chain = Chain(
        parent=np.array([0, 0, 1, 2, 3, 2, 5]),
        kind=kind,
        placement=placement,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        sphere_body=body,
        offset=rng.normal(scale=0.1, size=(len(body), 3)),
    )
    lower, upper = np.full(num_joints, -2.5), np.full(num_joints, 2.5)
    lower[2], upper[2] = -0.1, 0.4
    return chain, lower, upper


@pytest.mark.parametrize("seed", range(4))
def test_no_centre_moves_more_per_radian_than_its_lever_arm(seed: int) -> None:
    chain, lower, upper = random_chain(seed)
    levers = lever_arms(chain, lower, upper)
    q = np.random.default_rng(seed + 10).uniform(lower, upper, (400, len(lower)))
    travel = np.max([np.linalg.norm(chain.jacobians(row)[1], axis=1) for row in q], axis=0)
    assert np.all(travel <= levers + 1e-12)
    assert np.all((travel > 0) == (levers > 0))
    assert np.min(travel[levers > 0] / levers[levers > 0]) > 0.4  # bounds, but not idle ones


def test_the_lever_of_a_spheres_own_joint_is_its_distance_to_the_axis() -> None:
    chain, lower, upper = random_chain(0)
    levers = lever_arms(chain, lower, upper)
    for s, body in enumerate(chain.sphere_body):
        if body > 0 and chain.kind[body] == REVOLUTE:
            across = np.linalg.norm(np.cross(chain.axis[body], chain.offset[s]))
            assert levers[s, body - 1] == pytest.approx(across, abs=1e-12)


def test_the_robot_knows_its_lever_arms(sample_data: Path) -> None:
    arm = RobotModel.from_urdf(sample_data / "tabletop/robot.urdf", sample_data / "tabletop/robot_spheres.yaml")
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (100, arm.num_joints))
    travel = np.max([np.linalg.norm(arm.sphere_jacobians(row), axis=1) for row in q], axis=0)
    assert np.all(travel <= arm.lever_arms() + 1e-12)
