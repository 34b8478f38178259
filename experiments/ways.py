"""Where a planner may go in our map, the safest first: through space that cameras saw, then through any that is away
from surfaces, then through any; in each with the margin asked for, and where that leaves no way with less; at last
past thinner things.

Q points, world frame, metres. A distance is a lower bound of a 1-Lipschitz one, so that what a planner proves of an
edge holds of it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from experiments.problems import Problem
from splatctrl_cli import Config
from splatctrl_cli.blocks import (
    HALF_DIAGONAL,
    ROUNDING,
    START_ROOM,
    Bool,
    Certified,
    DistanceFunction,
    DistanceGrid,
    Float32,
    Float64,
    GridField,
    HasDistance,
    OccupancyGrid,
    Planes,
    SphereField,
    Spheres,
    VoxelState,
    resampled,
)

UNSEEN_NEAR = 0.08  # [m] about the arm at its start, which it hides, and at the goal, which it is given
START_GAP = 2e-3  # [m] that an obstacle of the map is from the arm at its start, or it is the arm's own
BEHIND = 0.06  # [m] from a surface of the map, within which unseen space is likely the rest of the thing
SHARES = (1.0, 0.4)  # of the margin asked for
THIN = 0.008  # [m] radius of balls where nothing else leaves a way: surface is in their middle
LEAST_SHARE = 0.15  # of the margin, at the very last
SAMPLES = 0.05  # [rad] between postures at which the space is counted that a motion comes to
ENDS_ROOM = 2 * START_ROOM + 1e-4  # [m] more than the margin, which a start or a goal has to keep


@dataclass(frozen=True, kw_only=True)
class Way:
    """A scene to plan in with a margin [m]. in_known_space: it avoids never-seen space; None if the method cannot
    tell that from free space. unseen_on: never-seen volume [m^3] on a motion (T, J), if not avoided.
    """

    scene: HasDistance
    margin: float
    in_known_space: bool | None = None
    unseen_on: Callable[[Float64], float] | None = None


Ways = Callable[[], Iterator[Way]]


def plain_ways(scene: HasDistance, config: Config) -> Iterator[Way]:
    """Ways of a map that cannot tell unseen from free space; only their margins differ."""
    return (Way(scene=scene, margin=share * config.control.margin) for share in (*SHARES, LEAST_SHARE))


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """A planner's surroundings: balls, centers (N, 3) and radii (N,) float32 [m], for objects, from num_known on for
    lost edges; and the occupancy grid.
    """

    problem: Problem
    centers: Float32
    radii: Float32
    num_known: int
    grid: OccupancyGrid
    config: Config
    threads: int = 1

    def ways(self) -> Iterator[Way]:
        """Ways, the safest first; each distance is computed when needed."""
        margin = self.config.control.margin
        things = [self.things(share * margin) for share in SHARES]
        for unseen, is_known in ((self.unseen, True), (self.unseen_behind, False)):
            if unseen is not None:
                for share, thing in zip(SHARES, things, strict=True):
                    scene = Certified(distance=_least_of(thing, unseen))
                    yield self._way(scene, share * margin, is_known)
        for share, is_thin in ((SHARES[0], False), (SHARES[1], False), (SHARES[1], True), (LEAST_SHARE, True)):
            scene = Certified(distance=self.things(share * margin, is_thin=is_thin))
            yield self._way(scene, share * margin, self.unseen is None)

    def _way(self, scene: Certified, margin: float, is_known: bool) -> Way:
        unseen_on = None if is_known else self.unseen_on
        return Way(scene=scene, margin=margin, in_known_space=is_known, unseen_on=unseen_on)

    def unseen_on(self, position: Float64) -> float:
        """Never-seen volume [m^3] that the arm sweeps in a motion (T, J), without its volume at start and goal. It
        counts voxels, to half of a voxel.
        """
        ends = self._reached(np.stack([self.problem.start, self.problem.goal]))
        is_new = self._reached(resampled(position, SAMPLES)) & self._never_seen & ~ends
        return float(np.sum(is_new)) * self.grid.voxel**3

    def _reached(self, postures: Float64) -> Bool:
        """Voxels (X, Y, Z) that the arm's moving spheres occupy in any of postures (K, J)."""
        model, grid = self.problem.model, self.grid
        is_reached = np.zeros(self._never_seen.shape, dtype=np.bool_)
        moving = np.flatnonzero(model.moving_spheres)
        cells = np.rint((model.sphere_centers_batch(postures)[:, moving] - grid.origin) / grid.voxel).astype(np.int64)
        for sphere, radius in enumerate(model.sphere_set.radii[moving]):
            most = int(np.ceil(radius / grid.voxel))
            ball = np.argwhere(np.ones((2 * most + 1,) * 3)) - most
            ball = ball[np.linalg.norm(ball, axis=1) * grid.voxel <= radius]
            held = (np.unique(cells[:, sphere], axis=0)[:, None] + ball).reshape(-1, 3)
            held = held[np.all((held >= 0) & (held < is_reached.shape), axis=1)]
            is_reached[tuple(held.T)] = True
        return is_reached

    def things(self, margin: float, *, is_thin: bool = False) -> DistanceFunction:
        """The distance to the balls; balls within the margin [m] of start or goal are `yielded`. is_thin: radii are
        at most `THIN`, and half as large at lost edges.
        """
        radii = self.radii.copy()
        if is_thin:
            radii[: self.num_known] = np.minimum(radii[: self.num_known], np.float32(THIN))
            radii[self.num_known :] *= np.float32(0.5)
        radii = yielded(self.problem, self.centers, radii, margin)
        field = SphereField(
            Spheres.of(self.centers, radii + np.float32(margin)), threads=self.threads
        )  # no radius below 0
        return lambda points: field.query(points)[0] + (margin - ROUNDING)

    @cached_property
    def unseen(self) -> DistanceFunction | None:
        """Lower bound of the distance to space that no camera saw and the arm did not occupy; None without such
        space.
        """
        return self._distance_to(self._is_unseen)

    @cached_property
    def unseen_behind(self) -> DistanceFunction | None:
        """The same of what is `BEHIND` a surface of the map alone."""
        grid, is_behind = self.grid, self._is_unseen.copy()
        cells = np.argwhere(is_behind)
        if not len(cells) or not len(self.centers):
            return None
        away = cKDTree(self.centers).query(grid.origin + grid.voxel * cells, distance_upper_bound=BEHIND)[0]
        is_behind[tuple(cells[~np.isfinite(away)].T)] = False
        return self._distance_to(is_behind)

    @cached_property
    def _never_seen(self) -> Bool:
        """Voxels (X, Y, Z)."""
        occupancy = self.config.occupancy
        return np.asarray(self.grid.states(occupancy.free_below, occupancy.occupied_above) == VoxelState.NEVER_SEEN)

    @cached_property
    def _is_unseen(self) -> Bool:
        """Never-seen voxels (X, Y, Z), without voxels within `UNSEEN_NEAR` of the arm's start and goal."""
        grid, problem, is_unseen = self.grid, self.problem, self._never_seen.copy()
        centers = np.concatenate([problem.model.sphere_centers(q) for q in (problem.start, problem.goal)])
        radii = np.tile(problem.model.sphere_set.radii, 2)
        ends = [(centers + side * (radii + UNSEEN_NEAR)[:, None] - grid.origin) / grid.voxel for side in (-1, 1)]
        low = np.maximum(np.floor(ends[0].min(axis=0)).astype(np.int64), 0)
        high = np.ceil(ends[1].max(axis=0)).astype(np.int64) + 1
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        cells = low + np.argwhere(is_unseen[window])
        near = SphereField(Spheres.of(centers, radii)).query(grid.origin + grid.voxel * cells)[0] < UNSEEN_NEAR
        is_unseen[tuple(cells[near].T)] = False
        return is_unseen

    def _distance_to(self, chosen: Bool) -> DistanceFunction | None:
        """Distance to voxels `chosen` (X, Y, Z) as balls of their width; None if none or all are."""
        grid = self.grid
        if not chosen.any() or chosen.all():
            return None
        away = (grid.voxel * (distance_transform_edt(~chosen) - 0.5)).astype(np.float32)
        channels: Planes = {"sdf": away, "bound": away - np.float32(HALF_DIAGONAL * grid.voxel)}
        return GridField(DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=channels, header={})).certified


