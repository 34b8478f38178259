"""Space that cameras looked into and got no depth from: a dark, shiny or clear thing in full view leaves only a hole.

A hole is a group of pixels without depth that has depth all around it. What is in it stands somewhere on its rays,
before what is seen beside it. Other cameras and later images that see through these rays clear them; what is left is
where the thing may be.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import NARROW_HOLE
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame

MOST_POINTS = 1 << 18  # at a time: fine voxels and a large hole come to a hundred million


def unanswered_points(frame: RgbdFrame, robot_depth: Float32, config: OccupancyConfig) -> Iterator[Float64]:
    """Points (K, 3) [m], world, on the rays of a frame's holes, half a voxel [m] apart along each; some at a time.

    From `min_range` before the camera to the depth that is seen nearest to the pixel, on rays about a voxel apart;
    holes up to `NARROW_HOLE` voxels wide do not count. robot_depth (H, W) [m]: of the rendered robot, 0 = none; a gap
    beside the robot may show what is far behind it, and is not a hole.
    """
    blank = _holes(frame, robot_depth)
    if not blank.any():
        return
    voxel = config.voxel
    behind = _nearest_depth(frame.depth)
    width = voxel * frame.intrinsics.fx / float(np.median(behind[blank]))  # pixels
    narrow, apart = int(NARROW_HOLE * width) | 1, max(int(width), 1)  # OpenCV shifts an even window
    wide = cv2.morphologyEx(blank.view(np.uint8), cv2.MORPH_OPEN, np.ones((narrow, narrow), np.uint8))
    v, u = np.nonzero(wide[::apart, ::apart])
    v, u = v * apart, u * apart
    depths = np.arange(config.min_range, behind[v, u].max(initial=config.min_range), 0.5 * voxel)
    rays = back_project_pixels(frame.intrinsics, u, v, np.ones(len(u)))
    num = max(MOST_POINTS // max(len(depths), 1), 1)  # rays at a time
    for some in (slice(first, first + num) for first in range(0, len(u), num)):
        is_before = depths < behind[v[some], u[some]][:, None]
        yield transform_points(frame.T_world_camera, (rays[some, None] * depths[:, None])[is_before])


def _holes(frame: RgbdFrame, robot_depth: Float32) -> Bool:
    """Pixels (H, W) without depth in groups that have depth of objects all around: neither the image's border nor
    the robot nor what the lens did not see.
    """
    blank = (frame.depth <= 0).view(np.uint8)
    if not blank.any():
        return blank.view(bool)
    _, groups = cv2.connectedComponents(blank, connectivity=8)
    beside_robot = cv2.dilate(robot_depth, np.ones((5, 5), np.uint8)) > 0
    open_groups = [groups[0], groups[-1], groups[:, 0], groups[:, -1], groups[beside_robot]]
    if frame.valid is not None:
        open_groups.append(groups[~frame.valid])
    return np.isin(groups, np.concatenate([[0], *open_groups]), invert=True)


def _nearest_depth(depth: Float32) -> Float32:
    """For each pixel (H, W) the depth [m] of the nearest pixel that has one."""
    is_blank = (depth <= 0).view(np.uint8)
    _, which = cv2.distanceTransformWithLabels(is_blank, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(int(which.max()) + 1, np.float32)
    seen = is_blank == 0
    of_label[which[seen]] = depth[seen]
    return np.asarray(of_label[which])
