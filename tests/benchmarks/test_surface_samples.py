import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.surface_samples import SurfaceSamples, inscribed_radii, sample_mesh, thin
from splatctrl_cli.robot.link_meshes import MeshDistance
from tests.robot.test_link_meshes import box_distance, box_mesh

SIZE = (0.3, 0.2, 0.1)


@pytest.mark.parametrize("spacing", [0.01, 0.02])
def test_samples_lie_on_the_surface_no_nearer_than_the_spacing_and_leave_no_hole(spacing: float) -> None:
    samples = sample_mesh(box_mesh(SIZE), spacing, seed=3)
    np.testing.assert_allclose(box_distance(samples.points, SIZE), 0.0, atol=1e-12)
    np.testing.assert_allclose(box_distance(samples.points + 0.01 * samples.normals, SIZE), 0.01, atol=1e-12)
    tree = cKDTree(samples.points)
    assert tree.query(samples.points, k=2)[0][:, 1].min() >= spacing
    anywhere = sample_mesh(box_mesh(SIZE), 0.004, seed=4).points
    assert tree.query(anywhere)[0].max() < 1.25 * spacing  # candidates 0.2 of a spacing apart, on average


def test_thinning_takes_points_in_their_order() -> None:
    line = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.5, 0, 0], [1.0, 0, 0], [2.6, 0, 0]])
    np.testing.assert_array_equal(thin(line, 1.0), [0, 2, 4])


def test_inscribed_balls_touch_their_sample_and_stay_inside() -> None:
    mesh, largest, tolerance = box_mesh((0.3, 0.2, 0.03)), 0.02, 1e-4
    samples, field = sample_mesh(mesh, 0.01, seed=0), MeshDistance(mesh)
    radii = inscribed_radii(samples, largest, lambda points: field.closest(points)[1], tolerance=tolerance)
    depth = -field.signed(samples.points - radii[:, None] * samples.normals)
    assert (depth > radii - tolerance - 1e-12).all()
    is_top = np.abs(samples.normals[:, 2]) == 1
    from_rim = np.min(np.array([0.15, 0.1]) - np.abs(samples.points[:, :2]), axis=1)
    middle = is_top & (from_rim > 0.016)
    np.testing.assert_allclose(radii[middle], 0.015, atol=tolerance)  # half of the thickness
    near_rim = is_top & (from_rim < 0.014)
    assert near_rim.any()
    np.testing.assert_allclose(radii[near_rim], from_rim[near_rim], atol=2e-3)
    assert (radii[near_rim] <= from_rim[near_rim] + tolerance).all()


def test_where_there_is_room_the_ball_is_as_large_as_asked() -> None:
    samples = SurfaceSamples(points=np.zeros((1, 3)), normals=np.array([[0.0, 0, 1]]))
    assert inscribed_radii(samples, 0.01, lambda points: points * [1, 1, 0]).tolist() == [0.01]
