"""Evidence of a time step: masks of its frames, and rays that another frame contradicts.

The depth of a shiny or dark object may be far too large, or missing. Its rays then go through a surface that another
camera measures.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, Index, RgbdFrame
from splatctrl_cli.scene.depth_holes import (
    explain_unseen,
    find_shadows,
    lost_edges,
    points_on_rays,
    unanswered_points,
)
from splatctrl_cli.scene.labels import Seen
from splatctrl_cli.scene.occupancy import OccupancyMap, PeopleMemory
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.seeding import Each
from splatctrl_cli.scene.self_mask import (
    PixelKind,
    SelfMask,
    drop_pixels,
    object_mask,
    outvote_objects,
    pixels_at,
    self_mask,
    settle_pieces,
)
from splatctrl_cli.voxels import Unseen

T = TypeVar("T", bound=np.generic)
NEIGHBOURS = np.ones((3, 3), np.uint8)  # a block and its neighbours
ALONG = np.array([[1.0, -2.0, 1.0]], np.float32)  # twice the deviation from the mean of two neighbours


@dataclass(frozen=True, kw_only=True)
class Contradicted:
    """Blocks (h, w) of a frame, `side` pixels wide, that another frame contradicts.

    until (h, w) [m]: depth where a block's rays cross another frame's surface, 0 = nowhere. is_blank (h, w): True
    without depth. through (h, w) [m]: depth of the block's surface where another frame's rays cross it, 0 = nowhere.
    """

    side: int
    until: Float32
    is_blank: Bool
    through: Float32

    def pixels(self, shape: tuple[int, ...]) -> Bool:
        """Pixels (H, W) whose depth lies on no surface, because their rays cross another frame's surface."""
        return self._spread((self.until > 0) & ~self.is_blank, shape)

    def unproven(self, frame: RgbdFrame) -> RgbdFrame:
        """Frame without depth of surfaces that another frame's rays cross.

        Such depth proves no space free.
        """
        is_through = self._spread(self.through > 0, frame.depth.shape)
        return replace(frame, depth=np.where(is_through, np.float32(0.0), frame.depth)) if is_through.any() else frame

    def points(self, frame: RgbdFrame, config: OccupancyConfig, *, is_blank: bool) -> Iterator[Float64]:
        """`points_on_rays` of the blocks, up to the larger of `until` and `through`.

        is_blank: of blocks without depth, else with depth.
        """
        end = np.maximum(self.until, self.through)
        v, u = np.nonzero((end > 0) & (self.is_blank == is_blank))
        middle = self.side // 2
        return points_on_rays(frame, self.side * v + middle, self.side * u + middle, end[v, u], config)

    def _spread(self, blocks: Bool, shape: tuple[int, ...]) -> Bool:
        out, pixels = np.zeros(shape, bool), blocks.repeat(self.side, axis=0).repeat(self.side, axis=1)
        out[: pixels.shape[0], : pixels.shape[1]] = pixels
        return out


def find_contradicted(seen: Seen, *, is_drawn: bool, each: Each = map) -> Iterator[Contradicted]:
    """Yield the blocks of each frame that other frames or the drawn robot contradict.

    All rays of a contradicted block and its neighbours cross another frame's surface. They end over `CONTRADICTED`
    [m] behind that surface, or have no return, in range and outside stereo shadows. Blocks of the drawn robot without
    return count, too. Fewer than `CONTRADICTING_PIXELS` adjacent blocks are noise. At least `SEEN_THROUGH_PIXELS`
    adjacent blocks that another frame's rays cross prove no space free. each: a `map` over frames.
    """
    views = list(each(_BlockView.of, *zip(*seen, strict=True)))
    through = [np.zeros_like(view.surely) for view in views]
    until = []
    for (_, mask), view in zip(seen, views, strict=True):
        depths = np.zeros_like(view.surely)
        for other, passed in zip(views, through, strict=True):
            if other is not view:
                is_passed = view.run_through(other, depths)
                passed[other.v[is_passed], other.u[is_passed]] = other.depth[is_passed]
        robot = _least(mask.robot_depth, view.side)
        is_before = view.is_lost & (robot > 0) & is_drawn
        depths[is_before] = robot[is_before]
        until.append(_side_by_side(depths, fixed.CONTRADICTING_PIXELS))
    for view, end, passed in zip(views, until, through, strict=True):
        yield Contradicted(
            side=view.side,
            until=end,
            is_blank=view.farthest <= 0,
            through=_side_by_side(passed, fixed.SEEN_THROUGH_PIXELS),
        )


