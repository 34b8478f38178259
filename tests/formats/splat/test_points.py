"""Coloured point clouds, points alone, and files with faces."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.ply import is_mesh, read_points, read_positions
from tests.formats.splat.test_gaussian_ply import ascii_ply

COLOURED = ["x", "y", "z", "red", "green", "blue"]
ROWS: list[list[object]] = [[1, 2, 3, 255, 0, 51], [4, 5, 6, 0, 255, 0]]


def test_points_are_read_in_metres_with_colours_from_0_to_1(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", COLOURED, ROWS)
    cloud = read_points(path)
    assert np.array_equal(cloud.points, np.float32([[1, 2, 3], [4, 5, 6]]))
    assert cloud.colors == pytest.approx(np.array([[1, 0, 0.2], [0, 1, 0]]))
    assert read_positions(path).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert not is_mesh(path)


@pytest.mark.parametrize(
    ("names", "rows", "said"),
    [
        (["x", "y", "z", "red", "blue"], [[1, 2, 3, 1, 1]], "no coloured point cloud: missing properties green"),
        (COLOURED, [], "has no points"),
        (COLOURED, [[*ROWS[0][:3], 256, 1, 1]], "expected 0 to 255, got up to 256"),
    ],
)
def test_what_is_no_coloured_point_cloud_is_refused(
    tmp_path: Path, names: list[str], rows: list[list[object]], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        read_points(ascii_ply(tmp_path / "a.ply", names, rows))


def test_positions_need_no_colours_but_three_axes_and_a_point(tmp_path: Path) -> None:
    assert read_positions(ascii_ply(tmp_path / "a.ply", ["x", "y", "z"], [[1000, 2, 3]])).tolist() == [[1000, 2, 3]]
    with pytest.raises(InputError, match="no point cloud: missing properties z"):
        read_positions(ascii_ply(tmp_path / "a.ply", ["x", "y"], [[1, 2]]))
    with pytest.raises(InputError, match="has no points"):
        read_positions(ascii_ply(tmp_path / "a.ply", ["x", "y", "z"], []))


@pytest.mark.parametrize("num", [0, 3])
def test_a_file_with_faces_is_a_mesh(tmp_path: Path, num: int) -> None:
    path = ascii_ply(tmp_path / "a.ply", COLOURED, ROWS)
    path.write_text(path.read_text().replace("end_header", f"element face {num}\nend_header"))
    assert is_mesh(path) == (num > 0)
    assert is_mesh(tmp_path / "a.obj")
    with pytest.raises(InputError, match=r"none.ply: cannot be read: No such file"):
        is_mesh(tmp_path / "none.ply")
