"""Joint refinement of view poses of a still scene, and of their depths' bends.

Gauss-Newton in float64, with Tukey's biweight, on point-to-plane distances and grey differences. Sources: Chen and
Medioni, Object modelling by registration, 1992; Park, Zhou and Koltun, Colored point cloud registration revisited,
2017.

A triangulating camera's disparity has a smooth, constant error, which bends surfaces. The error's part that is linear
in pixels (u, v) is not corrected, because poses absorb it. After Zhou and Koltun, Simultaneous localization and
calibration (2014); their lattice lies in space.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import null_space
from scipy.sparse import csr_array

from splatctrl_cli.calibration.evidence import FIXED, POSE, transform_of, twist_between
from splatctrl_cli.calibration.gray_views import (
    GrayView,
    Rows,
    gray_view,
    hit_surface,
    misfits_of,
    overlapping,
    rows_of,
    scaled,
)
from splatctrl_cli.calibration.views import surface_normals
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, project
from splatctrl_cli.records import Bool, Float64, Index, RgbdFrame


def stretch(depth: Float64, offset: Float64) -> tuple[Float64, Float64]:
    """Factor on depths (...) [m] for disparity offsets (...) [1/m], and its logarithm's derivative [m].

    Corrected depth z' has ``1 / z' = 1 / z - offset``. The offset is cut at `BEND_MOST` of the disparity.
    """
    share = offset * depth
    factor = 1 / (1 - np.clip(share, -fixed.BEND_MOST, fixed.BEND_MOST))
    return factor, np.where(np.abs(share) < fixed.BEND_MOST, factor * depth, 0.0)


def unbent(frame: RgbdFrame, grid: Float64) -> RgbdFrame:
    """The frame with disparity offsets (rows, columns) [1/m], interpolated bilinearly, removed from depth."""
    factor, _ = stretch(
        frame.depth.astype(np.float64), (_weights(frame.depth.shape) @ grid.ravel()).reshape(frame.depth.shape)
    )
    return replace(frame, depth=(frame.depth * factor).astype(np.float32))


def largest_share(grid: Float64, depth: float) -> float:
    """Largest correction, as a share of `depth` [m]."""
    return float(np.abs(stretch(np.full_like(grid, depth), grid)[0] - 1).max())


def _weights(shape: tuple[int, ...]) -> csr_array:
    rows, columns = fixed.BEND_GRID
    at = [np.arange(size) * (nodes - 1) / size for size, nodes in zip(shape, (rows, columns), strict=True)]
    low = [x.astype(np.int64) for x in at]
    part = [x - i for x, i in zip(at, low, strict=True)]
    values, nodes = [], []
    for down in (0, 1):
        for right in (0, 1):
            along_v, along_u = (part[k] if step else 1 - part[k] for k, step in enumerate((down, right)))
            values.append(np.outer(along_v, along_u).ravel())
            nodes.append(((low[0] + down)[:, None] * columns + low[1] + right).ravel())
    pixels = np.arange(shape[0] * shape[1])
    return csr_array(
        (np.stack(values, axis=1).ravel(), np.stack(nodes, axis=1).ravel(), 4 * np.arange(len(pixels) + 1)),
        shape=(len(pixels), rows * columns),
    )


def _roughness() -> Float64:
    rows, columns = fixed.BEND_GRID
    nodes = np.eye(rows * columns).reshape(rows, columns, -1)
    twist = nodes[1:, 1:] - nodes[1:, :-1] - nodes[:-1, 1:] + nodes[:-1, :-1]
    parts = (np.diff(nodes, 2, axis=0), np.diff(nodes, 2, axis=1), np.sqrt(2) * twist)
    D = np.concatenate([part.reshape(-1, rows * columns) for part in parts])
    return np.asarray(D.T @ D)


def bends_alone() -> Float64:
    """Orthonormal basis (G, G - 3) of grids orthogonal to 1, u and v."""
    v, u = np.indices(fixed.BEND_GRID).reshape(2, -1)
    return np.asarray(null_space(np.stack([np.ones(len(u)), u, v])))


@dataclass(kw_only=True)
class BentViews:
    """Views, and the bends (C, G) of their cameras to solve for.

    cameras (N,): number of each view's camera, or `FIXED` where depth stays as recorded. now: the views with the
    current bends removed.
    """

    recorded: Sequence[GrayView]
    cameras: Sequence[int]

    def __post_init__(self) -> None:
        self.now = list(self.recorded)
        self._weights = {shape: _weights(shape) for shape in {view.gray.shape for view in self.recorded}}
        self._pixels = [_pixels(view) for view in self.recorded]
        self._basis, self._num = bends_alone(), max(self.cameras) + 1
        self._prior = self._basis.T @ ((_roughness() + np.eye(len(self._basis))) / fixed.BEND_PRIOR**2) @ self._basis
        self._free = np.zeros((self._num, self._basis.shape[1]))
        self._bend()

    @property
    def grids(self) -> Float64:
        """Disparity offsets (C, rows, columns), per unit of the views' scaled lengths."""
        return (self._free @ self._basis.T).reshape(self._num, *fixed.BEND_GRID)

    def begin(self, size: int) -> None:
        """Begin a round with `size` pose unknowns, and equations of zeros."""
        num = self._num * len(self._basis)
        self._cross, self._own, self._slope = np.zeros((size, num)), np.zeros((num, num)), np.zeros(num)

    def add(self, i: int, j: int, rows: Rows, columns: Index, J: Float64) -> None:
        """Add view i's residuals on view j to the round's equations.

        J (R, F): derivatives by pose unknowns `columns`.
        """
        by_offsets = self.derive_by_offsets(i, j, rows)
        self._cross[columns] += (by_offsets.T @ J).T
        square = (by_offsets.T @ by_offsets).tocoo()
        self._own[square.row, square.col] += square.data
        self._slope[:] += by_offsets.T @ rows.residuals

    def derive_by_offsets(self, i: int, j: int, rows: Rows) -> csr_array:
        """Derivatives (R, C G) of view i's residuals on view j by disparity offsets."""
        size, parts = len(self._basis), []
        for k, pixels, by_stretch in ((i, self._pixels[i][rows.own], rows.by_own), (j, rows.other, rows.by_other)):
            if self.cameras[k] == FIXED:
                parts.append(csr_array((len(pixels), self._num * size)))
                continue
            weights = self._weights[self.recorded[k].gray.shape][pixels]
            values = weights.data * np.repeat(by_stretch * self._reach[k][pixels], 4)
            nodes = weights.indices + self.cameras[k] * size
            parts.append(csr_array((values, nodes, weights.indptr), shape=(len(pixels), self._num * size)))
        return parts[0] + parts[1]

    def joined(self, H: Float64, g: Float64, num_pairs: int) -> tuple[Float64, Float64]:
        """Pose equations H (P, P), g (P,), extended by the bends' free coordinates."""
        Q = np.kron(np.eye(self._num), self._basis)
        R = num_pairs * np.kron(np.eye(self._num), self._prior)
        cross = self._cross @ Q
        return np.block([[H, cross], [cross.T, Q.T @ self._own @ Q + R]]), np.concatenate(
            [g, Q.T @ self._slope + R @ self._free.ravel()]
        )

    def move(self, step: Float64) -> None:
        self._free += step.reshape(self._free.shape)
        self._bend()

    def _bend(self) -> None:
        grids, self._reach = self.grids, []
        for k, view in enumerate(self.recorded):
            if self.cameras[k] == FIXED:
                self._reach.append(np.zeros(0))
                continue
            offset = self._weights[view.gray.shape] @ grids[self.cameras[k]].ravel()
            depth, pixels = view.depth, self._pixels[k]
            factor, reach = stretch(depth.surface[..., 2].ravel(), offset)
            self._reach.append(reach)
            surface = depth.surface * factor.reshape(*view.gray.shape, 1)
            normals = surface_normals(surface, 2)
            normals[~np.any(depth.normals != 0, axis=-1)] = 0.0
            self.now[k] = replace(view, depth=replace(
                depth, surface=surface, normals=normals, points=surface.reshape(-1, 3)[pixels],
                point_normals=normals.reshape(-1, 3)[pixels],
            ))  # fmt: skip


