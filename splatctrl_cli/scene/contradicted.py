"""Rays that run through a surface which another camera measures: into a shiny thing that is measured far behind its
place, or into a dark one that returns no depth at all.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import CONTRADICTED, CONTRADICTING_COLUMNS, CONTRADICTING_PIXELS, MASK_STEP
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.labels import Seen
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask, pixels_at
from splatctrl_cli.scene.stereo_shadow import shadowed

T = TypeVar("T", bound=np.generic)
BESIDE = np.ones((3, 3), np.uint8)  # a block and its neighbours


@dataclass(frozen=True, kw_only=True)
class Contradicted:
    """Blocks of `side` pixels (h, w) of a frame whose rays run through the surface of another. until (h, w) float32
    [m]: the depth of that surface, 0 where there is none; is_blank (h, w): the frame has no depth there.
    """

    side: int
    until: Float32
    is_blank: Bool

    def pixels(self, shape: tuple[int, ...]) -> Bool:
        """The contradicted pixels (H, W) that have depth."""
        out = np.zeros(shape, bool)
        blocks = np.kron((self.until > 0) & ~self.is_blank, np.ones((self.side, self.side), bool))
        out[: blocks.shape[0], : blocks.shape[1]] = blocks
        return out

    def points(self, frame: RgbdFrame, config: OccupancyConfig, *, is_blank: bool) -> Float64:
        """Points (K, 3) [m], world, half a voxel apart on the rays of its blocks before that surface."""
        v, u = np.nonzero((self.until > 0) & (self.is_blank == is_blank))
        depths = np.arange(config.min_range, self.until.max(initial=config.min_range), 0.5 * config.voxel)
        middle = self.side // 2
        rays = back_project_pixels(frame.intrinsics, self.side * u + middle, self.side * v + middle, np.ones(len(u)))
        is_before = depths < self.until[v, u][:, None]
        return transform_points(frame.T_world_camera, (rays[:, None] * depths[:, None])[is_before])


def contradicted(seen: Seen, *, is_drawn: bool) -> Iterator[Contradicted]:
    """For each frame of one time step what the others, or the robot as it is drawn, contradict.

    All rays of a block and of those beside it run through a surface that another frame measures, and end more than
    `CONTRADICTED` [m] behind it, or return no depth: outside of a stereo shadow, within the range of depth of the
    frame. So does a ray to a robot, drawn by its own surface, that returns no depth. Fewer than
    `CONTRADICTING_PIXELS` blocks side by side are noise.
    """
    surfaces = [_surface(*one) for one in seen]
    for index, (frame, mask) in enumerate(seen):
        others = [points for number, points in enumerate(surfaces) if number != index]
        yield _run_through(frame, mask, np.concatenate([np.zeros((0, 3)), *others]), is_drawn)


def without_contradicted(mask: SelfMask, found: Contradicted) -> SelfMask:
    """The mask, where contradicted depth is so called."""
    pixels = found.pixels(mask.kinds.shape)
    return replace(mask, kinds=np.where(pixels, np.uint8(PixelKind.CONTRADICTED), mask.kinds))


def _side(frame: RgbdFrame) -> int:
    return max(1, frame.intrinsics.width // CONTRADICTING_COLUMNS)


def _blocks(image: NDArray[T], side: int) -> NDArray[T]:
    """Pixels (h, w, side^2) of the blocks of an image (H, W); what is over at its ends is left out."""
    h, w = (size // side for size in image.shape)
    parts = image[: h * side, : w * side].reshape(h, side, w, side)
    return parts.swapaxes(1, 2).reshape(h, w, side * side)


def _surface(frame: RgbdFrame, mask: SelfMask) -> Float64:
    """Points (K, 3) [m], world, of a frame's objects, one a block, none beside a step of depth."""
    side = _side(frame)
    depth = _blocks(frame.depth, side)
    nearest, farthest = depth.min(axis=2), depth.max(axis=2)
    is_flat = cv2.dilate(farthest, BESIDE) - cv2.erode(nearest, BESIDE) < 2 * MASK_STEP
    is_object = _blocks(mask.kinds == PixelKind.OBJECT, side).all(axis=2)
    v, u = np.nonzero(is_flat & is_object)
    middle = side // 2
    points = back_project_pixels(frame.intrinsics, side * u + middle, side * v + middle, depth.mean(axis=2)[v, u])
    return transform_points(frame.T_world_camera, points)


def _run_through(frame: RgbdFrame, mask: SelfMask, surface: Float64, is_drawn: bool) -> Contradicted:
    """The blocks of a frame whose rays run through points (K, 3) [m], world, of a surface."""
    side = _side(frame)
    surely = cv2.erode(_blocks(frame.depth, side).min(axis=2), BESIDE)  # 0 beside lost pixels
    is_lost = (frame.depth <= 0) & (mask.kinds != PixelKind.MIXED) & ~shadowed(frame.depth, frame.intrinsics.fx)
    if frame.valid is not None:
        is_lost &= frame.valid
    is_blank = cv2.erode(_blocks(is_lost, side).all(axis=2).view(np.uint8), BESIDE) > 0
    pixel, z = pixels_at(frame, surface)
    v, u = pixel // frame.intrinsics.width // side, pixel % frame.intrinsics.width // side
    is_inside = (pixel >= 0) & (v < surely.shape[0]) & (u < surely.shape[1])
    v, u, z = v[is_inside], u[is_inside], z[is_inside]
    is_through = (surely[v, u] > z + CONTRADICTED) | (is_blank[v, u] & (z < frame.depth.max() + CONTRADICTED))
    until = np.zeros(surely.shape, np.float32)
    until[v[is_through], u[is_through]] = z[is_through]
    robot = _blocks(mask.robot_depth, side).min(axis=2)
    is_before = is_blank & (robot > 0) & is_drawn
    until[is_before] = robot[is_before]
    wide = cv2.dilate(until, BESIDE)
    num, piece = cv2.connectedComponents((wide > 0).view(np.uint8), connectivity=8)
    counts = np.bincount(piece[until > 0], minlength=num)
    until = np.where((counts >= CONTRADICTING_PIXELS)[piece], wide, np.float32(0.0))
    return Contradicted(side=side, until=until, is_blank=np.asarray((_blocks(frame.depth, side) <= 0).all(axis=2)))
