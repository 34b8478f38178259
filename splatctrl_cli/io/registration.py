"""Depth seen from the colour camera, and images without lens distortion."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Float32, Float64, Intrinsics, UInt8

DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
STEP, MOST_STEPS = 1.01, 240  # of the focal length of an undistorted image, up to ten times
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
    """Removes a lens distortion, so that the lens saw every pixel of the result.

    intrinsics: those of the result. They are the lens's own where these leave no pixel unseen (barrel distortion);
    else the focal lengths grow by steps of 1 % until they do: black corners would be taken for the scene's colour.
    """

    def __init__(self, intrinsics: Intrinsics, model: str, coefficients: Float64) -> None:
        for step in range(MOST_STEPS):
            growth = STEP**step
            self.intrinsics = replace(intrinsics, fx=intrinsics.fx * growth, fy=intrinsics.fy * growth)
            self._map_u, self._map_v = _maps(intrinsics, self.intrinsics, model, coefficients)
            inside_u = (self._map_u >= 0) & (self._map_u <= intrinsics.width - 1)
            if (inside_u & (self._map_v >= 0) & (self._map_v <= intrinsics.height - 1)).all():
                return
        raise InputError(
            f"distortion {model} {np.round(coefficients, 6).tolist()}: no part of the image is seen whole",
            remedy="correct the calibration, or undistort the images first",
        )

    def color(self, image: UInt8) -> UInt8:
        """Colour (H, W, 3), interpolated."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_LINEAR), dtype=np.uint8)

    def labels(self, image: UInt8) -> UInt8:
        """Labels (H, W), nearest pixel."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_NEAREST), dtype=np.uint8)

    def depth(self, image: Float32) -> Float32:
        """Depth (H, W) [m], nearest pixel."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_NEAREST), dtype=np.float32)


def _maps(lens: Intrinsics, result: Intrinsics, model: str, coefficients: Float64) -> tuple[Float32, Float32]:
    """Column and row in the distorted image of each pixel of the result."""
    K, K_new = (np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]]) for k in (lens, result))
    size = (lens.width, lens.height)
    if model == "equidistant":
        maps = cv2.fisheye.initUndistortRectifyMap(K, coefficients[:4], np.eye(3), K_new, size, cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K_new, size, cv2.CV_32FC1)
    return np.asarray(maps[0]), np.asarray(maps[1])
