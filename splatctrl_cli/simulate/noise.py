"""What an active-stereo depth camera adds to exact depth: disparity noise, holes at edges, dropouts."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.records import Bool, Float32


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """A depth camera's error, in the manner of a D435 whose depth is registered to colour.

    spread: standard deviation [m] at 1 m, growing with depth squared (an error in disparity); step [m]: distance
    of neighbouring depths at 1 m, as disparity comes in fixed steps; patch [px]: size of the matching window, over
    which errors agree; dropout: share of pixels lost at random, in blobs of a patch; edge [m]: step of depth
    between neighbours beyond which both are lost; max_range [m]: farther is lost.
    """

    spread: float = 0.0012
    step: float = 0.002
    patch: int = 6
    dropout: float = 0.005
    edge: float = 0.03
    max_range: float = 3.0

    def applied(self, depth: Float32, rng: np.random.Generator) -> Float32:
        """Noisy depth (H, W) [m] of exact `depth`, 0 = none."""
        coarse = (depth.shape[0] // self.patch + 3, depth.shape[1] // self.patch + 3)
        error = _enlarged(rng.standard_normal(coarse), self.patch, depth.shape)
        lost = _enlarged(rng.standard_normal(coarse), self.patch, depth.shape)
        exact = np.where(depth > 0, depth.astype(np.float64), 1.0)
        noisy = 1 / (self.step * np.rint((1 / exact + self.spread * error) / self.step))
        threshold = np.quantile(lost, 1 - self.dropout) if self.dropout > 0 else np.inf
        is_lost = (lost > threshold) | (depth <= 0) | (noisy > self.max_range) | _is_at_edge(depth, self.edge)
        return np.where(is_lost, 0, noisy).astype(np.float32)


def _enlarged(coarse: np.ndarray, factor: int, shape: tuple[int, ...]) -> np.ndarray:
    """Smooth unit-variance noise (H, W): coarse noise, blended bilinearly."""
    v, u = np.arange(shape[0]) / factor, np.arange(shape[1]) / factor
    i, j = v.astype(int), u.astype(int)
    a, b = (v - i)[:, None], (u - j)[None]
    weights = ((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b)
    corners = ((0, 0), (0, 1), (1, 0), (1, 1))
    total = sum(w * coarse[np.ix_(i + di, j + dj)] for w, (di, dj) in zip(weights, corners, strict=True))
    return np.asarray(total / np.sqrt(sum(w**2 for w in weights)))


def _is_at_edge(depth: Float32, step: float) -> Bool:
    """True at both pixels of every horizontal or vertical neighbour pair whose depths differ by more than `step`."""
    out = np.zeros(depth.shape, dtype=bool)
    across = np.abs(np.diff(depth, axis=1)) > step
    down = np.abs(np.diff(depth, axis=0)) > step
    out[:, 1:] |= across
    out[:, :-1] |= across
    out[1:] |= down
    out[:-1] |= down
    return out