def mask_frames(
    frames: Sequence[RgbdFrame], robot: RobotPosture | None, last: Seen, occupancy: OccupancyMap, each: Each
) -> tuple[list[RgbdFrame], list[SelfMask], list[Contradicted]]:
    """Frames of a time step without mixed depth, their masks and contradicted rays.

    last: frames and masks of the last time step; each: a `map` over frames.
    """
    config = occupancy.config
    masks = [object_mask(frame) for frame in frames]
    if robot is not None:
        seen = list(zip(frames, each(lambda frame: self_mask(frame, robot, config), frames), strict=True))
        others = [[*(other for other in seen if other is not one), *last] for one in seen]
        masks = list(each(lambda one, rest: settle_pieces(one[0], one[1], rest, config), seen, others))
        masks = outvote_objects(list(zip(frames, masks, strict=True)), occupancy.origin, config.voxel)
    is_drawn = robot is not None and robot.surface is not None and robot.surface.is_drawn
    rays = list(find_contradicted(list(zip(frames, masks, strict=True)), is_drawn=is_drawn, each=each))
    masks = list(map(mark_contradicted, masks, rays))
    return [drop_pixels(*one, PixelKind.MIXED) for one in zip(frames, masks, strict=True)], masks, rays


def take_in_evidence(
    occupancy: OccupancyMap,
    people: PeopleMemory,
    seen: Seen,
    rays: Sequence[Contradicted],
    robot: RobotPosture | None,
    each: Each,
    last: Mapping[str, tuple[RgbdFrame, SelfMask]],
) -> None:
    """Add a step's depth, reasons of unseen voxels, lost edges and robot to the occupancy.

    last: each camera's last frame and mask.
    """
    config = occupancy.config
    proving = [
        contradicted.unproven(drop_pixels(*one, PixelKind.CONTRADICTED))
        for one, contradicted in zip(seen, rays, strict=True)
    ]
    people.take_in(occupancy, proving)
    unanswered = each(
        lambda one: unanswered_points(one[0], one[1].robot_depth, config, last.get(one[0].camera)), seen
    )
    for (frame, _), contradicted in zip(seen, rays, strict=True):
        for reason, is_blank in ((Unseen.CONTRADICTED, False), (Unseen.UNANSWERED, True)):
            for points in contradicted.points(frame, config, is_blank=is_blank):
                occupancy.mark_unseen(points, reason)
    for points in chain.from_iterable(unanswered):
        occupancy.mark_unseen(points, Unseen.UNANSWERED)
    occupancy.keep_edges(lost_edges(seen, robot, config, each))
    if robot is not None:
        pixels = [(f, m.kinds == PixelKind.ROBOT, m.kinds == PixelKind.OBJECT) for f, m in seen]
        occupancy.label_robot(robot.centers, robot.radii, pixels)
        occupancy.forget_hidden(robot.centers, robot.radii, robot.is_within)
        explain_unseen(occupancy, seen, robot, each)


def mark_contradicted(mask: SelfMask, contradicted: Contradicted) -> SelfMask:
    return replace(
        mask, kinds=np.where(contradicted.pixels(mask.kinds.shape), np.uint8(PixelKind.CONTRADICTED), mask.kinds)
    )


def _least(image: NDArray[T], side: int) -> NDArray[T]:
    height, width = image.shape
    least = cv2.erode(image, np.ones((side, side), np.uint8), anchor=(0, 0))
    return np.ascontiguousarray(least[: height - side + 1 : side, : width - side + 1 : side])


