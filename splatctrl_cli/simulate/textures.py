"""Procedural solid textures with features of a few centimetres, smooth enough for a few thousand splats."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.records import Float64

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A pattern between two colours over the solid's own frame.

    pattern `noise`, `stripes` or `checks`; feature [m]: cell of the noise, or width of one stripe or check;
    dark, bright: RGB in [0, 1]; seed: of the noise.
    """

    pattern: str
    feature: float
    dark: tuple[float, float, float]
    bright: tuple[float, float, float]
    seed: int = 0

    def color(self, points_shape: Float64) -> Float64:
        """RGB (R, 3) in [0, 1] at points (R, 3) [m] in the solid's own frame."""
        p = points_shape / self.feature
        if self.pattern == "noise":
            share = _value_noise(p + 0.37, self.seed)
            share = 0.5 + 0.5 * np.tanh(3.6 * (share - 0.5))
        elif self.pattern == "stripes":
            wave = np.sin(np.pi * (p @ np.array([0.62, 0.48, 0.62])) + self.seed)
            share = 0.5 + 0.5 * np.tanh(1.5 * wave) / np.tanh(1.5)
        else:
            wave = np.prod(np.sin(np.pi * (p + 0.25)), axis=1)
            share = 0.5 + 0.5 * np.tanh(4.0 * wave)
        dark, bright = np.array(self.dark), np.array(self.bright)
        return np.asarray(dark + (bright - dark) * share[:, None])


def luminance_std(color: np.ndarray) -> float:
    """Standard deviation of the luminance (0 to 1) of an 8-bit RGB image (H, W, 3)."""
    return float(np.std(color.astype(np.float64) @ LUMINANCE / 255))


def _value_noise(p: Float64, seed: int) -> Float64:
    """Smooth noise (R,) in [0, 1]: random values on the integer lattice, blended by smoothstep."""
    cell = np.floor(p)
    t = p - cell
    t = t * t * (3 - 2 * t)
    lattice = cell.astype(np.int64)
    total = np.zeros(len(p))
    for corner in range(8):
        step = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        weight = np.prod(np.where(step, t, 1 - t), axis=1)
        total += weight * _hash(lattice + step, seed)
    return total


def _hash(lattice: np.ndarray, seed: int) -> Float64:
    """A fixed pseudo-random value (R,) in [0, 1) per integer point (R, 3)."""
    x, y, z = (lattice[:, i].astype(np.uint64) for i in range(3))
    key = x * np.uint64(0x9E3779B97F4A7C15) ^ y * np.uint64(0xC2B2AE3D27D4EB4F) ^ z * np.uint64(0x165667B19E3779F9)
    key ^= np.uint64(seed * 0x27D4EB2F + 0x85EBCA6B)
    key ^= key >> np.uint64(33)
    key *= np.uint64(0xFF51AFD7ED558CCD)
    key ^= key >> np.uint64(33)
    key *= np.uint64(0xC4CEB9FE1A85EC53)
    key ^= key >> np.uint64(33)
    return np.asarray((key >> np.uint64(11)).astype(np.float64) / 2.0**53)