def _body(problem: Problem, q: Float64) -> SphereField:
    """The arm's moving spheres at a posture (J,)."""
    moving = problem.model.moving_spheres
    return SphereField(Spheres.of(problem.model.sphere_centers(q)[moving], problem.model.sphere_set.radii[moving]))


def beside_the_start(problem: Problem, centers: Float32, radii: Float32) -> tuple[Float32, Float32]:
    """Those balls (N, 3), (N,) that `is_beside_the_start`."""
    is_kept = is_beside_the_start(problem, centers, radii)
    return centers[is_kept], radii[is_kept]


def yielded(problem: Problem, centers: Float32, radii: Float32, margin: float) -> Float32:
    """Radii (N,) [m] of balls (N, 3), (N,), reduced if the start or the goal is nearer than the margin [m], because
    balls may be too large. A radius is at least -margin, at which the arm may touch the ball's centre.
    """
    for q in (problem.start, problem.goal):
        away = _body(problem, q).query(centers.astype(np.float64))[0]
        radii = np.minimum(radii, np.maximum(away - margin - ENDS_ROOM, -margin).astype(np.float32))
    return radii


def is_beside_the_start(problem: Problem, centers: Float32, radii: Float32) -> Bool:
    """Mask (N,) of balls farther than `START_GAP` from the arm's moving spheres at its start."""
    away = _body(problem, problem.start).query(centers.astype(np.float64))[0] - radii
    return np.asarray(away > START_GAP)


def _least_of(first: DistanceFunction, second: DistanceFunction) -> DistanceFunction:
    return lambda points: np.minimum(first(points), second(points))
