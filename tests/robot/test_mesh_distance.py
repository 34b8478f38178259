from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.formats.mesh import TriangleMesh, load_mesh
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.link_meshes import MeshDistance
from tests.reference.triangles import distance_to_triangles, winding_number

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


def box_distance(points: Float64, size: tuple[float, float, float]) -> Float64:
    gap = np.abs(points) - np.array(size) / 2
    return np.linalg.norm(np.maximum(gap, 0), axis=1) + np.minimum(gap.max(axis=1), 0)


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
