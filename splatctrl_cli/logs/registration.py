"""Depth seen from the colour camera, and images without lens distortion."""

from dataclasses import dataclass

import cv2
import numpy as np

from splatctrl_cli.config.fixed import FARTHEST_RAY, REGISTERED_SHARE
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Float32, Float64, Intrinsics, UInt8

DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
NUM_COEFFICIENTS = (4, 5, 8, 12, 14)  # that OpenCV takes
SAME_MODELS = {  # what others call them
    "Brown Conrady": "plumb_bob",
    "radtan": "plumb_bob",
    "Kannala Brandt4": "equidistant",
    "kannala_brandt": "equidistant",
    "fisheye": "equidistant",
}


@dataclass(frozen=True, kw_only=True)
class DepthToColor:
    """Warps depth images of one camera into another's view; undistortion: of the depth camera's own lens."""

    depth_intrinsics: Intrinsics
    color_intrinsics: Intrinsics
    T_color_depth: Float64
    undistortion: "Undistortion | None" = None

    def warp(self, depth: Float32) -> Float32:
        """Depth (H', W') [m] of the depth camera -> (H, W) [m] in the colour camera, 0 = none.

        Each depth pixel covers its square's image in the colour camera (no holes where that has the finer pixels);
        of several that land on a pixel, the nearest counts.
        """
        target = self.color_intrinsics
        depth = depth if self.undistortion is None else self.undistortion.depth(depth)
        x, y, z = transform_points(self.T_color_depth, back_project(self.depth_intrinsics, depth)[depth > 0]).T
        front = z > 0
        z = z[front]
        u = target.fx * x[front] / z + target.cx
        v = target.fy * y[front] / z + target.cy
        half_u = 0.5 * max(1.0, target.fx / self.depth_intrinsics.fx)
        half_v = 0.5 * max(1.0, target.fy / self.depth_intrinsics.fy)
        first_u, first_v = np.ceil(u - half_u), np.ceil(v - half_v)
        nearest, depths = np.full(target.height * target.width, np.inf, dtype=np.float32), z.astype(np.float32)
        for dv in range(int(np.floor(2 * half_v)) + 1):
            row = first_v + dv
            is_row = (row < v + half_v) & (row >= 0) & (row < target.height)
            for du in range(int(np.floor(2 * half_u)) + 1):
                column = first_u + du
                lands = is_row & (column < u + half_u) & (column >= 0) & (column < target.width)
                pixels = (row[lands] * target.width + column[lands]).astype(np.int64)
                np.minimum.at(nearest, pixels, depths[lands])
        nearest[np.isinf(nearest)] = 0.0
        return nearest.reshape(target.height, target.width)


class Undistortion:
    """Removes a lens distortion.

    intrinsics: those of the result, which are the lens's own unless `lens` says others; R (3, 3) turns the lens's
    axes into those of the result. valid: (H, W), False where the lens did not see the pixel, as in the corners of a
    pincushion; None where it saw all. There colour is black, and depth and labels are 0.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        model: str,
        coefficients: Float64,
        *,
        lens: Intrinsics | None = None,
        R: Float64 | None = None,
    ) -> None:
        R = np.eye(3) if R is None else R
        if len(coefficients) not in NUM_COEFFICIENTS:
            expected = ", ".join(map(str, NUM_COEFFICIENTS))
            raise InputError(
                f"distortion model {model}: expected {expected} coefficients, got {len(coefficients)}",
                remedy="calibrate again, or fill up with zeros",
            )
        self.intrinsics = intrinsics
        self._map_u, self._map_v = _maps(lens or intrinsics, model, coefficients, R, intrinsics)
        is_seen = (self._map_u >= 0) & (self._map_u <= intrinsics.width - 1)
        is_seen &= (self._map_v >= 0) & (self._map_v <= intrinsics.height - 1)
        is_seen &= _radii(intrinsics, R) < _largest_radius(model, coefficients)
        if is_seen.mean() < REGISTERED_SHARE:
            raise InputError(
                f"distortion {model} {np.round(coefficients, 6).tolist()}: the camera saw {is_seen.mean():.0%} of the"
                f" pinhole's image, expected at least {REGISTERED_SHARE:.0%}",
                remedy="correct the calibration, or undistort the images first",
            )
        self.valid = None if is_seen.all() else is_seen
        self._map_u[~is_seen] = -10.0  # folded back into the image, or outside of it

    def color(self, image: UInt8) -> UInt8:
        """Colour (H, W, 3), interpolated."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_LINEAR), dtype=np.uint8)

    def labels(self, image: UInt8) -> UInt8:
        """Labels (H, W), nearest pixel."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_NEAREST), dtype=np.uint8)

    def depth(self, image: Float32) -> Float32:
        """Depth (H, W) [m], nearest pixel."""
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_NEAREST), dtype=np.float32)


def _maps(
    lens: Intrinsics, model: str, coefficients: Float64, R: Float64, result: Intrinsics
) -> tuple[Float32, Float32]:
    """Column and row in the distorted image of each pixel of the result."""
    K, P = (np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]], dtype=np.float64) for k in (lens, result))
    size = (result.width, result.height)
    if model == "equidistant":
        maps = cv2.fisheye.initUndistortRectifyMap(K, coefficients[:4], R, P, size, cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(K, coefficients, R, P, size, cv2.CV_32FC1)
    return np.asarray(maps[0]), np.asarray(maps[1])


def _radii(result: Intrinsics, R: Float64) -> Float64:
    """Distance of each pixel (H, W) of the result from the lens's axis, at a depth of one."""
    x, y, z = np.moveaxis(back_project(result, np.ones((result.height, result.width))) @ R, 2, 0)
    return np.asarray(np.where(z > 0, np.hypot(x, y) / np.maximum(z, 1e-9), np.inf))


def _largest_radius(model: str, coefficients: Float64) -> float:
    """Up to which distance from the axis a lens's polynomial still grows: beyond, it would show things twice."""
    r = np.linspace(0.0, FARTHEST_RAY, 20001)
    k = np.zeros(8)
    k[: min(len(coefficients), 8)] = coefficients[:8]
    if model == "equidistant":
        a = np.arctan(r)
        bent = a * (1 + k[0] * a**2 + k[1] * a**4 + k[2] * a**6 + k[3] * a**8)
    else:
        bent = r * (1 + k[0] * r**2 + k[1] * r**4 + k[4] * r**6) / (1 + k[5] * r**2 + k[6] * r**4 + k[7] * r**6)
    folds = np.flatnonzero(np.diff(bent) <= 0)
    return float(r[folds[0]]) if folds.size else np.inf
