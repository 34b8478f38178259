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


def carrying(index: int, x: float, depth: float = 0.1, *, is_flat: bool = False) -> RgbdFrame:
    """A view of the floor with a speckled hand at the image's border, always the same."""
    seen = frame(index, x=x)
    seen.color[HAND] = 60 if is_flat else np.random.default_rng(5).integers(0, 2, (20, 25, 1)) * 120
    seen.depth[HAND] = depth
    return seen


def views(depth: float = 0.1, *, is_flat: bool = False) -> list[RgbdFrame]:
    return [carrying(k, x, depth, is_flat=is_flat) for k, x in enumerate(np.linspace(-0.2, 0.2, 9))]


def test_what_the_camera_carries_is_found_and_the_world_is_not() -> None:
    """Surface at the depth of the world is not mounted."""
    mask, none = (mounted_pixels(views(depth), MIN_RANGE) for depth in (0.1, 0.8))
    assert mask[2:18, 2:20].all() and not mask[30:].any() and not mask[:, 40:].any()
    assert not none.any()


def test_a_flat_colour_without_depth_is_background_not_mounted() -> None:
    """The background is black where everything has a depth."""
    flat, counted = views(0.0, is_flat=True), [np.ones((60, 80), bool)] * 9
    assert not mounted_pixels(flat, MIN_RANGE)[2:18, 2:18].any()
    assert background_color(flat, counted) == pytest.approx((60 / 255,) * 3)
    assert background_color([frame()], counted[:1]) == (0.0, 0.0, 0.0)


def test_a_camera_that_stands_still_carries_nothing() -> None:
    still = spread_views([carrying(k, 0.0) for k in range(9)])
    assert len(still) == 1 and mounted_pixels(still, MIN_RANGE) is None


def test_the_map_does_not_explain_what_a_camera_carries() -> None:
    """Surface beyond the least range may be an object."""
    far, near = (
        SceneFitter(SceneConfig(max_splats=600, first_iterations=30), OccupancyConfig(), WORKSPACE, threads=1)
        for _ in range(2)
    )
    far.step(views(depth=0.3))
    near.step(views())
    view = near.window.newest[0]
    assert not far.mounted["cam0"].any()
    assert not view.mappable[2:18, 2:20].any() and not view.target.counted[2:18, 2:20].any()
    bare = make_view(view.frame, near.view(replace(view.frame, camera="other")).mappable)
    assert np.array_equal(view.target.counted[30:], bare.target.counted[30:])
