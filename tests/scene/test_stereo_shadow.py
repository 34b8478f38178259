"""What one of two imagers cannot see is no dark thing: a reference of two pinholes, and what must not pass for it."""

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.records import Bool, Float32, Intrinsics
from splatctrl_cli.scene.depth_holes import _behind, find_shadows, unanswered_points
from tests.plain import plain_frame
from tests.reference import shadows

FOCAL, BASELINE = 400.0, 0.05  # [px], [m]
WALL, PLATE = 2.0, 1.0  # [m]; the shadow is 10 px wide
HEIGHT, WIDTH = 40, 160
DARK = slice(15, 30)


def plates(*columns: slice) -> Float32:
    """Depth (H, W) [m] of plates before a wall."""
    depth = np.full((HEIGHT, WIDTH), WALL, np.float32)
    for column in columns:
        depth[5:35, column] = PLATE
    return depth


def hidden_from_right(depth: Float32) -> Bool:
    """Pixels (H, W) whose surface the right imager has something nearer before: pixel by pixel."""
    found = np.zeros(depth.shape, bool)
    for row, line in enumerate(depth):
        for u, z in enumerate(line):
            there = u - FOCAL * BASELINE / z
            found[row, u] = any(
                other < z and abs(k - FOCAL * BASELINE / other - there) < 0.5 for k, other in enumerate(line) if k > u
            )
    return found


def as_stereo(depth: Float32) -> Float32:
    return np.where(hidden_from_right(depth), np.float32(0.0), depth)


@pytest.mark.parametrize("turn", [1, -1])  # the other imager is at the right, or at the left
@pytest.mark.parametrize(
    "columns", [(slice(60, 90),), (slice(60, 90), slice(94, 110)), (slice(30, 40), slice(140, 160))]
)
def test_all_that_a_pair_cannot_see_is_shadow(columns: tuple[slice, ...], turn: int) -> None:
    seen = as_stereo(plates(*columns))[:, ::turn]
    assert (seen == 0).sum() >= 300 and (find_shadows(seen, FOCAL) == (seen == 0)).all()


def test_a_dark_thing_is_none_away_from_the_shadow() -> None:
    seen = as_stereo(plates(slice(60, 90)))
    seen[DARK, 90:110] = 0.0  # at the plate's other side
    seen[DARK, 20:51] = 0.0  # goes on from the shadow, whose first column is 50
    found = find_shadows(seen, FOCAL)
    assert not found[DARK, 90:109].any() and not found[DARK, 20:49].any()  # to the pixel
    assert found[DARK, 50:60].all()


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("seed", range(4))
def test_shadows_have_the_bytes_of_the_reference(seed: int, turn: int) -> None:
    """Noisy plates, pixels lost at random, and rows without any depth."""
    rng = np.random.default_rng(seed)
    seen = as_stereo(plates(slice(30, 50), slice(80 + 5 * seed, 110)))
    seen *= rng.normal(1.0, 0.01, seen.shape).astype(np.float32) * (rng.random(seen.shape) > 0.1 * seed)
    seen[[7, -1]] = 0.0
    seen = seen[:, ::turn]
    found = find_shadows(seen, FOCAL)
    assert 100 < np.count_nonzero(found) < np.count_nonzero(seen == 0)
    assert (found == shadows.find_shadows(seen, FOCAL, _behind(seen))).all()


def test_a_baseline_is_that_of_a_camera() -> None:
    seen, few = plates(slice(60, 90)), plates(slice(60, 90))
    seen[5:35, 10:60] = 0.0  # as of a baseline of 25 cm
    assert not find_shadows(seen, FOCAL)[:, :34].any()
    few[DARK, 45:60] = 0.0  # fewer than half of the plate's rows: a camera without shadows
    for depth in (few, np.zeros((4, 6), np.float32), np.ones((4, 6), np.float32)):
        assert not find_shadows(depth, FOCAL).any()


@pytest.mark.parametrize("is_dark", [False, True])
def test_a_shadow_is_no_place_without_an_answer(is_dark: bool) -> None:
    depth = as_stereo(plates(slice(60, 90)))
    depth[12:32, 15:40] = np.where(is_dark, 0.0, depth[12:32, 15:40])
    lens = Intrinsics(fx=FOCAL, fy=FOCAL, cx=80.0, cy=20.0, width=WIDTH, height=HEIGHT)
    found = list(
        unanswered_points(
            plain_frame(depth, lens), np.zeros((HEIGHT, WIDTH), np.float32), OccupancyConfig(voxel=0.01)
        )
    )
    assert (sum(map(len, found)) > 0) == is_dark


def test_background_between_the_robots_shadow_and_an_object_is_no_hole() -> None:
    """The same gap at another object's shadow is one."""
    robot, config = slice(100, 130), OccupancyConfig()
    seen = as_stereo(plates(slice(40, 50), robot))
    seen[DARK, 50:91] = 0.0  # background without depth, as far as the shadow
    drawn = np.zeros_like(seen)
    drawn[5:35, robot] = PLATE
    frame = plain_frame(seen, Intrinsics(fx=FOCAL, fy=FOCAL, cx=80.0, cy=20.0, width=WIDTH, height=HEIGHT))
    assert not list(unanswered_points(frame, drawn, config))
    assert sum(map(len, unanswered_points(frame, np.zeros_like(seen), config))) > 100
