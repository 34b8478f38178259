"""Reasons why cameras never saw a voxel near the robot."""

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import ASKED_REACH
from splatctrl_cli.records import Float32, RgbdFrame
from splatctrl_cli.scene.labels import Seen
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask, pixels_at
from splatctrl_cli.scene.stereo_shadow import shadowed
from splatctrl_cli.voxels import Unseen

OUTLINE = np.ones((5, 5), np.uint8)  # the robot's outline loses depth, too


def explain_unseen(occupancy: OccupancyMap, seen: Seen, robot: RobotPosture) -> None:
    """Note why (`Unseen`) no camera ever saw voxels within `ASKED_REACH` of the robot."""
    voxels = occupancy.unexplained(robot.centers, robot.radii + ASKED_REACH)
    points = occupancy.centers_of(voxels)
    reasons = np.full(len(points), np.uint16(Unseen.OUT_OF_VIEW))
    for frame, mask in seen:
        np.maximum(reasons, _in_frame(points, frame, mask), out=reasons)
    reasons[robot.distance(points) <= 0] = Unseen.SWEPT
    occupancy.explain(voxels, reasons)


def _in_frame(points: Float32, frame: RgbdFrame, mask: SelfMask) -> NDArray[np.uint16]:
    """Return why a frame does not show points (K, 3) [m]: `Unseen` (K,)."""
    pixel, z = pixels_at(frame, points)
    is_in_view = pixel >= 0
    if frame.valid is not None:
        is_in_view &= frame.valid.reshape(-1)[pixel]
    robot = cv2.dilate(mask.robot_depth, OUTLINE).reshape(-1)[pixel]
    depth = frame.depth.reshape(-1)[pixel]
    is_lost = (frame.depth <= 0) & ~shadowed(frame.depth, frame.intrinsics.fx)
    behind = np.where(is_lost.reshape(-1)[pixel], np.uint16(Unseen.NO_RETURN), np.uint16(Unseen.HIDDEN_BY_THING))
    is_arm = (robot > 0) & ((robot < z) | (depth <= 0)) & (mask.kinds.reshape(-1)[pixel] != PixelKind.OBJECT)
    behind[is_arm] = Unseen.HIDDEN_BY_ARM
    return np.where(is_in_view, behind, np.uint16(Unseen.OUT_OF_VIEW))
