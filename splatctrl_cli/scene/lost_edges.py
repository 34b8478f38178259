"""Where a surface may go on at the edge of what a camera measured of it: depth is lost on both sides of a step of
depth, and what lies in such a pixel is as likely the edge of the nearer surface as what is behind it.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.kernels import points
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.render import camera_array
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask
from splatctrl_cli.voxels import LostEdges

BESIDE = np.ones((3, 3), np.uint8)  # a pixel and its neighbours
NEAR_ROBOT = np.ones((5, 5), np.uint8)  # its outline is lost, too, and is its own


def lost_edges(
    seen: Sequence[tuple[RgbdFrame, SelfMask]], robot: RobotPosture | None, config: OccupancyConfig
) -> dict[str, LostEdges]:
    """By camera, of the frames of one time step with their self-masks, a ball for each pixel without depth beside one
    that shows an object, at the depth of the nearest object beside it. Its radius is a pixel: a surface that the
    pixel shows ends before the next pixel's centre.

    One object pixel by itself is noise. Without what another frame sees through by `see_through`, and without what is
    as near to the robot: that is its own outline.
    """
    cameras = [camera_array(frame.intrinsics, frame.T_world_camera) for frame, _ in seen]
    surely = [
        cv2.erode(frame.depth, BESIDE) for frame, _ in seen
    ]  # 0, which sees through nothing, beside lost pixels
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
