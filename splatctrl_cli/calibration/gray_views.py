"""Pairs of views of a still scene: differences of depth, grey value and exposure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from splatctrl_cli.calibration.views import DepthView, depth_sigma, derive_by_twists, landed
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, project, strided_lens, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, Index, RgbdFrame

EVERY = slice(None)


@dataclass(frozen=True, kw_only=True)
class GrayView:
    """A view with lengths divided by the recording's scale, and its grey values.

    gray (h, w) in [0, 1]. slope (h, w, 2): per pixel along u and v. points_gray (K,): at the view's points. tiles
    (K,): each point's tile in a checkerboard. Even tiles solve poses, odd tiles judge.
    """

    depth: DepthView
    gray: Float32
    slope: Float32
    points_gray: Float64
    tiles: Index

    @property
    def is_solved(self) -> Bool:
        """Points (K,) that poses are solved from."""
        return np.asarray(self.tiles % 2 == 0)


def gray_view(frame: RgbdFrame, scale: float) -> GrayView:
    stride = max(1, round(frame.depth.shape[0] / fixed.REFINE_ROWS))
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth / np.float32(scale)), 5)
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(255)
    gray = cv2.GaussianBlur(gray, (0, 0), fixed.REFINE_BLUR * stride)
    gray, depth = (np.ascontiguousarray(image[::stride, ::stride]) for image in (gray, depth))
    small = replace(
        frame,
        depth=np.asarray(depth, np.float32),
        color=np.zeros((*depth.shape, 3), np.uint8),
        intrinsics=strided_lens(frame.intrinsics, stride),
        human=None,
        valid=None,
    )
    view = DepthView.of(small, fixed.REFINE_POINTS, 2)
    u, v = np.round(project(view.lens, view.points)).astype(np.int64).T
    row, column = v * fixed.REFINE_TILES // len(gray), u * fixed.REFINE_TILES // len(gray)
    return GrayView(
        depth=view,
        gray=np.asarray(gray, np.float32),
        slope=np.stack([cv2.Sobel(gray, cv2.CV_32F, dx, 1 - dx, ksize=3) / 8 for dx in (1, 0)], axis=-1),
        points_gray=gray[v, u].astype(np.float64),
        tiles=2 * (row * gray.shape[1] + column) + (row + column) % 2,
    )


def scaled(T: Float64, factor: float) -> Float64:
    """A pose (4, 4) with scaled lengths."""
    T_scaled = T.copy()
    T_scaled[:3, 3] *= factor
    return T_scaled


def overlapping(
    views: Sequence[GrayView], poses: Sequence[Float64], among: Bool, is_free: Bool
) -> list[tuple[int, int]]:
    """Pairs (i, j) of views `among` (N,): the views j that see most of i's points."""
    chosen = np.flatnonzero(among).tolist()
    middles = np.array([transform_points(poses[i], np.median(views[i].depth.points, axis=0)[None])[0]
                        if len(views[i].depth.points) else np.full(3, np.inf) for i in chosen])  # fmt: skip
    pairs: list[tuple[int, int]] = []
    for number, i in enumerate(chosen):
        apart = np.linalg.norm(middles - middles[number], axis=1)
        near = [
            j for j in (chosen[k] for k in np.argsort(apart, kind="stable")) if j != i and (is_free[i] or is_free[j])
        ][: fixed.REFINE_ASKED]
        shares = np.array([_share(views[i], views[j], poses[i], poses[j]) for j in near])
        best = np.argsort(-shares, kind="stable")[: fixed.REFINE_NEIGHBOURS]
        pairs += [(i, near[k]) for k in best if shares[k] > fixed.REFINE_OVERLAP]
    return pairs


