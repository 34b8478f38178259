"""The simulated arm: its spheres cover its shapes, tightly; what is seen of it lies inside of them, if asked for."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.urdf import Shape, read_urdf, visual_urdf
from splatctrl_cli.simulate.arm import (
    JOINTS,
    SHAPES,
    SLIM,
    UNMODELLED,
    Capsule,
    arm_spheres_yaml,
    arm_urdf,
)
from splatctrl_cli.simulate.primitives import Primitive, Texture
from splatctrl_cli.simulate.truth import distance_to
from tests.robot.shapes import written


@pytest.fixture(scope="module")
def arm(plain_arm: Path) -> RobotModel:
    return RobotModel.from_urdf(plain_arm / "tabletop/robot.urdf", plain_arm / "tabletop/robot_spheres.yaml")


def samples(shape: Shape, count: int = 3000) -> Float64:
    """Points on a shape's surface, in its link's frame; the corners and rims among them."""
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((count, 3))
    points = direction / np.linalg.norm(direction, axis=1, keepdims=True) * shape.size[0]
    if shape.kind == "box":
        points = rng.uniform(-1, 1, (count, 3))
        points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
        corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
        points = np.concatenate([points, corners]) * np.array(shape.size) / 2
    elif shape.kind == "cylinder":
        angle = rng.uniform(0, 2 * np.pi, count)
        z = np.concatenate([rng.uniform(-0.5, 0.5, count // 2), rng.choice([-0.5, 0.5], count - count // 2)])
        points = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)]) * shape.size[0]
        points[:, 2] = z * shape.size[1]
    return points @ shape.T_link_shape[:3, :3].T + shape.T_link_shape[:3, 3]


def test_spheres_cover_every_shape_to_a_millimetre(arm: RobotModel) -> None:
    links = np.array(arm.sphere_set.links)
    for shape in arm.urdf.shapes:
        own = links == shape.link
        gap = (
            np.linalg.norm(samples(shape)[:, None] - arm.sphere_set.centers[own], axis=2) - arm.sphere_set.radii[own]
        )
        assert gap.min(axis=1).max() < 1e-3, shape


def solid(shape: Shape) -> Primitive:
    """In the frame of its link."""
    texture = Texture(pattern="noise", feature=1.0, dark=(0, 0, 0), bright=(1, 1, 1))
    return Primitive(
        name=shape.link, kind=shape.kind, size=shape.size, T_world_shape=shape.T_link_shape, texture=texture
    )


def protrusion(arm: RobotModel, link: str) -> float:
    """How far [m] the link's spheres stand out of its shapes."""
    rng = np.random.default_rng(1)
    own = np.array(arm.sphere_set.links) == link
    direction = rng.standard_normal((400, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = (arm.sphere_set.centers[own, None] + arm.sphere_set.radii[own, None, None] * direction).reshape(-1, 3)
    solids = [solid(shape) for shape in arm.urdf.shapes if shape.link == link]
    return float(distance_to(solids, points, 0).max())


def test_spheres_stand_out_of_round_links_by_under_6_mm_and_of_the_flat_hand_by_under_2_cm(arm: RobotModel) -> None:
    for link in arm.urdf.links:
        assert protrusion(arm, link) < (0.02 if link == "hand" else 0.006), link


def test_limits_are_those_that_the_maker_publishes(arm: RobotModel) -> None:
    np.testing.assert_allclose(arm.lower, [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
    np.testing.assert_allclose(arm.upper, [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
    np.testing.assert_allclose(arm.velocity_limit, [2.175] * 4 + [2.61] * 3)
    assert arm.joint_names == tuple(joint[0] for joint in JOINTS)


def test_the_committed_robot_files_are_what_the_code_writes(plain_arm: Path) -> None:
    assert (plain_arm / "tabletop/robot.urdf").read_text() == arm_urdf()
    assert (plain_arm / "tabletop/robot_spheres.yaml").read_text() == arm_spheres_yaml()


def test_visual_shapes_lie_3_mm_inside_of_collision_shapes_and_a_twentieth_27_to_30_mm(
    tmp_path: Path,
) -> None:
    urdf = read_urdf(written(tmp_path, arm_urdf(SLIM)))
    seen, gaps, areas = visual_urdf(urdf), [], []
    for link in SHAPES:
        outer, inner = ([shape for shape in of.shapes if shape.link == link] for of in (urdf, seen))
        points = np.concatenate([samples(shape) for shape in inner])
        assert distance_to([solid(shape) for shape in outer], points, 0).max() < -2.8e-3
        for shape in outer:
            points = samples(shape)
            area = np.full(len(points), area_of(shape) / len(points))
            if shape.kind == "cylinder":
                area[len(points) // 2 :] = 0.0  # its ends are inside of balls
            is_outside = distance_to([solid(other) for other in outer], points, 0) > -1e-6
            gaps.append(distance_to([solid(part) for part in inner], points[is_outside], 0))
            areas.append(area[is_outside])
    gap, area = np.concatenate(gaps), np.concatenate(areas)
    order = np.argsort(gap)
    share = np.cumsum(area[order]) / area.sum()
    median, most = (gap[order][np.searchsorted(share, level)] for level in (0.5, 0.95))
    assert (median, most) == (pytest.approx(0.003, abs=1e-4), pytest.approx(0.027, abs=1e-3))
    assert gap.max() < 0.030 + 1e-6


def area_of(shape: Shape) -> float:
    """Of the surface [m^2] on which `samples` are, twice that of a cylinder's side."""
    if shape.kind == "box":
        x, y, z = shape.size
        return 2 * (x * y + y * z + z * x)
    return 4 * np.pi * shape.size[0] * (shape.size[1] if shape.kind == "cylinder" else shape.size[0])


def test_the_slim_arm_collides_as_the_other_does(arm: RobotModel, tmp_path: Path) -> None:
    slim, same, shapes = (
        [(s.link, s.kind, s.size) for s in urdf.shapes]
        for urdf in (read_urdf(written(tmp_path, arm_urdf(SLIM))), visual_urdf(arm.urdf), arm.urdf)
    )
    assert slim == same == shapes


@pytest.mark.parametrize("name", UNMODELLED)
def test_an_unmodelled_part_stands_out_of_the_link_that_carries_it(arm: RobotModel, name: str) -> None:
    link, capsules = UNMODELLED[name]
    assert all(isinstance(capsule, Capsule) for capsule in capsules)
    own = [solid(shape) for shape in arm.urdf.shapes if shape.link == link]
    distance = distance_to(own, np.concatenate([np.linspace(c.start, c.end, 20) for c in capsules]), 0)
    assert distance.max() > 0.015 and distance.min() < 0.02
