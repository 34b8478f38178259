"""Coloured point clouds."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.splat_files.points import is_mesh, read_points, read_positions

HEADER = """ply
format ascii 1.0
element vertex 2
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "cloud.ply"
    path.write_text(text, encoding="ascii")
    return path


def test_points_are_read_in_metres_with_colours_from_0_to_1(tmp_path: Path) -> None:
    cloud = read_points(written(tmp_path, HEADER + "1 2 3 255 0 51\n4 5 6 0 255 0\n"))
    assert np.array_equal(cloud.points, np.float32([[1, 2, 3], [4, 5, 6]]))
    assert cloud.colors == pytest.approx(np.array([[1, 0, 0.2], [0, 1, 0]]))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEADER.replace("uchar green", "uchar grun") + "1 2 3 1 1 1\n1 2 3 1 1 1\n", "missing properties green"),
        (HEADER.replace("vertex 2", "vertex 0"), "has no points"),
        (HEADER + "1 2 3 1 1 1\n", "expected 2 lines"),
        (HEADER.replace("uchar", "float") + "1 2 3 256 1 1\n1 2 3 1 1 1\n", "expected 0 to 255, got up to 256"),
    ],
)
def test_what_is_no_coloured_point_cloud_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_points(written(tmp_path, text))


def test_positions_need_no_colours_and_keep_their_unit(tmp_path: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    path = written(tmp_path, header + "1000 2 3\n4 5 6\n")
    assert read_positions(path).tolist() == [[1000, 2, 3], [4, 5, 6]]
    assert not is_mesh(path)
    with pytest.raises(InputError, match="no point cloud: missing properties z"):
        read_positions(written(tmp_path, header.replace("property float z\n", "") + "1 2\n3 4\n"))
    with pytest.raises(InputError, match="has no points"):
        read_positions(written(tmp_path, header.replace("vertex 2", "vertex 0")))


def test_a_file_with_faces_is_a_mesh(tmp_path: Path) -> None:
    assert is_mesh(written(tmp_path, HEADER.replace("end_header", "element face 3\nend_header")))
    assert not is_mesh(written(tmp_path, HEADER.replace("end_header", "element face 0\nend_header")))
    assert is_mesh(tmp_path / "a.obj")
    with pytest.raises(InputError, match=r"none.ply: cannot be read: No such file"):
        is_mesh(tmp_path / "none.ply")