def _pixels(view: GrayView) -> Index:
    u, v = np.round(project(view.depth.lens, view.depth.points)).astype(np.int64).T
    return np.asarray(v * view.gray.shape[1] + u)


@dataclass(frozen=True, kw_only=True)
class RefinedPoses:
    """Refined T_world_camera (4, 4); how far each moved [m] and turned [deg], (N,).

    before, after: median distance [m] between views' surfaces, at points that solved no pose. is_held (N,): kept as
    recorded, because no view overlaps or the pose moved too far. is_better: False if no pose changed.
    """

    T_world_camera: tuple[Float64, ...]
    moved: Float64
    turned: Float64
    before: float
    after: float
    is_held: Bool
    is_better: bool


def refined_poses(
    frames: Sequence[RgbdFrame], scale: float = 1.0, free: Bool | None = None, *, must_gain: bool = True
) -> RefinedPoses:
    """Refine the poses of `free` (N,) frames.

    scale: divides the recording's lengths. A wide prior anchors all poses. Frames that would move beyond
    `REFINE_FARTHEST` stay as recorded. With must_gain, so do frames whose judging points gain nothing.
    """
    views = [gray_view(frame, scale) for frame in frames]
    recorded = [scaled(frame.T_world_camera, 1 / scale) for frame in frames]
    is_movable = np.ones(len(views), np.bool_) if free is None else free
    is_held, stays = np.zeros((2, len(views)), np.bool_)
    while True:
        pairs = overlapping(views, recorded, ~is_held, is_movable & ~is_held)
        is_held |= is_movable & (np.bincount(np.ravel(pairs).astype(np.int64), minlength=len(views)) == 0)
        is_free = is_movable & ~is_held & ~stays
        poses = _solved(views, recorded, pairs, is_free)
        twists = np.array([twist_between(a, b) for a, b in zip(recorded, poses, strict=True)]).reshape(-1, POSE)
        moved, turned = np.linalg.norm(twists[:, 3:], axis=1), np.degrees(np.linalg.norm(twists[:, :3], axis=1))
        is_far = (moved > fixed.REFINE_FARTHEST[0]) | (turned > fixed.REFINE_FARTHEST[1])
        if is_far.any():
            is_held |= is_far
            continue
        gains_nothing = is_free & ~_gains(views, recorded, poses, pairs)
        if not (must_gain and gains_nothing.any()):
            break
        stays |= gains_nothing
    before, after = (_distance(views, T, pairs) for T in (recorded, poses))
    return RefinedPoses(
        T_world_camera=tuple(scaled(T, scale) if f else frame.T_world_camera
                             for T, f, frame in zip(poses, is_free, frames, strict=True)),
        moved=scale * moved,
        turned=turned,
        before=scale * before,
        after=scale * after,
        is_held=is_held,
        is_better=bool(is_free.any()),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FoundBends:
    """Disparity offsets (rows, columns) [1/m] by camera, where observable.

    gains: shares by which each half's bends reduce the other half's distances. unlike: cameras whose halves disagree.
    """

    grids: Mapping[str, Float64] = field(default_factory=dict)
    gains: tuple[float, ...] = ()
    unlike: tuple[str, ...] = ()


def depth_bends(frames: Sequence[RgbdFrame], refined: RefinedPoses, scale: float = 1.0) -> FoundBends:
    """The bends of the cameras' depths, solved jointly with poses from `refined`.

    Each half (every second view) of a camera's views must give bends that reduce the other half's distances by
    `BEND_GAIN`, compared with poses only. Cameras need `BEND_VIEWS` views, and a cosine of `BEND_ALIKE` between the
    halves' bends.
    """
    views = [replace(f, T_world_camera=T) for f, T in zip(frames, refined.T_world_camera, strict=True)]
    views = [view for view, is_held in zip(views, refined.is_held, strict=True) if not is_held]
    names = [view.camera for view in views]
    rank = np.array([names[:k].count(name) for k, name in enumerate(names)])
    chosen = [name for name in dict.fromkeys(names) if names.count(name) >= fixed.BEND_VIEWS]
    if not chosen or refined.after < fixed.BEND_FROM * fixed.SCALE_DEPTH * scale:
        return FoundBends()
    halves = [[view for view, of_half in zip(views, rank % 2 == k, strict=True) if of_half] for k in (0, 1)]
    bends = [_joint(half, chosen, scale) for half in halves]
    both = {name: (bends[0][name], bends[1][name]) for name in chosen}
    alike = {
        name: float(np.vdot(a, b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))
        for name, (a, b) in both.items()
    }
    unlike = tuple(name for name in chosen if alike[name] < fixed.BEND_ALIKE)
    chosen = [name for name in chosen if name not in unlike]
    if not chosen:
        return FoundBends(unlike=unlike)
    gains = []
    for half, grids in zip(halves, reversed(bends), strict=True):
        without, with_ = (
            refined_poses(part, scale, must_gain=False).after
            for part in (half, freed(half, {name: grids[name] for name in chosen}))
        )
        gains.append(1 - with_ / without if without else 0.0)
    is_told = min(gains) > fixed.BEND_GAIN
    return FoundBends(grids=_joint(views, chosen, scale) if is_told else {}, gains=tuple(gains), unlike=unlike)


def freed(frames: Sequence[RgbdFrame], grids: Mapping[str, Float64]) -> list[RgbdFrame]:
    return [unbent(frame, grids[frame.camera]) if frame.camera in grids else frame for frame in frames]


def _joint(frames: Sequence[RgbdFrame], cameras: Sequence[str], scale: float) -> dict[str, Float64]:
    views = [gray_view(frame, scale) for frame in frames]
    poses = [scaled(frame.T_world_camera, 1 / scale) for frame in frames]
    every = np.ones(len(views), np.bool_)
    bends = BentViews(
        recorded=views,
        cameras=[cameras.index(frame.camera) if frame.camera in cameras else FIXED for frame in frames],
    )
    _solved(views, poses, overlapping(views, poses, every, every), every, bends)
    return dict(zip(cameras, np.round(bends.grids / scale, 7), strict=True))


def _solved(
    views: Sequence[GrayView],
    recorded: Sequence[Float64],
    pairs: Sequence[tuple[int, int]],
    is_free: Bool,
    bends: BentViews | None = None,
) -> list[Float64]:
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
        now = views
        if bends is not None:
            bends.begin(size)
            now = bends.now
        for i, j in pairs:
            if not (is_free[i] or is_free[j]):
                continue
            rows = rows_of(now[i], now[j], invert_transform(poses[j]) @ poses[i], width)
            own, other = (POSE * column[k] + np.arange(POSE) for k in (i, j))
            keep = np.repeat([is_free[i], is_free[j]], POSE)
            columns, J = np.concatenate([own, other])[keep], rows.by_twists[:, keep]
            H[np.ix_(columns, columns)] += J.T @ J
            g[columns] += J.T @ rows.residuals
            if bends is not None:
                bends.add(i, j, rows, columns, J)
        if bends is not None:
            H, g = bends.joined(H, g, len(pairs))
        step = -np.asarray(np.linalg.solve(H, g), np.float64)
        for k, i in enumerate(free):
            poses[i] = poses[i] @ transform_of(step[POSE * k : POSE * (k + 1)])
        if bends is not None:
            bends.move(step[size:])
        if number >= len(fixed.REFINE_WIDTHS) and np.abs(step[:size]).max() < fixed.REFINE_STILL:
            break
    return poses


def _gains(
    views: Sequence[GrayView], before: Sequence[Float64], after: Sequence[Float64], pairs: Sequence[tuple[int, int]]
) -> Bool:
    """Views (N,) whose judging points agree better with other views at poses `after`.

    Wrong poses may reduce distances. Grey values must agree better beyond their noise, or no worse if distances fall
    by `REFINE_GAIN`.
    """
    parts: list[list[Float64]] = [[np.zeros((5, 0))] for _ in views]
    for i, j in pairs:
        (at_first, tiles), (at_last, _) = (
            misfits_of(views[i], views[j], invert_transform(poses[j]) @ poses[i]) for poses in (before, after)
        )
        rows = np.vstack([at_first, at_last, tiles + views[i].gray.size * 2 * i])
        for k in (i, j):
            parts[k].append(rows)
    return np.array([_agrees_better(*np.hstack(part)) for part in parts])


def _agrees_better(
    depth_before: Float64, gray_before: Float64, depth_after: Float64, gray_after: Float64, tiles: Float64
) -> bool:
    depth, depth_sure = _gain(depth_before, depth_after, tiles)
    gray, gray_sure = _gain(gray_before, gray_after, tiles)
    if gray_sure > fixed.REFINE_SURE:
        return depth_sure > -fixed.REFINE_SURE
    return gray >= 0 and depth_sure > fixed.REFINE_SURE and depth > fixed.REFINE_GAIN


def _gain(before: Float64, after: Float64, tiles: Float64) -> tuple[float, float]:
    """Share by which misfits (K,) fall, and the fall's ratio to its standard error over tiles.

    Both are 0 without common points.
    """
    is_known = np.isfinite(before) & np.isfinite(after)
    gain, of_tile = (before - after)[is_known], np.unique(tiles[is_known], return_inverse=True)[1]
    if not gain.any():
        return 0.0, 0.0
    sums, counts = np.bincount(of_tile, gain), np.bincount(of_tile)
    error = np.sqrt(np.square(sums - counts * gain.mean()).sum())
    return float(gain.sum() / before[is_known].sum()), float(gain.sum() / max(error, 1e-12))


def _distance(views: Sequence[GrayView], poses: Sequence[Float64], pairs: Sequence[tuple[int, int]]) -> float:
    distances = [np.zeros(0)]
    for i, j in pairs:
        _, lands, _, _, distance = hit_surface(
            views[i], views[j], invert_transform(poses[j]) @ poses[i], ~views[i].is_solved
        )
        distances.append(np.minimum(np.abs(distance[lands]), fixed.REFINE_FARTHEST[0]))
    every = np.concatenate(distances)
    return float(np.median(every)) if len(every) else 0.0
