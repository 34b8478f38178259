from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.records import DistanceGrid, VoxelState
from splatctrl_cli.report.field_pictures import gradient_picture, probability_picture, slices_picture

SHAPE = (40, 30, 20)


def ball() -> DistanceGrid:
    """A ball of 0.3 m about (2, 1.5, 1), seen below z = 1 alone."""
    points = 0.1 * np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"), axis=-1)
    offset = points - [2.0, 1.5, 1.0]
    distance = np.linalg.norm(offset, axis=3)
    sdf = (distance - 0.3).astype(np.float32)
    channels = {
        "sdf": sdf,
        "gradient": (offset / np.maximum(distance, 1e-9)[..., None]).astype(np.float32),
        "observed": np.where(points[..., 2] < 1.0, VoxelState.FREE, VoxelState.NEVER_SEEN).astype(np.uint8),
        "probability": np.clip(1 - distance, 0, 1).astype(np.float32),
    }
    return DistanceGrid(origin=np.zeros(3), voxel=0.1, channels=channels, header={"observed": "from the grid"})


def picture(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape[1] == 1200
    return image


def test_slices_show_what_they_are_asked_for_and_repeat_to_the_byte(tmp_path: Path) -> None:
    grid, point = ball(), (2.0, 1.5, 1.0)
    slices_picture(tmp_path / "a.png", grid, point)
    slices_picture(tmp_path / "b.png", grid, point)
    slices_picture(tmp_path / "c.png", grid, (0.0, 0.0, 0.0))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert np.any(picture(tmp_path / "a.png") != picture(tmp_path / "c.png"))


def test_space_that_was_never_seen_is_marked_where_somebody_looked(tmp_path: Path) -> None:
    grid = ball()
    slices_picture(tmp_path / "seen.png", grid, (2.0, 1.5, 0.5))
    grid.header["observed"] = "no occupancy grid: all never seen"
    slices_picture(tmp_path / "unknown.png", grid, (2.0, 1.5, 0.5))
    assert np.any(picture(tmp_path / "seen.png") != picture(tmp_path / "unknown.png"))


@pytest.mark.parametrize("point", [(2.0, 1.5, 1.0), (-9.0, 99.0, 0.0)])
def test_pictures_of_gradient_and_probability_are_drawn_anywhere(tmp_path: Path, point: tuple[float, ...]) -> None:
    gradient_picture(tmp_path / "gradient.png", ball(), [0, 3, 100, 1], 0.5, point)
    probability_picture(tmp_path / "probability.png", ball(), point)
    for name in ("gradient.png", "probability.png"):
        assert picture(tmp_path / name).std() > 1.0


def test_a_slice_without_any_distance_is_drawn(tmp_path: Path) -> None:
    grid = ball()
    grid.channels["sdf"][...] = np.nan
    grid.channels["gradient"][...] = np.nan
    slices_picture(tmp_path / "slices.png", grid, (2.0, 1.5, 1.0))
    gradient_picture(tmp_path / "gradient.png", grid, [0, 0], 0.5, (2.0, 1.5, 1.0))
    assert picture(tmp_path / "slices.png").std() > 1.0


def test_a_large_slice_is_thinned_out(tmp_path: Path) -> None:
    sdf = np.broadcast_to(np.linspace(-1, 1, 1300, dtype=np.float32)[:, None, None], (1300, 2, 2))
    grid = DistanceGrid(origin=np.zeros(3), voxel=0.001, channels={"sdf": sdf}, header={})
    slices_picture(tmp_path / "slices.png", grid, (0.5, 0.0, 0.0))
    assert picture(tmp_path / "slices.png").std() > 1.0