def _is_plane(depth: Float32) -> Bool:
    """True (h, w) where a depth differs from the plane through its neighbours by less than `MASK_STEP`.

    Inverse depth of any plane is linear over the image.
    """
    inverse = 1 / np.maximum(depth, np.float32(1e-3))
    bend = [cv2.filter2D(inverse, -1, line, borderType=cv2.BORDER_REPLICATE) for line in (ALONG, ALONG.T)]
    return np.asarray(np.maximum(*map(np.abs, bend)) * depth**2 < 2 * fixed.MASK_STEP)


@dataclass(frozen=True, kw_only=True)
class _BlockView:
    """A frame in blocks (h, w), `side` pixels wide: its rays, and the surface that they hit.

    surely (h, w) [m]: depth that all rays of a block and its neighbours reach. farthest (h, w) [m]: greatest depth of
    a block. is_lost (h, w): all these rays unexpectedly have no return. points (K, 3) [m], world: of objects, away
    from depth edges, with block indices (K,) and depth (K,) [m].
    """

    frame: RgbdFrame
    side: int
    surely: Float32
    farthest: Float32
    is_lost: Bool
    points: Float64
    v: Index
    u: Index
    depth: Float32

    @classmethod
    def of(cls, frame: RgbdFrame, mask: SelfMask) -> "_BlockView":
        side = max(1, frame.intrinsics.width // fixed.CONTRADICTING_COLUMNS)
        nearest, farthest = _least(frame.depth, side), -_least(-frame.depth, side)
        surely = cv2.erode(nearest, NEIGHBOURS)  # 0 next to lost pixels
        is_object = _least((mask.kinds == PixelKind.OBJECT).view(np.uint8), side) > 0
        v, u = np.nonzero((surely > 0) & _is_plane(nearest) & _is_plane(farthest) & is_object)
        middle, (rows, columns) = side // 2, surely.shape
        blocks = frame.depth[: rows * side, : columns * side].reshape(rows, side, columns, side)
        mean = blocks[v, :, u].reshape(len(v), side * side).mean(axis=1)
        points = back_project_pixels(frame.intrinsics, side * u + middle, side * v + middle, mean)
        is_lost = (
            (frame.depth <= 0) & (mask.kinds != PixelKind.MIXED) & ~find_shadows(frame.depth, frame.intrinsics.fx)
        )
        is_lost = cv2.erode(_least((is_lost & frame.is_in_view).view(np.uint8), side), NEIGHBOURS) > 0
        return cls(
            frame=frame,
            side=side,
            surely=surely,
            farthest=farthest,
            is_lost=np.asarray(is_lost),
            points=transform_points(frame.T_world_camera, points),
            v=v,
            u=u,
            depth=mean,
        )

    def run_through(self, surface: "_BlockView", until: Float32) -> Index:
        """Write the depth of surface points that rays cross into `until` (h, w).

        Return indices of the points behind which rays measure depth.
        """
        pixel, z = pixels_at(self.frame, surface.points)
        width = self.frame.intrinsics.width
        v, u = pixel // width // self.side, pixel % width // self.side
        inside = np.flatnonzero((pixel >= 0) & (v < self.surely.shape[0]) & (u < self.surely.shape[1]))
        v, u, z = v[inside], u[inside], z[inside]
        is_behind = self.surely[v, u] > z + fixed.CONTRADICTED
        is_through = is_behind | (self.is_lost[v, u] & (z < self.frame.depth.max() + fixed.CONTRADICTED))
        until[v[is_through], u[is_through]] = z[is_through]
        return inside[is_behind]


def _side_by_side(depths: Float32, least: int) -> Float32:
    wide = cv2.dilate(depths, NEIGHBOURS)
    num, piece = cv2.connectedComponents((wide > 0).view(np.uint8), connectivity=8)
    counts = np.bincount(piece[depths > 0], minlength=num)
    return np.where((counts >= least)[piece], wide, np.float32(0.0))
