"""Where a surface may go on at the edge of what a camera measured of it: depth is lost on both sides of a step of
depth, and what lies in such a pixel is as likely the edge of the nearer surface as what is behind it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.kernels import points
from splatctrl_cli.records import Float32, RgbdFrame
from splatctrl_cli.scene.render import camera_array
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask

BESIDE = np.ones((3, 3), np.uint8)  # a pixel and its neighbours
NEAR_ROBOT = np.ones((5, 5), np.uint8)  # its outline is lost, too, and is its own


@dataclass(frozen=True, kw_only=True)
class LostEdges:
    """Balls: centers (K, 3) float32 [m], world, radii (K,) float32 [m]."""

    centers: Float32
    radii: Float32


def lost_edges(frames: Sequence[RgbdFrame], masks: Sequence[SelfMask], config: OccupancyConfig) -> LostEdges:
    """A ball for each pixel without depth beside one that shows an object, at the depth of the nearest object beside
    it, in frames of one time step with their self-masks; without those that another frame sees through by
    `see_through`, and without the outline of the robot. Its radius is a pixel: a surface that the pixel shows ends
    before the next pixel's centre.
    """
    found = [_of_frame(frame, mask) for frame, mask in zip(frames, masks, strict=True)]
    centers = np.concatenate([each.centers for each in found])
    radii = np.concatenate([each.radii for each in found])
    cameras = [camera_array(frame.intrinsics, frame.T_world_camera) for frame in frames]
    surely = [
        cv2.erode(frame.depth, BESIDE) for frame in frames
    ]  # 0, which sees through nothing, beside a lost pixel
    is_kept = ~points.seen_through(centers, cameras, surely, config.see_through)
    return LostEdges(centers=centers[is_kept], radii=radii[is_kept])


def _of_frame(frame: RgbdFrame, mask: SelfMask) -> LostEdges:
    is_object, is_robot = mask.kinds == PixelKind.OBJECT, mask.kinds == PixelKind.ROBOT
    beside = cv2.erode(np.where(is_object, frame.depth, np.float32(np.inf)), BESIDE)
    is_beside, is_outline = (
        cv2.dilate(pixels.view(np.uint8), reach) > 0
        for pixels, reach in ((is_object, BESIDE), (is_robot, NEAR_ROBOT))
    )
    is_lost = (frame.depth <= 0) & is_beside & ~is_outline
    v, u = np.nonzero(is_lost)
    depths = beside[v, u]
    places = transform_points(frame.T_world_camera, back_project_pixels(frame.intrinsics, u, v, depths))
    return LostEdges(centers=places.astype(np.float32), radii=depths / np.float32(frame.intrinsics.fx))