def _share(a: GrayView, b: GrayView, T_a: Float64, T_b: Float64) -> float:
    points = transform_points(invert_transform(T_b) @ T_a, a.depth.points[::8])
    lands, surface, _ = landed(points, b.depth)
    return (
        float(np.mean(lands & (np.abs(points[:, 2] - surface[:, 2]) < fixed.REFINE_FARTHEST[0])))
        if len(points)
        else 0.0
    )


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Weighted residuals (R,) [sigma], and derivatives (R, 12) by the motions of views a and b.

    by_own, by_other (R,): derivatives by log-depth of view a's point `own` and of view b's pixel `other`.
    """

    residuals: Float64
    by_twists: Float64
    own: Index
    by_own: Float64
    other: Index
    by_other: Float64


def rows_of(a: GrayView, b: GrayView, T: Float64, width: float) -> Rows:
    """Rows of view a's `is_solved` points on view b; T (4, 4) maps a to b."""
    number = np.flatnonzero(a.is_solved)
    points, lands, surface, normals, distance = hit_surface(a, b, T, a.is_solved)
    sigma = np.hypot(depth_sigma(points[:, 2]), depth_sigma(a.depth.points[number, 2]))
    lands &= np.abs(distance) < width * sigma
    number, points, normals, surface = number[lands], points[lands], normals[lands], surface[lands]
    own, sigma, distance = a.depth.points[number], sigma[lands], distance[lands]
    weight = (1 - np.square(distance / (width * sigma))) / sigma
    lens, z = b.depth.lens, points[:, 2]
    exact = project(lens, points)
    u, v = np.round(exact).astype(np.int64).T
    depth = Rows(
        residuals=distance * weight,
        by_twists=derive_by_twists(own, points, normals, T) * weight[:, None],
        own=number,
        by_own=np.einsum("ki,ki->k", normals @ T[:3, :3], own) * weight,  # a farther point moves along its ray
        other=v * b.gray.shape[1] + u,
        by_other=-np.einsum("ki,ki->k", normals, surface) * weight,
    )
    if width > fixed.REFINE_COLOR_FROM or len(own) < fixed.REFINE_FEWEST:
        return depth
    difference, slope = _gray_differences(a, b, number, exact)
    along = slope * [lens.fx, lens.fy] / z[:, None]
    gradient = np.column_stack([along, -np.einsum("ki,ki->k", along, points[:, :2]) / z])
    deviation = difference / fixed.REFINE_COLOR
    counts = np.abs(deviation) < fixed.REFINE_CUT
    weight = np.where(counts, 1 - np.square(deviation / fixed.REFINE_CUT), 0.0) / fixed.REFINE_COLOR
    return Rows(
        residuals=np.concatenate([depth.residuals, difference * weight]),
        by_twists=np.vstack([depth.by_twists, derive_by_twists(own, points, gradient, T) * weight[:, None]]),
        own=np.tile(depth.own, 2),
        by_own=np.concatenate([depth.by_own, np.einsum("ki,ki->k", gradient @ T[:3, :3], own) * weight]),
        other=np.tile(depth.other, 2),
        by_other=np.concatenate([depth.by_other, np.zeros(len(own))]),
    )


def hit_surface(
    a: GrayView, b: GrayView, T: Float64, which: slice | Bool = EVERY
) -> tuple[Float64, Bool, Float64, Float64, Float64]:
    """View a's points in view b's frame, hits, surface, normals and distances.

    T (4, 4) maps a to b. Arrays are (K, 3) or (K,). At hits, both surfaces face alike.
    """
    points = transform_points(T, a.depth.points[which])
    lands, surface, normals = landed(points, b.depth)
    lands &= np.einsum("ki,ki->k", a.depth.point_normals[which] @ T[:3, :3].T, normals) > fixed.REFINE_ALIKE
    return points, lands, surface, normals, np.asarray(np.einsum("ki,ki->k", points - surface, normals))


def misfits_of(a: GrayView, b: GrayView, T: Float64) -> tuple[Float64, Index]:
    """Squared differences (2, K) [sigma^2] of depth and grey value, and tiles (K,), of view a's judging points.

    T (4, 4) maps a to b. Differences are cut, and NaN without a common surface.
    """
    number = np.flatnonzero(~a.is_solved)
    points, lands, _, _, distance = hit_surface(a, b, T, ~a.is_solved)
    sigma = np.hypot(depth_sigma(points[:, 2]), depth_sigma(a.depth.points[number, 2]))
    widest = fixed.REFINE_WIDTHS[-1]
    misfits = np.full((2, len(number)), np.nan)
    misfits[0, lands] = np.minimum(np.square(distance / sigma), widest**2)[lands]
    lands &= np.abs(distance) < widest * sigma
    if lands.sum() >= fixed.REFINE_FEWEST:
        difference, _ = _gray_differences(a, b, number[lands], project(b.depth.lens, points[lands]))
        misfits[1, lands] = np.minimum(np.square(difference / fixed.REFINE_COLOR), fixed.REFINE_CUT**2)
    return misfits, a.tiles[number]


def _gray_differences(a: GrayView, b: GrayView, number: Index, pixels: Float64) -> tuple[Float64, Float64]:
    """Grey differences (K,) of view a's points `number` from view b, and b's slopes (K, 2).

    Both are taken at `pixels` (K, 2) of b.
    """
    u, v = np.round(pixels).astype(np.int64).T
    slope = b.slope[v, u].astype(np.float64)
    value = b.gray[v, u] + np.einsum("ki,ki->k", slope, pixels - np.stack([u, v], axis=1))
    return _alike(value, a.points_gray[number]), slope


