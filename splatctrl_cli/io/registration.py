"""Depth seen from the colour camera, and images without lens distortion."""

from dataclasses import dataclass

import cv2
import numpy as np

from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Float32, Float64, Intrinsics, UInt8

DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
SAME_MODELS = {  # what others call them
    "Brown Conrady": "plumb_bob",
    "radtan": "plumb_bob",
    "Kannala Brandt4": "equidistant",
    "kannala_brandt": "equidistant",
    "fisheye": "equidistant",
}


@dataclass(frozen=True, kw_only=True)
class DepthToColor:
    """Warps depth images of one camera into another's view."""

    depth_intrinsics: Intrinsics
    color_intrinsics: Intrinsics
    T_color_depth: Float64

    def warp(self, depth: Float32) -> Float32:
        """Depth (H', W') [m] of the depth camera -> (H, W) [m] in the colour camera, 0 = none.

        Each depth pixel covers its square's image in the colour camera (no holes where that has the finer pixels);
        of several that land on a pixel, the nearest counts.
        """
        target = self.color_intrinsics
        valid = depth > 0
        points = transform_points(self.T_color_depth, back_project(self.depth_intrinsics, depth)[valid])
        points = points[points[:, 2] > 0]
        points = points[np.argsort(-points[:, 2], kind="stable")]  # far first, so that the nearest is written last
        z = points[:, 2]
        u = target.fx * points[:, 0] / z + target.cx
        v = target.fy * points[:, 1] / z + target.cy
        half_u = 0.5 * max(1.0, target.fx / self.depth_intrinsics.fx)
        half_v = 0.5 * max(1.0, target.fy / self.depth_intrinsics.fy)
        first_u, first_v = np.ceil(u - half_u).astype(np.int64), np.ceil(v - half_v).astype(np.int64)
        rows, columns, depths = [], [], []
        for dv in range(int(np.floor(2 * half_v)) + 1):
            for du in range(int(np.floor(2 * half_u)) + 1):
                column, row = first_u + du, first_v + dv
                lands = (column < u + half_u) & (row < v + half_v)
                lands &= (column >= 0) & (column < target.width) & (row >= 0) & (row < target.height)
                rows.append(np.where(lands, row, -1))
                columns.append(column)
                depths.append(z)
        row, column = np.stack(rows, axis=1).ravel(), np.stack(columns, axis=1).ravel()
        flat = np.stack(depths, axis=1).ravel()
        lands = row >= 0
        warped = np.zeros((target.height, target.width), dtype=np.float32)
        warped[row[lands], column[lands]] = flat[lands]
        return warped


class Undistortion:
    """Removes a lens distortion; the camera matrix stays the same."""

    def __init__(self, intrinsics: Intrinsics, model: str, coefficients: Float64) -> None:
        K = np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]])
        size = (intrinsics.width, intrinsics.height)
        if model == "equidistant":
            maps = cv2.fisheye.initUndistortRectifyMap(K, coefficients[:4], np.eye(3), K, size, cv2.CV_32FC1)
        else:
            maps = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
        self._map_u, self._map_v = maps

    def color(self, image: UInt8) -> UInt8:
        """Colour (H, W, 3), interpolated; black where the lens saw nothing."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_LINEAR), dtype=np.uint8)

    def labels(self, image: UInt8) -> UInt8:
        """Labels (H, W), nearest pixel; 0 where the lens saw nothing."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_NEAREST), dtype=np.uint8)

    def depth(self, image: Float32) -> Float32:
        """Depth (H, W) [m], nearest pixel; 0 where the lens saw nothing."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_NEAREST), dtype=np.float32)
