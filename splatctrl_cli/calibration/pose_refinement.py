"""The poses of views of a still scene and the bends of their depths, put right by what the views see of each other.

Gauss-Newton on all views at once, in float64, of depth and colour together: distances of the points of one view
from the surface of another (Chen and Medioni, Object modelling by registration, 1992), and differences of their
grey values (Park, Zhou and Koltun, Colored point cloud registration revisited, 2017), each weighed by Tukey's
biweight.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatctrl_cli.calibration.depth_bend import BentViews, unbent
from splatctrl_cli.calibration.gray_views import GrayView, gray_view, on_surface, overlapping, rows_of, scaled
from splatctrl_cli.calibration.unknowns import HELD, POSE, transform_of, twist_between
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Bool, Float64, RgbdFrame


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


@dataclass(frozen=True, kw_only=True)
class FoundBends:
    """By camera, the bend of its depth, offsets of disparity (rows, columns) [1/m]; none where it does not tell.

    gains: by how much, as shares, the bend that each half of the views tells brings the other half together. unlike:
    the cameras of which the halves tell different ones.
    """

    grids: Mapping[str, Float64] = field(default_factory=dict)
    gains: tuple[float, ...] = ()
    unlike: tuple[str, ...] = ()


def depth_bends(frames: Sequence[RgbdFrame], refined: RefinedPoses, scale: float = 1.0) -> FoundBends:
    """The bends of the cameras' depths, solved for with the poses, once these are `refined`.

    A bend counts where it also holds for views that it was not found from: every second view of a camera tells one,
    and the others must lie nearer each other by `BEND_GAIN` with it than with poses alone; and the other way round.
    Cameras of fewer than `BEND_VIEWS` views, and those of which the halves tell bends less alike than `BEND_ALIKE`,
    have none.
    """
    views = [replace(f, T_world_camera=T) for f, T in zip(frames, refined.T_world_camera, strict=True)]
    views = [view for view, held in zip(views, refined.is_held, strict=True) if not held]
    names = [view.camera for view in views]
    rank = np.array([names[:k].count(name) for k, name in enumerate(names)])
    chosen = [name for name in dict.fromkeys(names) if names.count(name) >= fixed.BEND_VIEWS]
    if not chosen or refined.after < fixed.BEND_FROM * fixed.SCALE_DEPTH * scale:
        return FoundBends()
    halves = [[view for view, of_half in zip(views, rank % 2 == k, strict=True) if of_half] for k in (0, 1)]
    told = [_joint(half, chosen, scale) for half in halves]
    alike = {name: _likeness(told[0][name], told[1][name]) for name in chosen}
    unlike = tuple(name for name in chosen if alike[name] < fixed.BEND_ALIKE)
    chosen = [name for name in chosen if name not in unlike]
    if not chosen:
        return FoundBends(unlike=unlike)
    gains = []
    for half, grids in zip(halves, reversed(told), strict=True):
        kept = {name: grids[name] for name in chosen}
        without, with_ = (refined_poses(part, scale).after for part in (half, freed(half, kept)))
        gains.append(1 - with_ / without if without else 0.0)
    is_told = min(gains) > fixed.BEND_GAIN
    return FoundBends(grids=_joint(views, chosen, scale) if is_told else {}, gains=tuple(gains), unlike=unlike)


def freed(frames: Sequence[RgbdFrame], grids: Mapping[str, Float64]) -> list[RgbdFrame]:
    """The frames, their depth freed of the bends of their cameras, where there is one."""
    return [unbent(frame, grids[frame.camera]) if frame.camera in grids else frame for frame in frames]


def _joint(frames: Sequence[RgbdFrame], cameras: Sequence[str], scale: float) -> dict[str, Float64]:
    """The bends (rows, columns) [1/m] of some cameras, with the poses of all frames solved for at once."""
    views = [gray_view(frame, scale) for frame in frames]
    poses = [scaled(frame.T_world_camera, 1 / scale) for frame in frames]
    every = np.ones(len(views), np.bool_)
    numbers = [cameras.index(frame.camera) if frame.camera in cameras else HELD for frame in frames]
    bends = BentViews(recorded=views, cameras=numbers)
    _solved(views, poses, overlapping(views, poses, every, every), every, bends)
    return dict(zip(cameras, np.round(bends.grids / scale, 7), strict=True))


def _likeness(a: Float64, b: Float64) -> float:
    """The cosine between two grids."""
    return float(np.vdot(a, b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))


def _solved(
    views: Sequence[GrayView],
    recorded: Sequence[Float64],
    pairs: Sequence[tuple[int, int]],
    is_free: Bool,
    bends: BentViews | None = None,
) -> list[Float64]:
    """The poses after rounds in which the residuals that count get smaller; of the views freed of `bends`, which are
    solved with them.
    """
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
        bent = None if bends is None else bends.equations(size, len(pairs))
        now = views if bends is None else bends.now
        for i, j in pairs:
            rows = rows_of(now[i], now[j], invert_transform(poses[j]) @ poses[i], width)
            own, other = (POSE * column[k] + np.arange(POSE) for k in (i, j))
            keep = np.repeat([is_free[i], is_free[j]], POSE)
            columns, J = np.concatenate([own, other])[keep], rows.by_twists[:, keep]
            H[np.ix_(columns, columns)] += J.T @ J
            g[columns] += J.T @ rows.residuals
            if bent is not None:
                bent.add(i, j, rows, columns, J)
        if bent is not None:
            H, g = bent.joined(H, g)
        step = -np.asarray(np.linalg.solve(H, g), np.float64)
        for k, i in enumerate(free):
            poses[i] = poses[i] @ transform_of(step[POSE * k : POSE * (k + 1)])
        if bends is not None:
            bends.move(step[size:])
        if number >= len(fixed.REFINE_WIDTHS) and np.abs(step[:size]).max() < fixed.REFINE_STILL:
            break
    return poses


def _distances(
    views: Sequence[GrayView], poses: Sequence[Float64], pairs: Sequence[tuple[int, int]], *, odd: bool
) -> float:
    """The median distance of points from the surfaces of other views: those that `rows_of` leaves out where `odd`."""
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
