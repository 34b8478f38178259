"""Consistency of a recording: cameras agree on surfaces, poses form a path."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf

import numpy as np

from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, project, transform_points
from splatctrl_cli.records import Float64, RgbdFrame, spread
from splatctrl_cli.scene.seeding import world_points


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Median and lower quartile of |dz| [m], how far two cameras disagree on depth.

    depth [m]: median of their common surfaces. detour [m]: least sum of two medians by way of a third camera.
    """

    cameras: tuple[str, str]
    median: float
    quartile: float
    depth: float
    num_pixels: int
    detour: float = inf

    @property
    def limit(self) -> float:
        """Largest median of good cameras [m]: 3 cm, or 3 % of depth beyond 1 m.

        Each may be off by 2 %, independently.
        """
        return fixed.PAIR_LIMIT * max(1.0, self.depth)

    @property
    def holds(self) -> bool:
        """False if median and detour exceed `limit`, and the quartile exceeds half of `limit`."""
        return min(self.median, self.detour) <= self.limit or self.quartile <= 0.5 * self.limit


CAUSES = "poses are off, or too little depth is left (short range, clip, holes) to see the same sides of objects"
"""Causes of views that disagree; depth does not show which one applies."""


def agreements(frames: Sequence[RgbdFrame], min_range: float, max_range: float) -> list[Agreement]:
    """Agreement of camera pairs with enough common pixels.

    frames: of one time, or a still scene. Views of one camera are paired, too. Depth counts from `min_range` to
    `max_range` [m].
    """
    chosen = spread(list(combinations(range(len(frames)), 2)), fixed.PAIR_MOST)
    by_pair: dict[tuple[str, str], list[Float64]] = {}
    for i, j in chosen:
        a, b = sorted((frames[i], frames[j]), key=lambda frame: frame.camera)
        both = [differences(a, b, min_range, max_range), differences(b, a, min_range, max_range)]
        by_pair.setdefault((a.camera, b.camera), []).extend(both)
    rows = {cameras: np.concatenate(parts) for cameras, parts in sorted(by_pair.items())}
    pairs = [_agreement(cameras, row) for cameras, row in rows.items() if len(row) >= fixed.PAIR_MIN_PIXELS]
    return [replace(pair, detour=_detour(pair.cameras, pairs)) for pair in pairs]


def _detour(ends: tuple[str, str], pairs: Sequence[Agreement]) -> float:
    medians = {frozenset(pair.cameras): pair.median for pair in pairs}
    others = {camera for pair in pairs for camera in pair.cameras} - {*ends}
    return min((sum(medians.get(frozenset({end, other}), inf) for end in ends) for other in others), default=inf)


def _agreement(cameras: tuple[str, str], rows: Float64) -> Agreement:
    quartile, median = np.percentile(rows[:, 0], [25, 50])
    return Agreement(
        cameras=cameras,
        median=float(median),
        quartile=float(quartile),
        depth=float(np.median(rows[:, 1])),
        num_pixels=len(rows),
    )


def differences(a: RgbdFrame, b: RgbdFrame, min_range: float, max_range: float) -> Float64:
    """Columns |dz| and b's depth (K, 2) [m], at view a's points projected into view b.

    Points with |dz| over `PAIR_SAME_SURFACE` do not count.
    """
    stride = max(1, a.intrinsics.height // fixed.PAIR_ROWS)
    is_used = np.zeros(a.depth.shape, bool)
    is_used[::stride, ::stride] = True
    is_used &= (a.depth >= min_range) & (a.depth <= max_range)
    points = transform_points(invert_transform(b.T_world_camera), world_points(a, is_used))
    points = points[points[:, 2] > 0]
    pixels = np.floor(project(b.intrinsics, points) + 0.5)
    is_inside = np.all((pixels >= 0) & (pixels < [b.intrinsics.width, b.intrinsics.height]), axis=1)
    u, v = pixels[is_inside].astype(np.int64).T
    measured = b.depth[v, u].astype(np.float64)
    offset = np.abs(points[is_inside, 2] - measured)
    is_same = (measured >= min_range) & (measured <= max_range) & (offset <= fixed.PAIR_SAME_SURFACE)
    return np.stack([offset[is_same], measured[is_same]], axis=1)


@dataclass(frozen=True, kw_only=True)
class PoseJump:
    """A camera that moves `distance` [m] between two frames."""

    camera: str
    distance: float
    before_ns: int
    after_ns: int


def largest_jump(poses: Iterable[tuple[int, str, Float64]]) -> PoseJump | None:
    """Longest move of a camera between frames at most a second apart; None without frames.

    poses: stamp [ns], camera and T_world_camera, in order of stamp.
    """
    last: dict[str, tuple[int, Float64]] = {}
    largest: PoseJump | None = None
    for stamp_ns, camera, T_world_camera in poses:
        before_ns, position = last.get(camera, (stamp_ns, T_world_camera[:3, 3]))
        distance = float(np.linalg.norm(T_world_camera[:3, 3] - position))
        if stamp_ns - before_ns <= fixed.PAIR_CLOSE_NS and (largest is None or distance > largest.distance):
            largest = PoseJump(camera=camera, distance=distance, before_ns=before_ns, after_ns=stamp_ns)
        last[camera] = (stamp_ns, T_world_camera[:3, 3])
    return largest
