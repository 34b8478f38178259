"""Depth cameras' errors on exact depth: active stereo like a D435, a scanned laser like an L515.

docs/reliability.md compares published figures with the figures used here.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.mujoco.cell import Lens
from tools.mujoco.poses import Float64

DEPTH_LENS = Lens(fx=386.0, fy=386.0, cx=319.5, cy=239.5)
COLOR_FROM_DEPTH = np.array([0.015, 0.0, 0.0])  # [m] the depth imager in the colour camera's frame
COUNT = 1e-3  # [m] of a depth image's unit


@dataclass(frozen=True, kw_only=True)
class Stereo:
    """An active stereo camera; its errors arise in disparity."""

    spread: float  # [px] standard deviation of the disparity's error
    fattening: int  # [px] a foreground grows over what is behind by 1 to this
    window: float = 2.0  # [px] of the Gaussian that smooths the error
    dropouts: float = 0.004  # share of pixels lost in blobs
    step: float = 1 / 32  # [px] of disparity
    baseline: float = 0.050  # [m]
    near: float = 0.28  # [m]
    far: float = 6.0  # [m]

    def measured(self, depth: Float64, lost: NDArray[np.bool_], rng: np.random.Generator) -> Float64:
        """Measured depth (H, W) [m] of exact depth, 0 if missing; lost: pixels whose surface returns none."""
        there = depth > 0
        scale = DEPTH_LENS.fx * self.baseline
        disparity = np.where(there, scale / np.where(there, depth, 1.0), 0.0)
        hidden = _shadow(disparity)
        grown = _fattened(disparity, self.fattening, rng)
        noise = self.spread * _smooth(depth.shape, self.window, rng)
        read = self.step * np.rint((grown + noise) / self.step)
        is_lost = (
            (read <= 0) | ((hidden | lost | ~there) & (grown == disparity)) | _blobs(depth.shape, self.dropouts, rng)
        )
        z = np.where(is_lost, 0.0, scale / np.where(read > 0, read, 1.0))
        return np.where((z >= self.near) & (z <= self.far), z, 0.0)


@dataclass(frozen=True, kw_only=True)
class Laser:
    """A scanned laser; its error is independent by pixel, with a standard deviation of base + slope * depth [m]."""

    base: float = 0.000875
    slope: float = 0.001625
    mixed: float = 0.5  # share of the pixels at a depth edge that lie between both surfaces
    dropouts: float = 0.004
    near: float = 0.25
    far: float = 6.0

    def measured(self, depth: Float64, lost: NDArray[np.bool_], rng: np.random.Generator) -> Float64:
        """Depth (H, W) [m] of exact depth, 0 where none is returned."""
        square = np.ones((3, 3), np.uint8)
        behind, before = cv2.dilate(depth, square), cv2.erode(np.where(depth > 0, depth, np.inf), square)
        is_mixed = (behind - before > 0.02) & np.isfinite(before) & (rng.random(depth.shape) < self.mixed)
        share = rng.random(depth.shape)
        z = np.where(is_mixed, before + share * (behind - np.where(is_mixed, before, 0.0)), depth)
        z = z + (self.base + self.slope * z) * rng.standard_normal(depth.shape)
        is_lost = (depth <= 0) | lost | _blobs(depth.shape, self.dropouts, rng)
        return np.where(is_lost | (z < self.near) | (z > self.far), 0.0, z)


def draw_sensor(kind: str, rng: np.random.Generator) -> Stereo | Laser | None:
    """The sensor of a kind of `DEPTHS`, with random strength; None for exact depth."""
    if kind == "ideal":
        return None
    if kind == "laser":
        return Laser()
    if kind == "mild":
        return Stereo(spread=float(rng.uniform(0.03, 0.05)), fattening=1)
    return Stereo(spread=float(rng.uniform(0.05, 0.08)), fattening=int(rng.integers(2, 4)))


DEPTHS = ("ideal", "mild", "real", "laser")


def aligned(depth: Float64, color_lens: Lens) -> NDArray[np.uint16]:
    """A depth image (H, W) [m] resampled to the colour camera (H, W), in units of `COUNT`.

    Aligns as librealsense does: each pixel's square is projected by its corners and fills whole pixels; the nearest
    depth wins.
    """
    v, u = np.nonzero(depth > 0)
    z = depth[v, u]
    corners = []
    for side in (-0.5, 0.5):
        x = (u + side - DEPTH_LENS.cx) / DEPTH_LENS.fx * z + COLOR_FROM_DEPTH[0]
        y = (v + side - DEPTH_LENS.cy) / DEPTH_LENS.fy * z + COLOR_FROM_DEPTH[1]
        corners.append(
            (
                np.floor(x / z * color_lens.fx + color_lens.cx + 0.5).astype(int),
                np.floor(y / z * color_lens.fy + color_lens.cy + 0.5).astype(int),
            )
        )
    (left, top), (right, bottom) = corners
    out = np.full((color_lens.height, color_lens.width), np.inf)
    for dx in range(int((right - left).max(initial=0)) + 1):
        for dy in range(int((bottom - top).max(initial=0)) + 1):
            x, y = left + dx, top + dy
            fits = (x <= right) & (y <= bottom) & (x >= 0) & (y >= 0)
            fits &= (x < color_lens.width) & (y < color_lens.height)
            np.minimum.at(out, (y[fits], x[fits]), z[fits])
    return counted(np.where(np.isfinite(out), out, 0.0))


def counted(depth: Float64) -> NDArray[np.uint16]:
    """Depth [m] in whole counts."""
    return np.rint(depth / COUNT).astype(np.uint16)


def _shadow(disparity: Float64) -> NDArray[np.bool_]:
    """True where a nearer surface hides a left pixel's surface from the right imager."""
    there = np.arange(disparity.shape[1]) - disparity
    nearest = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(there > nearest + 0.5)


def _fattened(disparity: Float64, most: int, rng: np.random.Generator) -> Float64:
    """Disparity with foregrounds grown over their background by 1 to `most` pixels, depending on place."""
    if most == 0:
        return disparity
    field = _smooth(disparity.shape, 6.0, rng)
    ranks = np.searchsorted(np.quantile(field, np.arange(1, most) / most), field)
    out = disparity
    for width in range(1, most + 1):
        grown = cv2.dilate(disparity, np.ones((2 * width + 1, 2 * width + 1), np.uint8))
        is_over = (ranks + 1 == width) & (grown - disparity > 1.0)
        out = np.where(is_over, grown, out)
    return out


def _blobs(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """A share of the pixels, in blobs of some five pixels."""
    field = _smooth(shape, 2.0, rng)
    return np.asarray(field > np.quantile(field, 1 - share))


def _smooth(shape: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Float64:
    """Noise (H, W) of unit variance whose correlation falls to exp(-1) at twice sigma [px]."""
    white = rng.standard_normal(shape, dtype=np.float32)
    blurred = cv2.GaussianBlur(white, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred * (2 * np.sqrt(np.pi) * sigma), np.float64)
