"""Holes without depth, which may contain dark, shiny or clear objects.

An object may be anywhere on a hole's rays, until other rays clear the space. At edges without depth, the nearer
surface may extend further.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.kernels import Int32, native, points
from splatctrl_cli.records import Bool, Float32, Float64, Floats, Index, RgbdFrame, UInt16
from splatctrl_cli.scene.labels import Seen
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.render import camera_array
from splatctrl_cli.scene.seeding import Each
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask, is_mixed, pixels_at, tolerance_at
from splatctrl_cli.voxels import LostEdges, Unseen

NEIGHBOURS = np.ones((3, 3), np.uint8)  # a pixel and its neighbours
ROBOT_OUTLINE = np.ones((9, 9), np.uint8)  # pixels; the robot's outline is fattened, too
MOST_POINTS = 1 << 18  # per batch: fine voxels and a large hole may need a hundred million


def unanswered_points(
    frame: RgbdFrame, robot_depth: Float32, config: OccupancyConfig, before: tuple[RgbdFrame, SelfMask] | None = None
) -> Iterator[Float64]:
    """Yield points (K, 3) [m], world, half a voxel apart on rays of holes.

    Rays about a voxel apart end at the depth of the nearest pixel with depth. Holes up to `NARROW_HOLE` voxels wide
    do not count, nor new holes of a still camera. robot_depth (H, W) [m]: rendered, 0 = none. before: the camera's
    last frame and its mask (only kinds, if resumed).
    """
    holes = _holes(frame, robot_depth > 0)
    if before is not None and holes.any() and np.array_equal(before[0].T_world_camera, frame.T_world_camera):
        num, groups = cv2.connectedComponents(holes.view(np.uint8), connectivity=8)
        was_hole = np.zeros(num, bool)
        was_hole[groups[holes & _holes(before[0], before[1].kinds == PixelKind.ROBOT)]] = True
        holes = was_hole[groups]
    if not holes.any():
        return iter(())
    behind = _nearest_depth(frame.depth)
    width = config.voxel * frame.intrinsics.fx / float(np.median(behind[holes]))
    apart = max(int(width), 1)
    side = int(fixed.NARROW_HOLE * width) | 1  # OpenCV shifts an even window
    opened = cv2.morphologyEx(holes.view(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    v, u = np.nonzero(opened[::apart, ::apart])
    return points_on_rays(frame, v * apart, u * apart, behind[v * apart, u * apart], config)


def _holes(frame: RgbdFrame, is_robot: Bool) -> Bool:
    """Pixels (H, W) of groups without depth.

    No group meets the border, the robot or its stereo shadow.
    """
    is_blank = frame.depth <= 0
    if not 0 < np.count_nonzero(is_blank) < is_blank.size:
        return np.zeros_like(is_blank)
    is_shadow = find_shadows(frame.depth, frame.intrinsics.fx)
    is_blank &= ~is_shadow
    is_end = _add_shadow(cv2.dilate(is_robot.view(np.uint8), ROBOT_OUTLINE) > 0, is_shadow) | ~frame.is_in_view
    num, groups = cv2.connectedComponents(is_blank.view(np.uint8), connectivity=8)
    is_closed = np.arange(num) > 0
    for some in (groups[0], groups[-1], groups[:, 0], groups[:, -1], groups[is_end]):
        is_closed[some] = False
    return np.asarray(is_closed[groups]) if is_closed.any() else np.zeros_like(is_blank)


def _add_shadow(is_robot: Bool, is_shadow: Bool) -> Bool:
    if not is_shadow.any():
        return is_robot
    _, groups = cv2.connectedComponents(is_shadow.view(np.uint8), connectivity=8)
    is_beside = is_shadow & np.isin(groups, np.unique(groups[is_robot & is_shadow]))
    return np.asarray(is_robot | (cv2.dilate(is_beside.view(np.uint8), NEIGHBOURS) > 0))


def points_on_rays(frame: RgbdFrame, v: Index, u: Index, end: Float32, config: OccupancyConfig) -> Iterator[Float64]:
    """Yield points (K, 3) [m], world, half a voxel apart on rays up to `end` (N,) [m].

    Rays begin at `min_range`. v, u (N,): pixels of the rays.
    """
    depths = np.arange(config.min_range, end.max(initial=config.min_range), 0.5 * config.voxel)
    rays = back_project_pixels(frame.intrinsics, u, v, np.ones(len(u)))
    num = max(MOST_POINTS // max(len(depths), 1), 1)  # rays at a time
    for some in (slice(first, first + num) for first in range(0, len(u), num)):
        is_before = depths < end[some, None]
        yield transform_points(frame.T_world_camera, (rays[some, None] * depths[:, None])[is_before])


def _nearest_depth(depth: Float32) -> Float32:
    is_blank = (depth <= 0).view(np.uint8)
    _, which = cv2.distanceTransformWithLabels(is_blank, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(int(which.max()) + 1, np.float32)
    seen = is_blank == 0
    of_label[which[seen]] = depth[seen]
    return np.asarray(of_label[which])


NEAR_ROBOT = np.ones((5, 5), np.uint8)  # pixels; the robot's own outline loses depth, too


def lost_edges(
    seen: Sequence[tuple[RgbdFrame, SelfMask]], robot: RobotPosture | None, config: OccupancyConfig, each: Each = map
) -> dict[str, LostEdges]:
    """Return, by camera, a ball for each pixel without depth next to an object pixel.

    A ball has the depth of the nearest object next to it, and a radius of one pixel. Lone object pixels, and depths
    between two surfaces, do not count. Balls that a frame sees through by `see_through`, or within `see_through` of
    the robot, are left out.
    """
    cameras = [camera_array(frame.intrinsics, frame.T_world_camera) for frame, _ in seen]
    surely = [cv2.erode(frame.depth, NEIGHBOURS) for frame, _ in seen]  # 0 next to lost pixels: sees through nothing
    by_camera = dict[str, LostEdges]()
    for (frame, _), some in zip(seen, each(lambda one: _edges_of(one[0], one[1], config), seen), strict=True):
        edges = some.select(~points.seen_through(some.centers, cameras, surely, config.see_through))
        if robot is not None and len(edges.radii):
            edges = edges.select(~robot.is_within(edges.centers, config.see_through))
        by_camera[frame.camera] = edges
    return by_camera


def _edges_of(frame: RgbdFrame, mask: SelfMask, config: OccupancyConfig) -> LostEdges:
    is_object = mask.kinds == PixelKind.OBJECT
    is_object &= ~is_mixed(frame.depth, is_object, tolerance_at(frame.depth, config), 2, frame.intrinsics.fx)
    is_object = cv2.morphologyEx(is_object.view(np.uint8), cv2.MORPH_OPEN, NEIGHBOURS) > 0
    is_robot = (mask.kinds == PixelKind.ROBOT) | (mask.kinds == PixelKind.MIXED)
    nearby = cv2.erode(np.where(is_object, frame.depth, np.float32(np.inf)), NEIGHBOURS)
    is_beside, is_outline = (
        cv2.dilate(pixels.view(np.uint8), reach) > 0
        for pixels, reach in ((is_object, NEIGHBOURS), (is_robot, NEAR_ROBOT))
    )
    is_lost = (frame.depth <= 0) & is_beside & ~is_outline & frame.is_in_view
    v, u = np.divmod(np.flatnonzero(is_lost), frame.intrinsics.width)
    depths = nearby[v, u]
    places = transform_points(frame.T_world_camera, back_project_pixels(frame.intrinsics, u, v, depths))
    return LostEdges(centers=places.astype(np.float32), radii=depths / np.float32(frame.intrinsics.fx))


def find_shadows(depth: Float32, focal: float) -> Bool:
    """Pixels (H, W) without depth in the shadow of something nearer in their row.

    depth (H, W) [m], 0 = none; focal [px]. With baseline B, an object at z hides B focal (1/z - 1/z_behind) pixels
    behind it, always on the same side. The image gives side and baseline (`_baseline`), and z_behind (`_behind`).
    """
    is_shadow, fattened = np.zeros(depth.shape, bool), max(depth.shape[1] / fixed.MASK_EDGE, 1.0)
    depth, size = np.ascontiguousarray(depth), (2, depth.size)
    height, lost = np.empty(size, np.float32), np.empty(size, np.int32)
    counts = native.shadow_steps(depth, focal, fixed.SHADOW_STEP, height, lost)
    baselines = [_baseline(height[side, :num], lost[side, :num]) for side, num in enumerate(counts)]
    behind = _behind(depth) if any(baselines) else depth
    for side, baseline in enumerate(baselines):  # the nearer object is right of its shadow, then left
        if baseline:
            native.mark_shadows(depth, behind, side == 1, baseline * focal, fattened, is_shadow.view(np.uint8))
    return is_shadow


def _baseline(height: Float32, lost: Int32) -> float:
    """Baseline [m] of shadows: median over the higher depth steps (K,); 0 without steps."""
    if not len(height):
        return 0.0
    higher = height >= _median(height, height)
    return min(_median(lost[higher] / height[higher], height[higher]), fixed.SHADOW_BASELINE)


def _median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])


def _behind(depth: Float32) -> Float32:
    is_blank = depth <= 0
    num, group = cv2.connectedComponents(is_blank.view(np.uint8), connectivity=8)
    around = np.where(is_blank, cv2.dilate(depth, np.ones((3, 3), np.uint8)), np.float32(0.0))
    is_rim = around > 0
    of_group = np.zeros(num, np.float32)
    np.maximum.at(of_group, group[is_rim], around[is_rim])
    return np.asarray(of_group[group])


OUTLINE = np.ones((5, 5), np.uint8)  # pixels; the robot's outline loses depth, too


def explain_unseen(occupancy: OccupancyMap, seen: Seen, robot: RobotPosture, each: Each = map) -> None:
    """Note why (`Unseen`) no camera ever saw voxels within `ASKED_REACH` of the robot."""
    voxels = occupancy.unexplained(robot.centers, robot.radii + fixed.ASKED_REACH)
    points = occupancy.centers_of(voxels)
    reasons = np.full(len(points), np.uint16(Unseen.OUT_OF_VIEW))
    for of_frame in each(lambda one: _explain_points(points, one[0], one[1]), seen):
        np.maximum(reasons, of_frame, out=reasons)
    reasons[robot.is_within(points, 0.0)] = Unseen.SWEPT
    occupancy.last_seen.reshape(-1)[voxels] = reasons


def _explain_points(points: Float32, frame: RgbdFrame, mask: SelfMask) -> UInt16:
    pixel, z = pixels_at(frame, points)
    is_in_view = (pixel >= 0) & frame.is_in_view.reshape(-1)[pixel]
    robot = cv2.dilate(mask.robot_depth, OUTLINE).reshape(-1)[pixel]
    depth = frame.depth.reshape(-1)[pixel]
    is_lost = (frame.depth <= 0) & ~find_shadows(frame.depth, frame.intrinsics.fx)
    behind = np.where(is_lost.reshape(-1)[pixel], np.uint16(Unseen.NO_RETURN), np.uint16(Unseen.HIDDEN_BY_THING))
    is_arm = (robot > 0) & ((robot < z) | (depth <= 0)) & (mask.kinds.reshape(-1)[pixel] != PixelKind.OBJECT)
    behind[is_arm] = Unseen.HIDDEN_BY_ARM
    return np.where(is_in_view, behind, np.uint16(Unseen.OUT_OF_VIEW))
