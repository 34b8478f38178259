"""Where images change from frame to frame, and where a moving robot of spheres would change them."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Float32, Float64, Intrinsics, RgbdFrame, UInt8

DEPTH_STEP = 0.05  # [m] at which the change of a pixel's depth counts in full
COLOR_STEP = 64.0  # [grey levels] likewise
COLUMNS = 64  # that images are reduced to
MAX_FRAMES = 300  # of a camera; later ones are not looked at
FIXED = 1e-3  # [m, rad] within which a camera stands still
_NEAR = 0.05  # [m] in front of the camera


@dataclass(kw_only=True)
class CameraMotion:
    """The frames of one camera: stamps (K + 1) [ns] and changes (K) of (h, w) float32 in [0, 1] between them."""

    intrinsics: Intrinsics
    T_world_camera: Float64
    is_fixed: bool = True
    stamps_ns: list[int] = field(default_factory=list)
    changes: list[Float32] = field(default_factory=list)


@dataclass(kw_only=True)
class ImageMotion:
    """Collects how the images of each camera change."""

    cameras: dict[str, CameraMotion] = field(default_factory=dict)
    _last: dict[str, tuple[Float32, UInt8]] = field(default_factory=dict)

    def add(self, frame: RgbdFrame) -> None:
        """Take the next frame of its camera."""
        camera = self.cameras.get(frame.camera)
        if camera is None:
            small = _reduced(frame.intrinsics)
            camera = CameraMotion(intrinsics=small, T_world_camera=frame.T_world_camera)
            self.cameras[frame.camera] = camera
        if len(camera.stamps_ns) == MAX_FRAMES:
            return
        size = (camera.intrinsics.width, camera.intrinsics.height)
        gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        now = (
            np.asarray(cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32),
            np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.uint8),
        )
        camera.is_fixed &= bool(np.abs(frame.T_world_camera - camera.T_world_camera).max() < FIXED)
        camera.stamps_ns.append(frame.stamp_ns)
        if frame.camera in self._last:
            camera.changes.append(_change(*self._last[frame.camera], *now))
        self._last[frame.camera] = now


def _reduced(intrinsics: Intrinsics) -> Intrinsics:
    width = min(COLUMNS, intrinsics.width)
    height = max(1, round(intrinsics.height * width / intrinsics.width))
    across, down = width / intrinsics.width, height / intrinsics.height
    return Intrinsics(
        fx=intrinsics.fx * across,
        fy=intrinsics.fy * down,
        cx=(intrinsics.cx + 0.5) * across - 0.5,
        cy=(intrinsics.cy + 0.5) * down - 0.5,
        width=width,
        height=height,
    )


def _change(depth_a: Float32, gray_a: UInt8, depth_b: Float32, gray_b: UInt8) -> Float32:
    """Change of each pixel in [0, 1]: of depth where both frames have some, else of brightness."""
    both = (depth_a > 0) & (depth_b > 0)
    of_depth = np.minimum(np.abs(depth_b - depth_a) / DEPTH_STEP, 1.0)
    of_gray = np.minimum(np.abs(gray_b.astype(np.float32) - gray_a) / COLOR_STEP, 1.0)
    return np.asarray(np.where(both, of_depth, of_gray), dtype=np.float32)


def silhouettes(centers_world: Float64, radii: Float64, camera: CameraMotion) -> Float32:
    """Depth (T, h, w) [m] of spheres, centres (T, S, 3) and radii (S,), as a camera sees them; 0 where there is none.

    A sphere is drawn as a disc of its radius at its distance, which is exact on the optical axis.
    """
    intrinsics = camera.intrinsics
    centers = transform_points(invert_transform(camera.T_world_camera), centers_world)
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width].reshape(2, -1).astype(np.float32)
    depth = np.zeros((len(centers), u.size), dtype=np.float32)
    for row, spheres in zip(depth, centers, strict=True):
        is_ahead = spheres[:, 2] - radii > _NEAR
        x, y, z = spheres[is_ahead].astype(np.float32).T
        dx = (u[None] - intrinsics.cx) * (z / intrinsics.fx)[:, None] - x[:, None]
        dy = (v[None] - intrinsics.cy) * (z / intrinsics.fy)[:, None] - y[:, None]
        above = np.square(radii[is_ahead].astype(np.float32))[:, None] - dx * dx - dy * dy
        front = np.where(above > 0, z[:, None] - np.sqrt(np.maximum(above, 0)), np.float32(np.inf))
        nearest = front.min(axis=0, initial=np.inf)
        row[:] = np.where(np.isfinite(nearest), nearest, 0)
    return depth.reshape(len(centers), intrinsics.height, intrinsics.width)


def predicted_change(depth_a: Float32, depth_b: Float32) -> Float32:
    """Change (K, h, w) in [0, 1] between silhouettes (K, h, w): 1 where only one has the robot."""
    a, b = depth_a > 0, depth_b > 0
    of_depth = np.minimum(np.abs(depth_b - depth_a) / np.float32(DEPTH_STEP), np.float32(1.0))
    return np.where(a & b, of_depth, (a ^ b).astype(np.float32)).astype(np.float32)


def correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Pearson's, of all entries; 0 where one does not vary. Sums and no dot products: those differ by threads."""
    x, y = np.asarray(a, dtype=np.float64).ravel(), np.asarray(b, dtype=np.float64).ravel()
    x, y = x - x.mean(), y - y.mean()
    length = float(np.sqrt(np.sum(x * x)) * np.sqrt(np.sum(y * y)))
    return float(np.sum(x * y)) / length if length > 0 else 0.0
