"""Which moments are the worst, which image shows each, and what is drawn on it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.evaluate.worst_frames import BODY, WORST, Moment, draw_sight, sights_of, worst_moments
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame
from tests.plain import plain_frame

SECOND = 1_000_000_000
LENS = Intrinsics(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
MOMENT = Moment(
    stamp_ns=SECOND,
    centers=np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]),
    radii=np.array([0.1, 0.05]),
    is_moving=np.array([False, True]),
    worst=1,
    obstacle=np.array([0.35, 0.0, 0.0]),
    caption=("a line", "a longer line " * 12),
)


def frame(stamp_ns: int, camera: str = "near", *, away: float = 1.0, depth: float = 0.0, x: float = 0.0) -> RgbdFrame:
    """A camera that looks along world z from `away` before the origin; a grey image of its stamp in tenths."""
    return plain_frame(
        depth, LENS, pose_at([x, 0.0, -away]), stamp_ns=stamp_ns, camera=camera, color=stamp_ns * 10 // SECOND
    )


@pytest.mark.parametrize("num", [0, 1, 2, 3, 9])
def test_the_worst_moments_are_those_of_separate_events(num: int) -> None:
    seconds = np.arange(0, 10, 0.01)
    clearance = 1.0 - 0.5 * np.exp(-((seconds - 2) ** 2)) - 0.7 * np.exp(-((seconds - 6) ** 2))
    clearance += 1e-3 * np.cos(40 * np.pi * seconds)  # ripples are no events
    clearance[:50] = np.nan
    found = worst_moments(np.round(seconds * SECOND).astype(np.int64), clearance, num)
    assert min(num, 2) <= len(found) <= num
    np.testing.assert_allclose(seconds[found][:2], [6.0, 2.0][:num], atol=0.06)
    assert np.all(np.diff(clearance[found]) >= 0)
    assert all(abs(seconds[a] - seconds[b]) >= 0.5 for a in found for b in found if a != b)


def test_the_flank_of_an_event_is_not_another() -> None:
    stamps = np.arange(0, 4 * SECOND, SECOND // 100)
    assert worst_moments(stamps, np.linspace(1.0, 0.1, len(stamps)), 3) == [len(stamps) - 1]
    assert worst_moments(stamps, np.full(len(stamps), np.nan), 3) == []


def test_a_moment_is_shown_by_the_newest_image_not_later() -> None:
    """The images are read once and no further than needed."""
    frames = iter([frame(k * SECOND // 10) for k in range(0, 40, 4)])
    late, early, before = sights_of([replace(MOMENT, stamp_ns=s) for s in (SECOND, SECOND // 2, -1)], frames)
    assert late is not None and early is not None and before is None
    assert (late[0].stamp_ns, early[0].stamp_ns) == (SECOND, SECOND // 2)
    assert (late[1].stamp_ns, early[1].stamp_ns) == (8 * SECOND // 10, 4 * SECOND // 10)
    assert next(frames).stamp_ns == 16 * SECOND // 10


@pytest.mark.parametrize(
    ("others", "best"),
    [
        ([frame(0, "far", away=3.0)], "near"),  # larger in the near one
        ([frame(0, "near", depth=0.5), frame(0, "far", away=3.0)], "far"),  # hidden by what is 0.5 m away
        ([frame(0, "near", x=-0.65), frame(0, "far", away=3.0)], "far"),  # the obstacle is outside the near one
    ],
)
def test_the_camera_that_sees_the_worst_sphere_best_is_taken(others: list[RgbdFrame], best: str) -> None:
    (sight,) = sights_of([MOMENT], [frame(0, "near"), *others])
    assert sight[1].camera == best


def drawn(path: Path, moment: Moment, view: RgbdFrame) -> Float64:
    draw_sight(path, moment, view)
    return np.asarray(cv2.imread(str(path)), dtype=np.float64)


def test_the_worst_sphere_is_outlined_where_it_is(tmp_path: Path) -> None:
    """The sphere is 0.2 m to the right at 1 m; the caption is below the image."""
    pixels = drawn(tmp_path / "worst.png", MOMENT, frame(SECOND))
    place = np.argwhere(np.all(np.abs(pixels[:720] - WORST) < 40, axis=2))
    np.testing.assert_allclose(place.mean(axis=0), 6 * np.array([59.5 + 0.5, 79.5 + 20.0 + 0.5]) - 0.5, atol=4)
    radius = np.linalg.norm(place - place.mean(axis=0), axis=1)
    np.testing.assert_allclose(radius, 100 * 0.05 * 6, atol=5)
    assert np.median(radius) == pytest.approx(30, abs=1)
    assert (pixels[720:].min(axis=(1, 2)) < 100).any()


def test_the_arm_is_one_tinted_silhouette(tmp_path: Path) -> None:
    """Two spheres that overlap have one outline; the image shows through."""
    both = replace(MOMENT, centers=np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0]]), is_moving=np.array([True, True]))
    pixels = drawn(tmp_path / "worst.png", both, frame(SECOND))
    row, column = (int(6 * (middle + 0.5)) for middle in (LENS.cy, LENS.cx))
    np.testing.assert_allclose(pixels[row - 50, column], 0.55 * 10 + 0.45 * np.array(BODY), atol=1)
    along = pixels[row + 12, column : column + 36]  # from the middle to the worst sphere: inside of the silhouette
    np.testing.assert_allclose(along[:2], pixels[row - 50, column][None].repeat(2, axis=0), atol=1)
    assert (np.abs(pixels[row - 50, : column - 100] - 10) < 1).all(), "nothing outside"


def test_a_sphere_around_the_camera_or_behind_it_is_not_drawn(tmp_path: Path) -> None:
    behind = replace(MOMENT, centers=MOMENT.centers - [0, 0, 2.0], obstacle=np.full(3, np.nan))
    assert np.ptp(drawn(tmp_path / "worst.png", behind, frame(SECOND))[:720]) == 0
