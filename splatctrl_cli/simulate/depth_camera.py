"""Two models of an active-stereo camera: measured from exact depth."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, minimum_filter
from scipy.special import ndtr

from splatctrl_cli.records import Bool, Float32, Float64

WIDTH, FOCAL = 640, 386.0  # [px] of the two depth imagers of a RealSense D435
BASELINE = 0.05  # [m] between them; the second stands to the right
STEPS = 32  # of disparity in a pixel
EDGE = 0.5  # [px] of disparity between neighbours that are no longer one surface


@dataclass(frozen=True, kw_only=True)
class StereoDepth:
    """Depth measured by two imagers, in the image of a colour camera.

    A depth pixel is a pixel of the imagers.

    - Disparity d = f b / z errs by `spread` [px], so depth errs by z^2 spread / (f b): with 0.07 px, 3.6 mm at 1 m
      and 14.5 mm at 2 m. Errors r depth pixels apart correlate by exp(-(r / `window`)^2). Steps are of 1/32 px.
    - Next to an edge of 0.5 px or more, the background takes the foreground's depth over `fattening` depth pixels.
      That width is uniform between the two numbers, constant within a window.
    - Background that the second imager does not see is lost: f b (1 / z_foreground - 1 / z_background) depth pixels
      left of the foreground, less those that took its depth.
    - A share `dropout` of all pixels is lost, in blobs twice as wide as the window; so are depths out of `least` to
      `most` [m].

    width [px]: of the imagers, scaling their focal length; None: as wide as the image.
    """

    spread: float = 0.07
    window: float = 2.5
    fattening: tuple[float, float] = (1.0, 3.0)
    dropout: float = 0.005
    least: float = 0.28
    most: float = 6.0
    width: int | None = None

    def applied(self, depth: Float32, rng: np.random.Generator, *, focal: float = 0.0) -> Float32:
        """Measured depth (H, W) [m] of exact `depth`, 0 = none.

        focal [px]: of the depth image; 0: of the imagers.
        """
        imager = FOCAL * (self.width or depth.shape[1]) / WIDTH
        scale = focal / imager if focal > 0 else 1.0  # pixels of the image in one of the imagers
        exact = np.where(depth > 0, imager * BASELINE / np.where(depth > 0, depth, 1.0), 0.0)
        sigma = 0.5 * scale * self.window  # blurred noise correlates by exp(-(r / 2 sigma)^2)
        error, wide, offset, lost = (_blur(rng, depth.shape, sigma * blob) for blob in (1, 2, 2, 2))
        low, high = self.fattening
        reach = np.floor(scale * (low + (high - low) * ndtr(wide)) + ndtr(offset)).astype(np.int64)
        seen = _fatten(exact, reach)
        is_lost = _is_hidden(depth, scale * imager * BASELINE) & (seen == exact)
        is_lost |= lost > np.quantile(lost, 1 - self.dropout)
        disparity = np.rint((seen + self.spread * error) * STEPS) / STEPS
        measured = imager * BASELINE / np.maximum(disparity, 1 / STEPS)
        is_lost |= (seen == 0) | (measured < self.least) | (measured > self.most)
        return np.where(is_lost, 0, measured).astype(np.float32)


def _blur(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Float64:
    impulse = np.zeros(min(shape))
    impulse[0] = 1.0
    kernel = gaussian_filter(impulse, sigma, mode="wrap")
    return np.asarray(gaussian_filter(rng.standard_normal(shape), sigma, mode="wrap") / (kernel @ kernel))


def _is_hidden(depth: Float32, focal_baseline: float) -> Bool:
    columns = np.arange(depth.shape[1])
    shifted = np.where(depth > 0, columns - focal_baseline / np.where(depth > 0, depth, 1.0), np.inf)
    least = np.minimum.accumulate(shifted[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(shifted > least + 0.5)  # [px]


def _fatten(disparity: Float64, reach: np.ndarray) -> Float64:
    out = disparity
    for radius in range(1, int(reach.max()) + 1):
        y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        largest = -minimum_filter(-disparity, footprint=np.hypot(x, y) <= radius + 0.5, mode="nearest")
        out = np.where((reach >= radius) & (largest - disparity > EDGE), largest, out)
    return out


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Errors of a depth camera like a D435, registered to colour.

    spread [m]: sigma at 1 m, growing with depth squared. step [m]: quantisation at 1 m. patch [px]: matching window,
    over which errors agree. dropout: share of pixels lost, in patch-sized blobs. edge [m]: depth step that loses both
    neighbours. max_range [m]: farther is lost. baseline [m]: of the imagers, to lose occluded depth (0: off).
    """

    spread: float = 0.0012
    step: float = 0.002
    patch: int = 6
    dropout: float = 0.005
    edge: float = 0.03
    max_range: float = 3.0
    baseline: float = 0.0

    def applied(self, depth: Float32, rng: np.random.Generator, *, focal: float = 0.0) -> Float32:
        """Noisy depth (H, W) [m] of exact `depth`, 0 = none.

        focal [px]: needed for a baseline.
        """
        coarse = (depth.shape[0] // self.patch + 3, depth.shape[1] // self.patch + 3)
        error = _enlarge(rng.standard_normal(coarse), self.patch, depth.shape)
        lost = _enlarge(rng.standard_normal(coarse), self.patch, depth.shape)
        exact = np.where(depth > 0, depth.astype(np.float64), 1.0)
        noisy = 1 / (self.step * np.rint((1 / exact + self.spread * error) / self.step))
        threshold = np.quantile(lost, 1 - self.dropout) if self.dropout > 0 else np.inf
        is_lost = (lost > threshold) | (depth <= 0) | (noisy > self.max_range) | _is_at_edge(depth, self.edge)
        if self.baseline > 0:
            is_lost |= _is_hidden(depth, focal * self.baseline)
        return np.where(is_lost, 0, noisy).astype(np.float32)


def _enlarge(coarse: np.ndarray, factor: int, shape: tuple[int, ...]) -> np.ndarray:
    v, u = np.arange(shape[0]) / factor, np.arange(shape[1]) / factor
    i, j = v.astype(int), u.astype(int)
    a, b = (v - i)[:, None], (u - j)[None]
    weights = ((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b)
    corners = ((0, 0), (0, 1), (1, 0), (1, 1))
    total = sum(w * coarse[np.ix_(i + di, j + dj)] for w, (di, dj) in zip(weights, corners, strict=True))
    return np.asarray(total / np.sqrt(sum(w**2 for w in weights)))


def _is_at_edge(depth: Float32, step: float) -> Bool:
    across, down = (np.abs(np.diff(depth, axis=axis)) > step for axis in (1, 0))
    sides = [np.pad(across, ((0, 0), pad)) for pad in ((1, 0), (0, 1))]
    sides += [np.pad(down, (pad, (0, 0))) for pad in ((1, 0), (0, 1))]
    return np.asarray(np.any(sides, axis=0))
