"""Depth is lost on both sides of an edge: the surface may go on there, unless another camera looks past it."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.lost_edges import lost_edges
from splatctrl_cli.scene.self_mask import PixelKind, object_mask
from splatctrl_cli.voxels import LostEdges
from tests.scene.wall import HEIGHT, INTRINSICS, frame

CONFIG = OccupancyConfig()
DEPTH = HEIGHT - 0.1  # [m] of the block, 0.2 m wide


def with_lost_edges(x: float = 0.0) -> RgbdFrame:
    """A block on the floor from above (x, 0), without depth in the pixels on both sides of its outline."""
    seen = frame(block=0.1, x=x)
    step = np.abs(np.diff(seen.depth, axis=1)) > 0.05, np.abs(np.diff(seen.depth, axis=0)) > 0.05
    seen.depth[:, 1:][step[0]] = seen.depth[:, :-1][step[0]] = 0.0
    seen.depth[1:][step[1]] = seen.depth[:-1][step[1]] = 0.0
    return seen


def edges_of(*frames: RgbdFrame) -> LostEdges:
    named = [replace(each, camera=f"cam{number}") for number, each in enumerate(frames)]
    return LostEdges.joined([*lost_edges([(each, object_mask(each)) for each in named], None, CONFIG).values()])


def at_the_block(edges: LostEdges) -> np.ndarray:
    """Which balls (K,) are at the depth of the block's top."""
    return np.abs(edges.centers[:, 2] - 0.1) < 0.005


def test_the_lost_outline_of_a_block_is_as_wide_as_a_pixel_and_at_its_depth() -> None:
    edges = edges_of(with_lost_edges())
    mine = at_the_block(edges)
    assert mine.sum() > 40
    pixel = DEPTH / INTRINSICS.fx
    np.testing.assert_allclose(edges.radii[mine], pixel, rtol=0.02)
    reach = np.abs(edges.centers[mine, :2]).max(axis=1) + edges.radii[mine]
    assert np.all(reach >= 0.1)  # the block's true edge is inside the balls
    assert np.all(reach < 0.1 + 2 * pixel)
    assert len(edges_of(frame()).radii) == 0  # where nothing is lost there is no edge
    nothing = frame()
    nothing.depth[:] = 0.0
    assert len(edges_of(nothing).radii) == 0  # nor where there is nothing beside it, at the image's border, too


def test_the_outline_is_not_where_another_camera_looks_past_it() -> None:
    alone, beside = edges_of(with_lost_edges()), frame(x=0.15)  # a camera that sees no block at all
    assert at_the_block(alone).any()
    assert not at_the_block(edges_of(with_lost_edges(), beside)).any()
    assert at_the_block(edges_of(with_lost_edges(), with_lost_edges(0.15))).any()  # one that sees it does not


def test_the_outline_of_the_robot_is_its_own() -> None:
    seen = with_lost_edges()
    kinds = object_mask(seen).kinds.copy()
    kinds[np.abs(seen.depth - DEPTH) < 0.01] = PixelKind.ROBOT
    edges = lost_edges([(seen, replace(object_mask(seen), kinds=kinds))], None, CONFIG)["cam0"]
    assert not at_the_block(edges).any()
