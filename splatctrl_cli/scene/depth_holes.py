"""Holes without depth, which may contain dark, shiny or clear objects.

Depth surrounds a hole. An object in it is on its rays, before what is seen around it. Rays of other cameras and later
images clear it. Depth is also lost at depth edges: the nearer surface may extend there.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import NARROW_HOLE
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.kernels import points
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.render import camera_array
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask
from splatctrl_cli.scene.stereo_shadow import shadowed
from splatctrl_cli.voxels import LostEdges

BESIDE_ROBOT = np.ones((9, 9), np.uint8)  # its outline is fattened, too
MOST_POINTS = 1 << 18  # per batch: fine voxels and a large hole may need a hundred million


def unanswered_points(frame: RgbdFrame, robot_depth: Float32, config: OccupancyConfig) -> Iterator[Float64]:
    """Yield points (K, 3) [m], world, half a voxel apart on rays of holes.

    Some repeat. Rays are about a voxel apart, from `min_range` to the depth of the nearest pixel with depth. Holes
    up to `NARROW_HOLE` voxels wide do not count, nor those at the robot, where background may show. robot_depth (H,
    W) [m]: rendered, 0 = none.
    """
    is_blank = frame.depth <= 0
    if not 0 < np.count_nonzero(is_blank) < is_blank.size:
        return iter(())
    is_blank &= ~shadowed(frame.depth, frame.intrinsics.fx)
    is_end = cv2.dilate(robot_depth, BESIDE_ROBOT) > 0
    if frame.valid is not None:
        is_end |= ~frame.valid
    holes = _holes(is_blank, is_end)
    if not holes.any():
        return iter(())
    behind = _nearest_depth(frame.depth)
    width = config.voxel * frame.intrinsics.fx / float(np.median(behind[holes]))
    return _on_rays(frame, _wide(holes, NARROW_HOLE * width), behind, max(int(width), 1), config)


def _wide(pixels: Bool, width: float) -> Bool:
    side = int(width) | 1  # OpenCV shifts an even window
    opened = cv2.morphologyEx(pixels.view(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    return np.asarray(opened.view(bool))


def _on_rays(
    frame: RgbdFrame, pixels: Bool, behind: Float32, apart: int, config: OccupancyConfig
) -> Iterator[Float64]:
    v, u = np.nonzero(pixels[::apart, ::apart])
    v, u = v * apart, u * apart
    depths = np.arange(config.min_range, behind[v, u].max(initial=config.min_range), 0.5 * config.voxel)
    rays = back_project_pixels(frame.intrinsics, u, v, np.ones(len(u)))
    num = max(MOST_POINTS // max(len(depths), 1), 1)  # rays at a time
    for some in (slice(first, first + num) for first in range(0, len(u), num)):
        is_before = depths < behind[v[some], u[some]][:, None]
        yield transform_points(frame.T_world_camera, (rays[some, None] * depths[:, None])[is_before])


def _holes(is_blank: Bool, is_end: Bool) -> Bool:
    """Pixels (H, W) without depth, in groups that meet neither border nor `is_end`."""
    _, groups = cv2.connectedComponents(is_blank.view(np.uint8), connectivity=8)
    open_groups = [groups[0], groups[-1], groups[:, 0], groups[:, -1], groups[is_end]]
    return np.isin(groups, np.concatenate([[0], *open_groups]), invert=True)


def _nearest_depth(depth: Float32) -> Float32:
    is_blank = (depth <= 0).view(np.uint8)
    _, which = cv2.distanceTransformWithLabels(is_blank, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(int(which.max()) + 1, np.float32)
    seen = is_blank == 0
    of_label[which[seen]] = depth[seen]
    return np.asarray(of_label[which])


BESIDE = np.ones((3, 3), np.uint8)  # a pixel and its neighbours
NEAR_ROBOT = np.ones((5, 5), np.uint8)  # its own outline loses depth, too


def lost_edges(
    seen: Sequence[tuple[RgbdFrame, SelfMask]], robot: RobotPosture | None, config: OccupancyConfig
) -> dict[str, LostEdges]:
    """Return, by camera, a ball for each pixel without depth next to an object pixel.

    Its depth is that of the nearest object next to it. Its radius is one pixel: a surface shown there ends before
    the next centre. Lone object pixels are noise. Balls that a frame sees through by `see_through` are left out.
    Balls as near to the robot are left out, too: they are its outline.
    """
    cameras = [camera_array(frame.intrinsics, frame.T_world_camera) for frame, _ in seen]
    surely = [cv2.erode(frame.depth, BESIDE) for frame, _ in seen]  # 0 next to lost pixels: sees through nothing
    found = dict[str, LostEdges]()
    for frame, mask in seen:
        edges = _of_frame(frame, mask)
        edges = edges.select(~points.seen_through(edges.centers, cameras, surely, config.see_through))
        if robot is not None and len(edges.radii):
            edges = edges.select(robot.distance(edges.centers) > config.see_through)
        found[frame.camera] = edges
    return found


def _of_frame(frame: RgbdFrame, mask: SelfMask) -> LostEdges:
    is_object = cv2.morphologyEx((mask.kinds == PixelKind.OBJECT).view(np.uint8), cv2.MORPH_OPEN, BESIDE) > 0
    is_robot = (mask.kinds == PixelKind.ROBOT) | (mask.kinds == PixelKind.MIXED)
    beside = cv2.erode(np.where(is_object, frame.depth, np.float32(np.inf)), BESIDE)
    is_beside, is_outline = (
        cv2.dilate(pixels.view(np.uint8), reach) > 0
        for pixels, reach in ((is_object, BESIDE), (is_robot, NEAR_ROBOT))
    )
    is_lost = (frame.depth <= 0) & is_beside & ~is_outline
    if frame.valid is not None:
        is_lost &= frame.valid
    v, u = np.nonzero(is_lost)
    depths = beside[v, u]
    places = transform_points(frame.T_world_camera, back_project_pixels(frame.intrinsics, u, v, depths))
    return LostEdges(centers=places.astype(np.float32), radii=depths / np.float32(frame.intrinsics.fx))
