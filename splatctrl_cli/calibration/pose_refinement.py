"""The poses of views of a still scene, put right by what the views see of each other: depth and colour together.

Gauss-Newton on all views at once, in float64: distances of the points of one view from the surface of another (Chen
and Medioni, Object modelling by registration, 1992), and differences of their grey values (Park, Zhou and Koltun,
Colored point cloud registration revisited, 2017), each weighed by Tukey's biweight.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from splatctrl_cli.calibration.unknowns import POSE, transform_of, twist_between
from splatctrl_cli.calibration.views import DepthView, by_twists, depth_sigma, landed
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, project, strided_lens, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame

EVERY = slice(None)


@dataclass(frozen=True, kw_only=True)
class GrayView:
    """A view whose lengths are divided by the recording's scale: grey values (h, w) in [0, 1], their slope (h, w, 2)
    by pixel, and the grey values of the view's points (K,).
    """

    depth: DepthView
    gray: Float32
    slope: Float32
    points_gray: Float64


@dataclass(frozen=True, kw_only=True)
class RefinedPoses:
    """T_world_camera (4, 4) of each frame, put right; moved [m] and turned [deg], by how much each was (N,).

    before, after: the median distance [m] of the views' points from each other's surfaces, of points that were not
    used.

    is_held (N,): frames that stay as they were, since nothing ties them to another view or they would move too far.
    is_better: False where the poses stay as they were since their change would gain nothing.
    """

    T_world_camera: tuple[Float64, ...]
    moved: Float64
    turned: Float64
    before: float
    after: float
    is_held: Bool
    is_better: bool


def refined_poses(frames: Sequence[RgbdFrame], scale: float = 1.0, free: Bool | None = None) -> RefinedPoses:
    """Put the poses of the frames right; those that are not `free` (N,) stay. scale: of the recording's lengths.

    A wide prior keeps the views, as a whole, where they were recorded. What moves by more than `REFINE_FARTHEST` is
    held where it was.
    """
    views = [gray_view(frame, scale) for frame in frames]
    recorded = [scaled(frame.T_world_camera, 1 / scale) for frame in frames]
    wanted = np.ones(len(views), np.bool_) if free is None else free.copy()
    is_free = wanted.copy()
    while True:
        pairs = overlapping(views, recorded, is_free | ~wanted, is_free)
        is_free &= np.bincount(np.ravel(pairs).astype(np.int64), minlength=len(views)) > 0
        poses = _solved(views, recorded, pairs, is_free)
        moved, turned = _motions(recorded, poses)
        is_far = (moved > fixed.REFINE_FARTHEST[0]) | (turned > fixed.REFINE_FARTHEST[1])
        if not is_far.any():
            break
        is_free &= ~is_far
    before, after = (_distances(views, T, pairs, odd=True) for T in (recorded, poses))
    is_better = after < (1 - fixed.REFINE_GAIN) * before
    if not is_better:
        poses, moved, turned, after = recorded, 0.0 * moved, 0.0 * turned, before
    return RefinedPoses(
        T_world_camera=tuple(scaled(T, scale) if f else frame.T_world_camera
                             for T, f, frame in zip(poses, is_free & is_better, frames, strict=True)),
        moved=scale * moved,
        turned=turned,
        before=scale * before,
        after=scale * after,
        is_held=wanted & ~is_free,
        is_better=is_better,
    )  # fmt: skip


def gray_view(frame: RgbdFrame, scale: float) -> GrayView:
    """The view of a frame at no more than about `REFINE_ROWS` rows."""
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
    slope = np.stack([cv2.Sobel(gray, cv2.CV_32F, dx, 1 - dx, ksize=3) / 8 for dx in (1, 0)], axis=-1)
    u, v = np.round(project(view.lens, view.points)).astype(np.int64).T
    return GrayView(
        depth=view, gray=np.asarray(gray, np.float32), slope=slope, points_gray=gray[v, u].astype(np.float64)
    )


def scaled(T: Float64, factor: float) -> Float64:
    """A pose (4, 4) whose lengths are multiplied."""
    there = T.copy()
    there[:3, 3] *= factor
    return there


def overlapping(
    views: Sequence[GrayView], poses: Sequence[Float64], among: Bool, is_free: Bool
) -> list[tuple[int, int]]:
    """Of each view among those that take part, those others that see most of its points; one of the two is free."""
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
    """Of some points of view a, how many land near the surface of view b."""
    points = transform_points(invert_transform(T_b) @ T_a, a.depth.points[::8])
    lands, surface, _ = landed(points, b.depth)
    return (
        float(np.mean(lands & (np.abs(points[:, 2] - surface[:, 2]) < fixed.REFINE_FARTHEST[0])))
        if len(points)
        else 0.0
    )


def _solved(
    views: Sequence[GrayView], recorded: Sequence[Float64], pairs: Sequence[tuple[int, int]], is_free: Bool
) -> list[Float64]:
    """The poses after rounds in which the residuals that count get smaller."""
    poses, column = list(recorded), np.cumsum(is_free) - 1
    size = POSE * int(is_free.sum())
    prior = np.tile(np.repeat(1 / np.square(fixed.REFINE_PRIOR), 3), int(is_free.sum()))
    free = np.flatnonzero(is_free).tolist()
    for number in range(len(fixed.REFINE_WIDTHS) + fixed.REFINE_ROUNDS if size else 0):
        width = fixed.REFINE_WIDTHS[min(number, len(fixed.REFINE_WIDTHS) - 1)]
        H, g = np.diag(prior), np.zeros(size)
        for k, i in enumerate(free):
            g[POSE * k : POSE * (k + 1)] = twist_between(recorded[i], poses[i])
        g *= prior
        for i, j in pairs:
            J, r = _rows(views[i], views[j], invert_transform(poses[j]) @ poses[i], width)
            own, other = (POSE * column[k] + np.arange(POSE) for k in (i, j))
            keep = np.repeat([is_free[i], is_free[j]], POSE)
            columns, J = np.concatenate([own, other])[keep], J[:, keep]
            H[np.ix_(columns, columns)] += J.T @ J
            g[columns] += J.T @ r
        step = -np.linalg.solve(H, g).reshape(-1, POSE)
        for k, i in enumerate(free):
            poses[i] = poses[i] @ transform_of(step[k])
        if number >= len(fixed.REFINE_WIDTHS) and np.abs(step).max() < fixed.REFINE_STILL:
            break
    return poses


def _rows(a: GrayView, b: GrayView, T: Float64, width: float) -> tuple[Float64, Float64]:
    """Derivatives (R, 12) by a turn and move of view a and of view b, and residuals (R,), in sigmas and weighed, of
    every second point of view a that lands on view b, at T (4, 4) from there.
    """
    points = a.depth.points[::2]
    there, lands, surface, normals, distance = on_surface(a, b, T, slice(None, None, 2))
    sigma = np.hypot(depth_sigma(there[:, 2]), depth_sigma(points[:, 2]))
    lands &= np.abs(distance) < width * sigma
    own, there, normals, surface = points[lands], there[lands], normals[lands], surface[lands]
    sigma, distance = sigma[lands], distance[lands]
    weight = (1 - np.square(distance / (width * sigma))) / sigma
    J, r = by_twists(own, there, normals, T) * weight[:, None], distance * weight
    if width > fixed.REFINE_COLOR_FROM or len(own) < fixed.REFINE_FEWEST:
        return J, r
    z = there[:, 2]
    exact = project(b.depth.lens, there)
    u, v = np.round(exact).astype(np.int64).T
    slope = b.slope[v, u].astype(np.float64)
    value = b.gray[v, u] + np.einsum("ki,ki->k", slope, exact - np.stack([u, v], axis=1))
    difference = _alike(value, a.points_gray[::2][lands])
    lens = b.depth.lens
    along = slope * [lens.fx, lens.fy] / z[:, None]
    gradient = np.column_stack([along, -np.einsum("ki,ki->k", along, there[:, :2]) / z])
    deviation = difference / fixed.REFINE_COLOR
    counts = np.abs(deviation) < fixed.REFINE_CUT
    weight = np.where(counts, 1 - np.square(deviation / fixed.REFINE_CUT), 0.0) / fixed.REFINE_COLOR
    return (
        np.vstack([J, by_twists(own, there, gradient, T) * weight[:, None]]),
        np.concatenate([r, difference * weight]),
    )


def on_surface(
    a: GrayView, b: GrayView, T: Float64, which: slice = EVERY
) -> tuple[Float64, Bool, Float64, Float64, Float64]:
    """Of some points of view a, at T (4, 4) from view b: where they are there (K, 3), which of them land on a surface
    that faces as theirs (K,), its points and normals (K, 3), and their distances (K,) from it.
    """
    there = transform_points(T, a.depth.points[which])
    lands, surface, normals = landed(there, b.depth)
    lands &= np.einsum("ki,ki->k", a.depth.point_normals[which] @ T[:3, :3].T, normals) > fixed.REFINE_ALIKE
    return there, lands, surface, normals, np.asarray(np.einsum("ki,ki->k", there - surface, normals))


def _alike(value: Float64, other: Float64) -> Float64:
    """Differences (K,) of grey values, less a gain and an offset between the two images, found robustly."""
    gain, offset = 1.0, float(np.median(value - other))
    for _ in range(2):
        near = np.abs(value - gain * other - offset) < fixed.REFINE_CUT * fixed.REFINE_COLOR
        if near.sum() < fixed.REFINE_FEWEST:
            break
        x, y = other[near] - other[near].mean(), value[near] - value[near].mean()
        gain = float(np.clip((x @ y) / max(x @ x, 1e-9), *fixed.REFINE_GAINS))
        offset = float(np.median(value[near] - gain * other[near]))
    return value - gain * other - offset


def _distances(
    views: Sequence[GrayView], poses: Sequence[Float64], pairs: Sequence[tuple[int, int]], *, odd: bool
) -> float:
    """The median distance of points from the surfaces of other views: those that `_rows` leaves out where `odd`."""
    found = [np.zeros(0)]
    for i, j in pairs:
        T = invert_transform(poses[j]) @ poses[i]
        _, lands, _, _, distance = on_surface(views[i], views[j], T, slice(int(odd), None, 2))
        found.append(np.minimum(np.abs(distance[lands]), fixed.REFINE_FARTHEST[0]))
    every = np.concatenate(found)
    return float(np.median(every)) if len(every) else 0.0


def _motions(before: Sequence[Float64], after: Sequence[Float64]) -> tuple[Float64, Float64]:
    """How far [m] and by what angle [deg] each pose (4, 4) was moved (N,)."""
    twists = np.array([twist_between(a, b) for a, b in zip(before, after, strict=True)]).reshape(-1, POSE)
    return np.linalg.norm(twists[:, 3:], axis=1), np.degrees(np.linalg.norm(twists[:, :3], axis=1))
