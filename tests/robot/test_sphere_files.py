"""Sphere files: every layout in use is read, what is written is read back, and the rest is refused by name; and how
far a joint may move a sphere.
"""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.kernels.chain import PRISMATIC, REVOLUTE, Chain
from splatctrl_cli.records import Box, SphereSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import add_boxes, lever_arms, read_sphere_file, spheres_yaml
from tests.robot.shapes import BALL, BOX, arm_of, written

CUROBO = """robot_cfg:
  kinematics:
    collision_sphere_buffer: {buffer}
    collision_spheres: {spheres}
"""
THREE = """
  a:
    - {center: [0.1, 0, 0], radius: 0.05}
    - {center: [0.2, 0, 0], radius: -10.0}
  b:
    - {center: [0, 0.3, 0], radius: 0.01}
"""


def test_a_plain_file_and_a_urdf_of_spheres_are_read_and_spheres_of_no_size_are_off(tmp_path: Path) -> None:
    file = read_sphere_file(written(tmp_path, "collision_spheres:" + THREE, "s.yaml"))
    assert (file.layout, file.spheres.links, file.num_off) == ("YAML", ("a", "b"), 1)
    np.testing.assert_array_equal(file.spheres.centers, [[0.1, 0, 0], [0, 0.3, 0]])
    np.testing.assert_array_equal(file.spheres.radii, [0.05, 0.01])
    file = read_sphere_file(written(tmp_path, arm_of(BALL, BALL)))
    assert (file.layout, file.spheres.links, file.num_off) == ("URDF", ("base", "tip"), 0)


def test_what_is_written_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    centers = np.random.default_rng(0).normal(size=(2, 3))
    spheres = SphereSet(links=("a", "b"), centers=centers, radii=np.array([1 / 3, 1e-6]))
    again = read_sphere_file(written(tmp_path, spheres_yaml(spheres, ["of a test"]), "t.yaml")).spheres
    assert again.links == spheres.links
    np.testing.assert_array_equal(again.centers, centers)
    np.testing.assert_array_equal(again.radii, spheres.radii)


@pytest.mark.parametrize(
    ("buffer", "radii", "num_off"),
    [("0.0", [0.05, 0.01], 1), ("0.002", [0.052, 0.012], 1), ("-0.01", [0.04], 2), ("{b: 0.03}", [0.05, 0.04], 1)],
)
def test_curobo_adds_its_buffer_and_may_keep_spheres_elsewhere(
    tmp_path: Path, buffer: str, radii: list[float], num_off: int
) -> None:
    written(tmp_path, "collision_spheres:" + THREE, "spheres/arm.yml")
    file = read_sphere_file(written(tmp_path, CUROBO.format(buffer=buffer, spheres="spheres/arm.yml"), "arm.yml"))
    assert (file.layout, file.num_off) == ("cuRobo YAML", num_off)
    np.testing.assert_allclose(file.spheres.radii, radii, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "layout", "count"),
    [
        ("robot_spheres/curobo/curobo/content/configs/robot/franka.yml", "cuRobo YAML", 61),
        ("robot_spheres/curobo/curobo/content/configs/robot/ur10e.yml", "cuRobo YAML", 21),
        ("robot_spheres/robometrics/robometrics/content/robot/franka_spheres.yml", "YAML", 61),
        ("vamp_panda/resources/panda/panda_spherized.urdf", "URDF", 59),
    ],
)
def test_public_sets_are_read(real_data: Path, name: str, layout: str, count: int) -> None:
    file = read_sphere_file(real_data / name)
    assert (file.layout, len(file.spheres.radii) + file.num_off) == (layout, count)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "not valid YAML"),
        ("- 1", "expected the layout collision_spheres: .*; or a URDF whose collision shapes are spheres"),
        ("spheres: {}", "expected the layout collision_spheres"),
        ("collision_spheres: none.yml", "none.yml: cannot be read"),
        ("collision_spheres: {a: 3}", "link 'a': expected a list of spheres, got 3"),
        ("collision_spheres: {a: [{center: [0, 0, .nan], radius: 1}]}", "link 'a': sphere 0: expected .*finite"),
        ("collision_spheres: {a: [{center: [0, 0, 0], radius: .inf}]}", "link 'a': sphere 0: expected .*finite"),
        ("collision_spheres: {a: [{center: [0, 0, 0]}]}", "link 'a': sphere 0: expected"),
        ("collision_spheres: {a: [{center: [0, 0, 0], radius: -1}]}", "got none, all 1 of radius 0 or less"),
        ("collision_spheres: {}", "expected collision spheres, got none"),
        (CUROBO.format(buffer="wide", spheres="{a: []}"), "collision_sphere_buffer: expected numbers .* got 'wide'"),
        (arm_of(BOX, BALL), "spheres only, got 1 other shapes; .* fit one with: splatctrl robot spheres"),
    ],
)
def test_other_files_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_sphere_file(written(tmp_path, text, "s.urdf" if text.startswith("<") else "s.yaml"))


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
    assert np.all(travel <= levers + 1e-12) and np.all((travel > 0) == (levers > 0))
    assert np.min(travel[levers > 0] / levers[levers > 0]) > 0.4  # bounds, but not idle ones
    for s, body in enumerate(chain.sphere_body):
        if body > 0 and chain.kind[body] == REVOLUTE:  # by its own joint, it is its distance to the axis
            assert levers[s, body - 1] == pytest.approx(
                np.linalg.norm(np.cross(chain.axis[body], chain.offset[s])), abs=1e-12
            )


def test_the_robot_knows_its_lever_arms(plain_arm: Path) -> None:
    arm = RobotModel.from_urdf(plain_arm / "tabletop/robot.urdf", plain_arm / "tabletop/robot_spheres.yaml")
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (100, arm.num_joints))
    assert np.all(
        np.max([np.linalg.norm(arm.spheres_at(row)[1], axis=1) for row in q], axis=0) <= arm.lever_arms() + 1e-12
    )


def test_spheres_of_a_carried_box_cover_it_and_stick_out_by_millimetres() -> None:
    box = Box(lower=np.array([-0.025, -0.03, 0.07]), upper=np.array([0.025, 0.05, 0.12]))
    spheres = add_boxes(SphereSet(links=("arm",), centers=np.zeros((1, 3)), radii=np.array([0.1])), [("hand", box)])
    assert (spheres.links[0], set(spheres.links[1:])) == ("arm", {"hand"})
    centers, radii = spheres.centers[1:], spheres.radii[1:]
    corners = np.array(list(product(*zip(box.lower, box.upper, strict=True))))
    points = np.concatenate([np.random.default_rng(0).uniform(box.lower, box.upper, (2000, 3)), corners])
    assert (np.linalg.norm(points[:, None] - centers, axis=2) - radii).min(axis=1).max() < 1e-12
    out = np.maximum(box.lower - (centers - radii[:, None]), centers + radii[:, None] - box.upper)
    assert 0.0 < out.max() < 0.012
