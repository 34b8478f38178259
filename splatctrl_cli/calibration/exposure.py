"""How much brighter or more coloured one view of a still scene is than another, by the surfaces that both see."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from splatctrl_cli.calibration.gray_views import gray_view, on_surface, overlapping, scaled
from splatctrl_cli.calibration.views import depth_sigma
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, project
from splatctrl_cli.records import Bool, Float64, Index, RgbdFrame


@dataclass(frozen=True, kw_only=True)
class BandRatios:
    """How much brighter B bands of rows of N images show the same surfaces than bands of others: E medians.

    channels (E,); pairs (E, 2): numbers of two bands, B times the image's and its own; ratios (E,): the logarithm of
    the first over the second; weights (E,).
    """

    num_images: int
    num_bands: int
    channels: Index
    pairs: Index
    ratios: Float64
    weights: Float64

    def gains(self, is_free: Bool) -> Float64:
        """Gains (N, B, 3) of red, green and blue that explain the ratios: least squares of the logarithms.

        A wide prior keeps them about 1; images that are not `is_free` (N,) keep gain 1.
        """
        num_gains, is_kept = self.num_bands * self.num_images, np.repeat(~is_free, self.num_bands)
        A = np.tile(np.eye(num_gains) / fixed.EXPOSURE_PRIOR**2, (3, 1, 1))
        A[:, is_kept, is_kept] += 1e12
        b = np.zeros((3, num_gains))
        for row, sign in enumerate((1.0, -1.0)):
            np.add.at(b, (self.channels, self.pairs[:, row]), sign * self.weights * self.ratios)
            for column in range(2):
                place = (self.channels, self.pairs[:, row], self.pairs[:, column])
                np.add.at(A, place, self.weights * (1.0 if row == column else -1.0))
        logs = np.linalg.solve(A, b[..., None])[..., 0].T
        return np.asarray(np.exp(logs).reshape(self.num_images, self.num_bands, 3))

    def misfit(self, gains: Float64) -> float:
        """Median over the ratios of what gains (N, B or 1, 3) leave of their logarithms."""
        logs = np.log(np.broadcast_to(gains, (self.num_images, self.num_bands, 3)).reshape(-1, 3))
        first, second = (logs[self.pairs[:, k], self.channels] for k in range(2))
        return float(np.median(np.abs(self.ratios - (first - second)))) if len(self.ratios) else 0.0


def exposure_gains(frames: Sequence[RgbdFrame], scale: float = 1.0, free: Bool | None = None) -> Float64:
    """Gains (N, 3) of red, green and blue, so that an image divided by its gain shows what the others show.

    scale: of the recording's lengths; views that are not `free` (N,) keep gain 1.
    """
    is_free = np.ones(len(frames), np.bool_) if free is None else free
    return band_ratios(frames, scale, is_free, 1).gains(is_free)[:, 0]


def band_ratios(frames: Sequence[RgbdFrame], scale: float, is_free: Bool, num_bands: int) -> BandRatios:
    """Those of all pairs of views that see the same surfaces, one of them free; near black and white do not count."""
    views = [gray_view(frame, scale) for frame in frames]
    poses = [scaled(frame.T_world_camera, 1 / scale) for frame in frames]
    colors = [_small(frame, view.gray.shape[0]) for frame, view in zip(frames, views, strict=True)]
    found: list[tuple[int, int, int, float, float]] = []
    for i, j in overlapping(views, poses, np.ones(len(frames), np.bool_), is_free):
        there, lands, _, _, distance = on_surface(views[i], views[j], invert_transform(poses[j]) @ poses[i])
        lands &= np.abs(distance) < fixed.EXPOSURE_NEAR * depth_sigma(there[:, 2])
        u, v = np.round(project(views[j].depth.lens, there[lands])).astype(np.int64).T
        own_u, own_v = np.round(project(views[i].depth.lens, views[i].depth.points[lands])).astype(np.int64).T
        own, other = colors[i][own_v, own_u], colors[j][v, u]
        low, high = fixed.EXPOSURE_LEVELS
        is_known = (np.minimum(own, other) > low) & (np.maximum(own, other) < high)
        ratios = np.log(np.maximum(own, low) / np.maximum(other, low))
        first = i * num_bands + own_v * num_bands // len(colors[i])
        second = j * num_bands + v * num_bands // len(colors[j])
        for a, b in np.unique(np.stack([first, second], axis=1), axis=0).tolist():
            is_of_pair = (first == a) & (second == b)
            for channel in range(3):
                some = ratios[is_of_pair & is_known[:, channel], channel]
                if len(some) >= fixed.REFINE_FEWEST:
                    found.append((channel, a, b, *_median_ratio(some)))
    numbers, values = np.array([row[:3] for row in found], np.int64), np.array([row[3:] for row in found])
    numbers, values = numbers.reshape(-1, 3), values.reshape(-1, 2)
    return BandRatios(
        num_images=len(frames),
        num_bands=num_bands,
        channels=numbers[:, 0],
        pairs=numbers[:, 1:],
        ratios=values[:, 0],
        weights=values[:, 1],
    )


def _median_ratio(ratios: Float64) -> tuple[float, float]:
    """The median of logarithms, and its weight."""
    ratio = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - ratio)))
    return ratio, 1 / (fixed.EXPOSURE_ERROR**2 + spread**2 / len(ratios))


def exposed(frame: RgbdFrame, gain: Float64) -> RgbdFrame:
    """The frame with its colours divided by a gain (3,)."""
    levels = np.rint(np.arange(256)[:, None] / gain)
    table = np.clip(levels, 0, 255).astype(np.uint8)
    return replace(frame, color=np.stack([table[frame.color[..., k], k] for k in range(3)], axis=-1))


def _small(frame: RgbdFrame, rows: int) -> Float64:
    """Smoothed levels (h, w, 3) at the pixels of a `GrayView` of so many rows."""
    stride = -(-frame.color.shape[0] // rows)
    smooth = cv2.GaussianBlur(frame.color, (0, 0), fixed.EXPOSURE_BLUR * stride)
    return np.asarray(smooth[::stride, ::stride], np.float64)
