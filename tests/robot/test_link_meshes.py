"""Collision geometry: primitives and meshes against their formulas and float64, and where files are found."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.formats.mesh import TriangleMesh, load_mesh
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.link_meshes import MeshDistance, SolidDistance, read_solids
from splatctrl_cli.robot.urdf import read_urdf
from tests.reference.triangles import distance_to_triangles, winding_number
from tests.refused import expect_refusal
from tests.robot.shapes import BALL, BOX, ROD, arm_of, collada, l_shape, written


def box_distance(points: Float64, size: tuple[float, float, float]) -> Float64:
    gap = np.abs(points) - np.array(size) / 2
    return np.linalg.norm(np.maximum(gap, 0), axis=1) + np.minimum(gap.max(axis=1), 0)


def rod_distance(p: np.ndarray) -> np.ndarray:
    q = np.stack([np.hypot(p[:, 0], p[:, 1]) - 0.05, np.abs(p[:, 2]) - 0.2], axis=1)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


@pytest.mark.parametrize(
    ("shape", "truth"),
    [
        (BOX, partial(box_distance, size=(0.3, 0.2, 0.1))),
        (ROD, rod_distance),
        (BALL, lambda points: np.linalg.norm(points, axis=1) - 0.08),
    ],
)
def test_signed_distance_to_a_primitive_is_that_of_its_formula(tmp_path: Path, shape: str, truth) -> None:  # type: ignore[no-untyped-def]
    (solid,) = read_solids(read_urdf(written(tmp_path, arm_of(shape, BALL))))["base"]
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (3000, 3))
    assert solid.surface.is_closed and solid.slack <= 4e-4
    np.testing.assert_allclose(SolidDistance([solid])(points), truth(points), atol=solid.slack + 1e-12)


@pytest.mark.parametrize("shape", [ROD, BALL])
def test_the_true_surface_is_within_the_slack_of_the_triangles(tmp_path: Path, shape: str) -> None:
    (solid,) = read_solids(read_urdf(written(tmp_path, arm_of(shape, BOX))))["base"]
    rng = np.random.default_rng(1)
    way = rng.normal(size=(4000, 3))
    if shape == BALL:
        surface = 0.08 * way / np.linalg.norm(way, axis=1, keepdims=True)
    else:
        round_ = 0.05 * way[:, :2] / np.linalg.norm(way[:, :2], axis=1, keepdims=True)
        surface = np.column_stack([round_, rng.uniform(-0.2, 0.2, 4000)])
    mesh = trimesh.Trimesh(solid.surface.vertices, solid.surface.faces, process=False)
    corners = solid.surface.corners
    height = np.einsum("fa,qfa->qf", mesh.face_normals, surface[:, None] - corners[None, :, 0]).max(axis=1)
    assert 0.5 * solid.slack < height.max() <= solid.slack  # convex: the distance is at least the highest plane


def test_meshes_take_scale_and_origin_of_the_urdf(tmp_path: Path) -> None:
    l_shape().export(tmp_path / "ell.stl")
    origin = '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
    (solid,) = read_solids(
        read_urdf(written(tmp_path, arm_of('<mesh filename="ell.stl" scale="2 -1 1"/>', BALL, origin=origin)))
    )["base"]
    assert solid.surface.is_closed
    vertices = solid.surface.vertices
    np.testing.assert_allclose(vertices.min(axis=0), [1, 2, 3], atol=1e-6)  # (x, -y) turned by a quarter: (y, x)
    np.testing.assert_allclose(vertices.max(axis=0), [1.3, 2.6, 3.1], atol=1e-6)
    inside, hollow = np.array([[1.05, 2.1, 3.05]]), np.array([[1.2, 2.4, 3.05]])
    assert SolidDistance([solid])(inside)[0] < 0 < SolidDistance([solid])(hollow)[0]


@pytest.mark.parametrize(
    ("filename", "place", "folder"),
    [
        ("meshes/ell.stl", "meshes/ell.stl", None),
        ("package://my_robot/meshes/ell.stl", "meshes/ell.stl", None),
        ("package://other/ell.stl", "other/ell.stl", None),
        ("package://far/ell.stl", "../elsewhere/far/ell.stl", "elsewhere"),
    ],
)
def test_mesh_paths_are_found(tmp_path: Path, filename: str, place: str, folder: str | None) -> None:
    root = tmp_path / "my_robot"
    (root / place).parent.mkdir(parents=True)
    l_shape().export(root / place)
    urdf = read_urdf(
        written(
            root,
            arm_of(f'<mesh filename="{filename}"/>', BALL),
            "urdf/robot.urdf" if "package" in filename else "robot.urdf",
        )
    )
    if folder is not None:
        expect_refusal(r"link 'base': mesh package://far/ell.stl was not found; give the folder", read_solids, urdf)
    assert len(read_solids(urdf, [] if folder is None else [tmp_path / folder])["base"][0].surface.faces) == 20


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            arm_of('<mesh filename="none.stl"/>', BALL),
            "link 'base': mesh none.stl was not found; expected .*none",
        ),
        (
            arm_of('<mesh filename="a.stl" scale="1 0 1"/>', BALL),
            "mesh: scale: expected three numbers that are not",
        ),
        (arm_of('<cone radius="0.1"/>', BALL), "expected mesh, box, cylinder, capsule or sphere, got <cone>"),
        (arm_of(BALL, BALL).replace("collision>", "visual>"), "expected collision geometry, got none"),
    ],
)
def test_shapes_that_cannot_be_read_are_refused(tmp_path: Path, text: str, words: str) -> None:
    urdf = written(tmp_path, text)
    expect_refusal(f"robot.urdf.*{words}", lambda: read_solids(read_urdf(urdf)))


def test_an_open_mesh_is_taken_apart_and_its_open_part_measured_by_its_hull_where_it_has_one(tmp_path: Path) -> None:
    closed, opened = trimesh.creation.box(extents=(0.1, 0.1, 0.1)), trimesh.creation.box(extents=(0.2, 0.2, 0.2))
    opened = trimesh.Trimesh(opened.vertices + np.array([1, 0, 0]), opened.faces[1:], process=False)
    trimesh.util.concatenate([closed, opened]).export(tmp_path / "two.stl")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False).export(tmp_path / "sheet.stl")
    solids = read_solids(
        read_urdf(written(tmp_path, arm_of('<mesh filename="two.stl"/>', '<mesh filename="sheet.stl"/>')))
    )
    assert [solid.surface.is_closed for solid in solids["base"]] == [True, False]
    np.testing.assert_allclose(
        SolidDistance(solids["base"])(np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0]])),
        [-0.05, -0.1, 0.4],
        atol=1e-6,
    )
    assert solids["tip"][0].body is None
    np.testing.assert_allclose(SolidDistance(solids["tip"])(np.array([[0.2, 0.2, 0.3]])), [0.3])


def test_a_visual_mesh_is_read_from_collada_in_its_unit(tmp_path: Path) -> None:
    text = collada(trimesh.creation.box((1, 2, 3)))
    for unit in ("1", "0.001"):
        (tmp_path / "box.dae").write_text(text.replace('meter="1"', f'meter="{unit}"'))
        mesh = load_mesh(tmp_path / "box.dae")
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), float(unit) * np.array([1, 2, 3]), rtol=1e-6)
        assert len(mesh.faces) == 12
    (tmp_path / "box.dae").write_text(text[:300])
    expect_refusal(r"box\.dae: expected a mesh, got ", load_mesh, tmp_path / "box.dae")


def test_a_collada_mesh_of_several_parts_is_whole() -> None:
    """Each part has faces that count its own vertices, from 0; they are not those of the parts before it."""
    loading = pytest.importorskip(
        "tools.mujoco.robots", reason="the robots are not installed: pip install -e '.[sim]'"
    )
    mesh = load_mesh(loading.robots_folder() / "ur_description/meshes/ur5/visual/wrist1.dae")
    area = 0.5 * np.linalg.norm(np.cross(*np.diff(mesh.corners, axis=1).swapaxes(0, 1)), axis=1).sum()
    assert area == pytest.approx(0.0461, rel=0.01)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.077, 0.085, 0.105], atol=1e-3)


CLOSED = (
    "featuretype.STL",
    "rocker-arm.obj",
    "spot.obj",
    "unit_sphere.STL",
    "ycb/YcbBanana.obj",
    "ycb/YcbMustardBottle.obj",
    "ycb/YcbPowerDrill.obj",
)


def box_mesh(size: tuple[float, float, float], *, is_closed: bool = True) -> TriangleMesh:
    box = trimesh.creation.box(extents=size)
    return TriangleMesh(
        vertices=np.array(box.vertices, dtype=np.float64),
        faces=np.array(box.faces, dtype=np.int64),
        is_closed=is_closed,
    )


def test_signed_distance_to_a_box_is_the_analytic_one_and_that_of_its_closest_point() -> None:
    size, mesh = (0.3, 0.2, 0.1), MeshDistance(box_mesh((0.3, 0.2, 0.1)))
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (4000, 3))
    corner_ties = np.array([[0.25, 0.2, 0.15], [0.0, 0.0, 0.2], [0.2, 0.2, 0.0]])  # beyond a corner, a face, an edge
    points = np.concatenate([points, corner_ties])
    signed = mesh.signed(points)
    assert (signed < 0).sum() > 20
    np.testing.assert_allclose(signed, box_distance(points, size), atol=1e-12)
    distance, surface, is_inside = mesh.closest(points)
    np.testing.assert_allclose(box_distance(surface, size), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - surface, axis=1), distance, atol=1e-15)
    np.testing.assert_array_equal(is_inside, signed < 0)


@pytest.mark.parametrize("name", CLOSED)
def test_every_face_is_tried_that_may_be_the_nearest(real_data: Path, name: str) -> None:
    mesh = load_mesh(real_data / "meshes" / name)
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    mesh = replace(mesh, vertices=0.3 * (mesh.vertices - 0.5 * (lower + upper)) / (upper - lower).max())
    assert mesh.is_closed
    points = np.random.default_rng(2).uniform(-0.25, 0.25, (60, 3))
    points = np.concatenate([points, 0.5 * mesh.vertices[::200]])  # some inside
    signed = MeshDistance(mesh).signed(points)
    np.testing.assert_allclose(np.abs(signed), distance_to_triangles(points, mesh.corners), atol=1e-12)
    np.testing.assert_array_equal(signed < 0, winding_number(points, mesh.corners) > 0.5)
    assert 0 < np.count_nonzero(signed < 0) < len(points)


def test_triangles_of_very_different_sizes_are_all_tried() -> None:
    rng = np.random.default_rng(3)
    corners = rng.uniform(-0.3, 0.3, (200, 1, 3)) + 10.0 ** rng.uniform(-4, 0, (200, 1, 1)) * rng.normal(
        size=(200, 3, 3)
    )
    mesh = TriangleMesh(vertices=corners.reshape(-1, 3), faces=np.arange(600).reshape(-1, 3), is_closed=False)
    points = rng.uniform(-0.5, 0.5, (200, 3))
    distance, _, is_inside = MeshDistance(mesh).closest(points)
    np.testing.assert_allclose(distance, distance_to_triangles(points, mesh.corners), atol=1e-12)
    assert not is_inside.any()
    np.testing.assert_array_equal(
        MeshDistance(mesh).distance(points, 0.1), np.where(distance <= 0.1, distance, np.inf)
    )


def test_distance_turns_with_the_mesh_and_scales_with_it() -> None:
    mesh = box_mesh((0.3, 0.2, 0.1))
    points = np.random.default_rng(4).uniform(-0.4, 0.4, (300, 3))
    before = MeshDistance(mesh).signed(points)
    rotation = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))

    def moved(x: Float64) -> Float64:
        return np.asarray(2.5 * x @ rotation.T + [1.0, -2.0, 0.5])

    turned = TriangleMesh(vertices=moved(mesh.vertices), faces=mesh.faces, is_closed=True)
    np.testing.assert_allclose(MeshDistance(turned).signed(moved(points)), 2.5 * before, atol=1e-12)


def test_an_open_mesh_has_no_inside_and_a_seam_does_not_open_one(tmp_path: Path) -> None:
    box = trimesh.creation.box(extents=(0.2, 0.2, 0.2))
    box.unmerge_vertices()  # as the seams of a texture leave it
    box.export(tmp_path / "seams.stl")
    assert load_mesh(tmp_path / "seams.stl").is_closed
    trimesh.Trimesh(box.vertices, box.faces[:-1], process=False).export(tmp_path / "open.stl")
    mesh = load_mesh(tmp_path / "open.stl")
    assert not mesh.is_closed and MeshDistance(mesh).signed(np.zeros((1, 3)))[0] == pytest.approx(0.1)
