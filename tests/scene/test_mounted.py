"""What a moving camera carries, and what lies behind everything."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import make_view
from splatctrl_cli.scene.mounted import background_color, mounted_pixels, spread_views
from tests.scene.wall import WORKSPACE, frame

HAND = np.s_[:20, :25]  # rows and columns of what the camera carries
MIN_RANGE = 0.2


def carrying(index: int, x: float, depth: float = 0.1) -> RgbdFrame:
    """A view of the floor with a speckled hand at the image's border, always the same."""
    seen = frame(index, x=x)
    color, distance = seen.color.copy(), seen.depth.copy()
    color[HAND] = np.random.default_rng(5).integers(0, 2, (20, 25, 1)) * 120
    distance[HAND] = depth
    return replace(seen, color=color, depth=distance)


def views(depth: float = 0.1) -> list[RgbdFrame]:
    return [carrying(k, x, depth) for k, x in enumerate(np.linspace(-0.2, 0.2, 9))]


def test_what_the_camera_carries_is_found_and_the_world_is_not() -> None:
    mask = mounted_pixels(views(), MIN_RANGE)
    assert mask is not None
    assert mask[2:18, 2:20].all()
    assert not mask[30:].any()
    assert not mask[:, 40:].any()


def test_what_has_a_depth_of_the_world_is_not_mounted() -> None:
    mask = mounted_pixels(views(depth=0.8), MIN_RANGE)
    assert mask is not None
    assert not mask.any()


def test_a_flat_colour_without_depth_is_background_not_mounted() -> None:
    flat = []
    for view in views(depth=0.0):
        color = view.color.copy()
        color[HAND] = 60
        flat.append(replace(view, color=color))
    mask = mounted_pixels(flat, MIN_RANGE)
    assert mask is not None
    assert not mask[2:18, 2:18].any()
    counted = [np.ones(view.depth.shape, bool) for view in flat]
    assert background_color(flat, counted) == pytest.approx((60 / 255,) * 3)


def test_a_camera_that_stands_still_carries_nothing() -> None:
    still = [carrying(k, 0.0) for k in range(9)]
    assert len(spread_views(still)) == 1
    assert mounted_pixels(spread_views(still), MIN_RANGE) is None


def test_the_background_is_black_where_everything_has_a_depth() -> None:
    seen = frame()
    assert background_color([seen], [np.ones(seen.depth.shape, bool)]) == (0.0, 0.0, 0.0)


def test_the_map_does_not_explain_what_a_camera_carries() -> None:
    config = SceneConfig(max_splats=600, first_iterations=30)
    fitter = SceneFitter(config, OccupancyConfig(), WORKSPACE, threads=1)
    fitter.step(views(depth=0.3))
    assert not fitter.mounted["cam0"].any()  # it has a depth beyond the least range: an object, for all one knows
    fitter = SceneFitter(config, OccupancyConfig(), WORKSPACE, threads=1)
    fitter.step(views())
    view = fitter.window.newest[0]
    assert not view.mappable[2:18, 2:20].any()
    assert not view.target.counted[2:18, 2:20].any()
    bare = make_view(view.frame, fitter.view(replace(view.frame, camera="other")).mappable)
    assert np.array_equal(view.target.counted[30:], bare.target.counted[30:])