def _alike(value: Float64, other: Float64) -> Float64:
    gain, offset = 1.0, float(np.median(value - other))
    for _ in range(2):
        near = np.abs(value - gain * other - offset) < fixed.REFINE_CUT * fixed.REFINE_COLOR
        if near.sum() < fixed.REFINE_FEWEST:
            break
        x, y = other[near] - other[near].mean(), value[near] - value[near].mean()
        gain = float(np.clip((x @ y) / max(x @ x, 1e-9), *fixed.REFINE_GAINS))
        offset = float(np.median(value[near] - gain * other[near]))
    return value - gain * other - offset


@dataclass(frozen=True, kw_only=True)
class BandRatios:
    """Median brightness ratios of shared surfaces, between bands of rows of N images.

    pairs (E, 2): bands, numbered ``B image + band``. ratios (E,): log of the first over the second.
    """

    num_images: int
    num_bands: int
    channels: Index
    pairs: Index
    ratios: Float64
    weights: Float64

    def gains(self, is_free: Bool) -> Float64:
        """Gains (N, B, 3) of red, green and blue, by least squares of logarithms.

        A wide prior keeps gains about 1; images not `is_free` (N,) have gain 1.
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
        return np.asarray(
            np.exp(np.linalg.solve(A, b[..., None])[..., 0].T).reshape(self.num_images, self.num_bands, 3)
        )

    def misfit(self, gains: Float64) -> float:
        """Median absolute residual of log ratios, for gains (N, B or 1, 3)."""
        logs = np.log(np.broadcast_to(gains, (self.num_images, self.num_bands, 3)).reshape(-1, 3))
        first, second = (logs[self.pairs[:, k], self.channels] for k in range(2))
        return float(np.median(np.abs(self.ratios - (first - second)))) if len(self.ratios) else 0.0


def exposure_gains(frames: Sequence[RgbdFrame], scale: float = 1.0, free: Bool | None = None) -> Float64:
    """Gains (N, 3) of red, green and blue; images divided by them match.

    scale: divides the recording's lengths. Views not `free` (N,) have gain 1.
    """
    is_free = np.ones(len(frames), np.bool_) if free is None else free
    return band_ratios(frames, scale, is_free, 1).gains(is_free)[:, 0]


def band_ratios(frames: Sequence[RgbdFrame], scale: float, is_free: Bool, num_bands: int) -> BandRatios:
    """Ratios of overlapping pairs with a free view, without nearly black and white pixels."""
    views = [gray_view(frame, scale) for frame in frames]
    poses = [scaled(frame.T_world_camera, 1 / scale) for frame in frames]
    colors = [_small(frame, view.gray.shape[0]) for frame, view in zip(frames, views, strict=True)]
    rows: list[tuple[int, int, int, float, float]] = []
    for i, j in overlapping(views, poses, np.ones(len(frames), np.bool_), is_free):
        points, lands, _, _, distance = hit_surface(views[i], views[j], invert_transform(poses[j]) @ poses[i])
        lands &= np.abs(distance) < fixed.EXPOSURE_NEAR * depth_sigma(points[:, 2])
        u, v = np.round(project(views[j].depth.lens, points[lands])).astype(np.int64).T
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
                    ratio = float(np.median(some))
                    spread = 1.4826 * float(np.median(np.abs(some - ratio)))
                    rows.append((channel, a, b, ratio, 1 / (fixed.EXPOSURE_ERROR**2 + spread**2 / len(some))))
    numbers, values = np.array([row[:3] for row in rows], np.int64), np.array([row[3:] for row in rows])
    numbers, values = numbers.reshape(-1, 3), values.reshape(-1, 2)
    return BandRatios(
        num_images=len(frames),
        num_bands=num_bands,
        channels=numbers[:, 0],
        pairs=numbers[:, 1:],
        ratios=values[:, 0],
        weights=values[:, 1],
    )


def exposed(frame: RgbdFrame, gain: Float64) -> RgbdFrame:
    """The frame with its colours divided by a gain (3,)."""
    table = np.clip(np.rint(np.arange(256)[:, None] / gain), 0, 255).astype(np.uint8)
    return replace(frame, color=np.stack([table[frame.color[..., k], k] for k in range(3)], axis=-1))


def _small(frame: RgbdFrame, rows: int) -> Float64:
    stride = -(-frame.color.shape[0] // rows)
    smooth = cv2.GaussianBlur(frame.color, (0, 0), fixed.EXPOSURE_BLUR * stride)
    return np.asarray(smooth[::stride, ::stride], np.float64)
