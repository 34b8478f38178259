"""Pictures are written at the promised width, the same each time, and say what they cannot draw."""

from collections.abc import Callable
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.records import DistanceGrid, UInt8
from splatctrl_cli.report.pictures import (
    ComparisonRow,
    comparison_picture,
    field_slice_picture,
)


def row(depth_error: float) -> ComparisonRow:
    depth = np.full((30, 40), 1.0, np.float32)
    return ComparisonRow(
        title="cam0-0000",
        figures="20.0 dB",
        photo=np.full((30, 40, 3), 90, np.uint8),
        render=np.full((30, 40, 3), 0.5, np.float32),
        photo_depth=depth,
        render_depth=depth + np.float32(depth_error),
    )


def grid(*, observed: int = 1) -> DistanceGrid:
    axis = np.arange(20) * 0.05
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    sdf = (np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.2).astype(np.float32)
    channels = {"sdf": sdf, "observed": np.full(sdf.shape, observed, np.uint8)}
    return DistanceGrid(origin=np.zeros(3), voxel=0.05, channels=channels, header={})


def draw_comparison(path: Path) -> None:
    comparison_picture(path, [row(0.0), row(0.1)])


def draw_slice(path: Path) -> None:
    spheres = np.array([[0.2, 0.2, 0.5], [0.8, 0.8, 0.9]]), np.array([0.1, 0.1])
    field_slice_picture(path, grid(), 2, 0.5, spheres, "A ball")


@pytest.mark.parametrize("draw", [draw_comparison, draw_slice])
def test_a_picture_is_1200_pixels_wide_and_the_same_each_time(tmp_path: Path, draw: Callable[[Path], None]) -> None:
    before = dict(mpl.rcParams)
    draw(tmp_path / "a.png")
    draw(tmp_path / "b.png")
    image = picture(tmp_path / "a.png")
    assert image.shape[1] == 1200
    assert image.std() > 1.0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert dict(mpl.rcParams) == before


def picture(path: Path) -> UInt8:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image, np.uint8)


def test_the_depth_error_saturates_in_the_colour_bar_s_top_colour(tmp_path: Path) -> None:
    comparison_picture(tmp_path / "a.png", [row(0.0)])
    comparison_picture(tmp_path / "b.png", [row(0.2)])
    exact, wrong = (picture(tmp_path / name)[150, 950, ::-1] for name in ("a.png", "b.png"))
    assert wrong.astype(int)[:2].min() > 200, "yellow: at or above 5 cm"
    assert exact.astype(int).max() < 120, "dark blue: no error"


def test_never_seen_space_shows_in_a_slice(tmp_path: Path) -> None:
    field_slice_picture(tmp_path / "seen.png", grid(), 2, 0.5)
    field_slice_picture(tmp_path / "never.png", grid(observed=0), 2, 0.5)
    assert (tmp_path / "seen.png").read_bytes() != (tmp_path / "never.png").read_bytes()


def test_a_sphere_is_drawn_as_the_circle_of_the_cut(tmp_path: Path) -> None:
    areas = []
    for height in (0.5, 0.58, 0.8):
        sphere = np.array([[0.2, 0.2, height]]), np.array([0.1])
        field_slice_picture(tmp_path / "a.png", grid(), 2, 0.5, sphere)
        areas.append(num_orange(picture(tmp_path / "a.png")))
        (tmp_path / "a.png").unlink()
    whole, small = areas[0] - areas[2], areas[1] - areas[2]
    assert whole > 1000
    assert small / whole == pytest.approx(0.6**2, rel=0.05), "sqrt(0.1^2 - 0.08^2) = 0.06"


def num_orange(image: UInt8) -> int:
    blue, _, red = np.moveaxis(image.astype(int), -1, 0)
    return int(np.count_nonzero(red - blue > 100))


def test_a_slice_outside_the_grid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotEvaluableError, match=r"slice z = 2 m: expected 0\.000 to 0\.950 m"):
        field_slice_picture(tmp_path / "a.png", grid(), 2, 2.0)


def test_a_comparison_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotEvaluableError, match="no view to draw"):
        comparison_picture(tmp_path / "a.png", [])
