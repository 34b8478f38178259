from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.formats.grid import iso_surface as module
from splatctrl_cli.formats.grid.iso_surface import Surface, iso_surface, write_surface
from splatctrl_cli.records import DistanceGrid
from tests.formats.grid.make_grid import ball_grid, random_grid

MIDDLE = np.array([0.1, 0.0, 0.0])


def mesh_of(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


@pytest.mark.parametrize(("level", "radius"), [(0.0, 0.3), (0.05, 0.35), (-0.1, 0.2)])
def test_the_surface_of_a_ball_is_where_its_distance_says_and_faces_outwards(level: float, radius: float) -> None:
    grid = ball_grid()
    grid.channels["sdf"] = grid.channels["sdf"] - np.float32(level)
    surface = iso_surface(grid)
    mesh = mesh_of(surface)
    away = surface.vertices - MIDDLE
    # between two centres the distance is off its chord by at most voxel^2 / (8 r)
    assert np.abs(np.linalg.norm(away, axis=1) - radius).max() <= 0.04**2 / (8 * (radius - 0.04)) + 1e-5
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=(0.04 / radius) ** 2)
    assert ((mesh.vertex_normals * away).sum(axis=1) > 0.95 * radius).all()


@pytest.mark.parametrize("shape", [(21, 22, 23), (22, 21, 24)])
def test_slabs_join_to_what_one_piece_gives(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int, int]) -> None:
    grid = ball_grid(shape=shape)
    whole = iso_surface(grid)
    monkeypatch.setattr(module, "CHUNK", 4 * shape[1] * shape[2] * 3)
    pieces = iso_surface(grid)
    np.testing.assert_allclose(pieces.vertices, whole.vertices, atol=1.01 * module.STEP * grid.voxel)
    assert {tuple(np.roll(f, -np.argmin(f))) for f in pieces.faces} == {
        tuple(np.roll(f, -np.argmin(f))) for f in whole.faces
    }
    assert mesh_of(pieces).is_watertight


@pytest.mark.parametrize("chunk", [1, 1 << 24])
def test_cells_without_a_distance_make_no_surface(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    monkeypatch.setattr(module, "CHUNK", chunk)
    grid = ball_grid()
    whole = iso_surface(grid)
    blank = np.zeros(grid.channels["sdf"].shape, bool)
    blank[1:5, 9:13, 9:13] = True
    grid.channels["sdf"] = np.where(blank, np.float32(np.nan), grid.channels["sdf"])

    def touches(surface: Surface) -> np.ndarray:  # type: ignore[type-arg]
        cube = np.floor((surface.vertices[surface.faces].mean(axis=1) - grid.origin) / grid.voxel).astype(int)
        return np.any([blank[tuple((cube + corner).T)] for corner in np.ndindex(2, 2, 2)], axis=0)

    open_surface = iso_surface(grid)
    assert not touches(open_surface).any()
    assert len(open_surface.faces) == len(whole.faces) - touches(whole).sum() < len(whole.faces)
    assert np.isfinite(open_surface.vertices).all()


def test_every_suffix_reads_back_as_the_same_triangles(tmp_path: Path) -> None:
    surface = iso_surface(ball_grid())
    for suffix in (".ply", ".obj", ".stl"):
        write_surface(tmp_path / f"field{suffix}", surface)
        read = trimesh.load_mesh(tmp_path / f"field{suffix}", process=False)
        np.testing.assert_allclose(read.triangles, surface.vertices[surface.faces], atol=1e-6)
    normals = trimesh.load_mesh(tmp_path / "field.ply", process=False).vertex_normals
    np.testing.assert_allclose(normals, mesh_of(surface).vertex_normals, atol=1e-4)  # sharp triangles


def test_a_grid_without_a_surface_is_told_with_its_range() -> None:
    far = ball_grid()
    far.channels["sdf"] = far.channels["sdf"] + np.float32(1.0)
    with pytest.raises(
        NotEvaluableError, match=r"expected sdf to cross 0 m, got values from 0.71\d+ to 1.\d+ m; bake"
    ):
        iso_surface(far)
    blank = ball_grid()
    blank.channels["sdf"] = np.full_like(blank.channels["sdf"], np.nan)
    with pytest.raises(NotEvaluableError, match="got no cell that has a distance"):
        iso_surface(blank)
    thin = random_grid("sdf", shape=(1, 4, 4))
    with pytest.raises(NotEvaluableError, match="at least 2 cells along each axis"):
        iso_surface(thin)


def test_only_cells_without_a_distance_between_the_sides_leave_no_surface() -> None:
    sdf = np.full((6, 6, 6), 1.0, np.float32)
    sdf[:2], sdf[2:4] = -1.0, np.nan
    grid = DistanceGrid(origin=np.zeros(3), voxel=0.1, channels={"sdf": sdf}, header={})
    with pytest.raises(NotEvaluableError, match="expected sdf to cross 0 m"):
        iso_surface(grid)
