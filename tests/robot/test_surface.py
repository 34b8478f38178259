"""What a robot's own surface is made of: a capsule's parts, and meshes of packages elsewhere."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pinocchio.rpy import rpyToMatrix

from splatctrl_cli.control.audit import BallDistance, part_clearances
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform, pose_at, transform_points
from splatctrl_cli.records import Box, Float64, SphereSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_model import ALWAYS
from tests.reference.triangles import distance_to_triangles
from tests.robot.shapes import arm_of, held_part, l_shape, written

BALL = '<sphere radius="0.02"/>'
CAPSULE = '<capsule radius="0.1" length="0.4"/>'
ORIGIN = '<origin xyz="0.1 0.2 0.3" rpy="0 1.5707963267948966 0"/>'
TURNED = '<origin xyz="0.1 0.2 0.3" rpy="0.4 0.7 -0.5"/>'
SPHERES = SphereSet(links=("base", "tip"), centers=np.zeros((2, 3)), radii=np.full(2, 0.3))


def distance(model: RobotModel, points: Float64, **only: Any) -> Float64:
    surface, q = model.surface, np.zeros(1)
    return surface.distance(
        surface.poses({link: model.frame_pose(q, link) for link in surface.links}), points, **only
    )


def test_a_capsule_is_a_cylinder_with_round_ends(tmp_path: Path) -> None:
    """Along x here: from (-0.1, 0.2, 0.3) to (0.3, 0.2, 0.3)."""
    model = RobotModel.from_urdf(written(tmp_path, arm_of(CAPSULE, BALL, origin=ORIGIN)), SPHERES)
    assert model.surface.by_spheres == ()
    points = np.random.default_rng(0).uniform([-0.5, -0.2, 0.4], [0.6, 0.6, 0.9], (200, 3))
    ends = np.array([[-0.1, 0.2, 0.3], [0.3, 0.2, 0.3]])
    nearest = np.clip(points[:, :1], ends[0, 0], ends[1, 0]) * [1, 0, 0] + [0, 0.2, 0.3]
    expected = np.linalg.norm(points - nearest, axis=1) - 0.1
    to_ball = np.linalg.norm(points - [0, 0, 0.3], axis=1) - 0.02  # of the other link
    assert distance(model, points) == pytest.approx(np.minimum(expected, to_ball), abs=1e-9)


def test_meshes_of_packages_elsewhere_are_the_surface_where_their_folder_is_given(tmp_path: Path) -> None:
    mesh = tmp_path / "elsewhere" / "far" / "ell.stl"
    mesh.parent.mkdir(parents=True)
    l_shape().export(mesh)
    urdf = written(tmp_path / "robot", arm_of('<mesh filename="package://far/ell.stl"/>', BALL))
    assert RobotModel.from_urdf(urdf, SPHERES).surface.by_spheres == ("base",)
    found = RobotModel.from_urdf(urdf, SPHERES, packages=[tmp_path / "elsewhere"]).surface
    assert found.by_spheres == () and len(found.triangles) == len(l_shape().faces)


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere", "capsule", "mesh"])
def test_extents_are_those_of_the_same_shape_as_triangles(tmp_path: Path, kind: str) -> None:
    shape, text = {
        "box": (trimesh.creation.box((0.2, 0.3, 0.5)), '<box size="0.2 0.3 0.5"/>'),
        "cylinder": (trimesh.creation.cylinder(0.1, 0.4, 512), '<cylinder radius="0.1" length="0.4"/>'),
        "sphere": (trimesh.creation.icosphere(5, 0.1), '<sphere radius="0.1"/>'),
        "capsule": (trimesh.creation.capsule(0.4, 0.1, (512, 256)), '<capsule radius="0.1" length="0.4"/>'),
        "mesh": (l_shape(), '<mesh filename="ell.stl"/>'),
    }[kind]
    if kind == "mesh":
        shape.export(tmp_path / "ell.stl")
    model = RobotModel.from_urdf(written(tmp_path, arm_of(text, BALL, origin=TURNED)), SPHERES)
    assert model.surface.by_spheres == ()
    T = pose_at([0.1, 0.2, 0.3], rpyToMatrix(0.4, 0.7, -0.5))
    found = model.extents()["base"]
    np.testing.assert_allclose(found[:6], shape.apply_transform(T).bounds.ravel(), atol=2e-4)
    parts = 0.2 * np.pi * 0.3 if kind == "capsule" else 0.0  # it is a cylinder and two balls, whole
    assert found[6] == pytest.approx(shape.area + parts, rel=2e-3)


def seen_as(text: str, mesh: str) -> str:
    """A URDF with a mesh as the visual geometry of `base`."""
    visual = f"<visual><geometry>{mesh}</geometry></visual>"
    return text.replace('<link name="base">', f'<link name="base">{visual}')


@pytest.mark.parametrize("is_visual", [True, False])
@pytest.mark.parametrize(
    ("factor", "scale", "line"),
    [
        (1e3, "1 1 1", 'got 300 m; looks like millimetres: scale="0.001 0.001 0.001"'),
        (1e3, "1 -1 1", 'got 300 m; looks like millimetres: scale="0.001 -0.001 0.001"'),
        (1.0, "0.001 0.001 0.001", 'got 0.0003 m; looks like metres: scale="1 1 1"'),
        (1e-4, "1 1 1", "got 3e-05 m; correct its scale"),
    ],
)
def test_a_mesh_in_another_unit_is_refused_with_the_unit_that_it_looks_like(
    tmp_path: Path, is_visual: bool, factor: float, scale: str, line: str
) -> None:
    l_shape().apply_scale(factor).export(tmp_path / "ell.obj", digits=12)
    mesh = f'<mesh filename="ell.obj" scale="{scale}"/>'
    model = RobotModel.from_urdf(
        written(tmp_path, seen_as(arm_of(BALL, BALL), mesh) if is_visual else arm_of(mesh, BALL)), SPHERES
    )
    with pytest.raises(InputError) as refused:
        assert model.surface
    assert str(refused.value) == f"link 'base': mesh ell.obj: expected a length of 1 mm to 10 m, {line}"


def test_what_stands_for_a_link_without_its_visual_geometry_is_said_with_the_reason(tmp_path: Path) -> None:
    mesh, balls = '<mesh filename="none.stl"/>', arm_of(BALL, BALL)
    lost = f"{tmp_path / 'robot.urdf'}: link 'base': mesh none.stl was not found"
    alone = SphereSet(links=("tip",), centers=np.zeros((1, 3)), radii=np.full(1, 0.3))
    for text, spheres, notes in (
        (seen_as(balls, mesh), SPHERES, (f"collision geometry stands for base: {lost}",)),
        (arm_of(mesh, BALL), SPHERES, (f"spheres stand for base: {lost}",)),
        (arm_of(mesh, BALL), alone, (f"nothing stands for base: {lost}",)),
        (
            balls.replace("collision>", "inertial>"),
            SPHERES,
            ("spheres stand for base, tip: no visual or collision geometry in the URDF",),
        ),
        (balls, SPHERES, ()),
    ):
        assert RobotModel.from_urdf(written(tmp_path, text), spheres).surface.notes == notes


def with_visual(folder: Path, visual: str) -> RobotModel:
    """A tip that collides as a box of 0.4 m and is seen as a mesh."""
    text = arm_of(BALL, '<box size="0.4 0.4 0.4"/>')
    drawn = f'<link name="tip"><visual><geometry><mesh filename="{visual}"/></geometry></visual>'
    spheres = SphereSet(
        links=("base", "tip"), centers=np.array([[0, 0, 0], [0.1, 0.1, 0.05]]), radii=SPHERES.radii.copy()
    )
    return RobotModel.from_urdf(written(folder, text.replace('<link name="tip">', drawn)), spheres)


def test_the_distance_to_a_mesh_is_exact_and_negative_inside(tmp_path: Path) -> None:
    """A link is as it is seen, and as it collides where that cannot be read."""
    l_shape().export(tmp_path / "ell.stl")
    model, gone = with_visual(tmp_path, "ell.stl"), with_visual(tmp_path, "gone.stl").surface
    assert len(model.surface.triangles) == len(l_shape().faces) and len(model.surface.kinds) == 1
    assert not len(gone.triangles) and len(gone.kinds) == 2 and model.surface.by_spheres == gone.by_spheres == ()
    points = np.random.default_rng(3).uniform(-0.1, 0.4, (400, 3)) + np.array([0, 0, 0.3])
    gaps = []
    for arm in [trimesh.creation.box(bounds=b) for b in ([[0, 0, 0], [0.3, 0.1, 0.1]], [[0, 0, 0], [0.1, 0.3, 0.1]])]:
        there = points - [0, 0, 0.3]
        beyond = np.maximum(arm.bounds[0] - there, there - arm.bounds[1])
        gaps.append(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0))
    to_ball = np.linalg.norm(points, axis=1) - 0.02
    outside = np.min(gaps, axis=0) > 0
    found = distance(model, points)
    np.testing.assert_allclose(found[outside], np.minimum(np.min(gaps, axis=0), to_ball)[outside], atol=1e-6)
    assert (found[~outside] < 0).all() and np.sum(~outside) > 10
    near = distance(model, points, within=0.05, without=["base"])
    is_far = np.min(gaps, axis=0) > 0.05 + 1e-6
    assert np.isinf(near[is_far]).all() and np.isfinite(near[~is_far]).all()


@pytest.mark.parametrize("q", [-0.7, 0.0, 0.4])
def test_a_link_with_triangles_is_as_clear_as_its_surface_and_no_sphere_says_less(tmp_path: Path, q: float) -> None:
    l_shape().export(tmp_path / "ell.stl")
    model = with_visual(tmp_path, "ell.stl")
    centers = np.random.default_rng(4).uniform(-0.6, 0.6, (30, 3)) + np.array([0.9, 0, 0.3])
    radii = np.full(30, 0.02)

    def of_points(points: Float64) -> Float64:
        return np.asarray((np.linalg.norm(points[:, None] - centers, axis=2) - radii).min(axis=1))

    scene = BallDistance(of_points=of_points, centers=centers, radii=radii)
    each, is_surface = part_clearances(model, np.array([[q]]), scene)
    there = transform_points(invert_transform(model.frame_pose(np.array([q]), "tip")), centers)
    assert each.min() == pytest.approx(distance_to_triangles(there, l_shape().triangles).min() - 0.02, abs=1e-6)
    assert is_surface.all()
    assert not part_clearances(model, np.array([[q]]), of_points)[1].any()
    assert part_clearances(model, np.array([[q]]), of_points)[0].min() < each.min()  # a ball of 0.3 m
    model.sphere_set.radii[:] = 0.01  # one that leaves the link uncovered says no more than its surface, either
    assert part_clearances(model, np.array([[q]]), scene)[0].min() == pytest.approx(each.min(), abs=1e-9)


def test_what_a_link_with_triangles_carries_or_has_of_boxes_counts_as_well(tmp_path: Path) -> None:
    """A ball below a box beside the mesh: one that is carried, one that was learned, one of the URDF."""
    l_shape().export(tmp_path / "ell.stl")
    model = with_visual(tmp_path, "ell.stl")
    q = np.zeros((1, 1))
    scene = np.array([[0.0, 0.0, 0.3 - 0.55]]), np.array([0.05])
    assert model.surface_gaps(q, *scene)["tip"][0] == pytest.approx(0.5, abs=1e-6)
    box = Box(lower=np.array([-0.05, -0.05, -0.4]), upper=np.array([0.05, 0.05, -0.3]))
    assert model.carrying([("tip", box)]).surface_gaps(q, *scene)["tip"][0] == pytest.approx(0.1, abs=1e-6)
    part = held_part("tip", np.asarray(trimesh.creation.box(bounds=[box.lower, box.upper]).triangles), *ALWAYS)
    assert model.join_self_model(part).surface_gaps(q, *scene)["tip"][0] == pytest.approx(0.1, abs=1e-6)
    capsules = RobotModel.from_urdf(written(tmp_path / "solid", arm_of(BALL, '<box size="0.4 0.4 0.4"/>')), SPHERES)
    both = capsules.join_self_model(held_part("tip", l_shape().triangles + np.array([0.0, 0.0, 1.0]), *ALWAYS))
    assert both.surface_gaps(q, *scene)["tip"][0] == pytest.approx(0.55 - 0.2 - 0.05, abs=1e-6)
