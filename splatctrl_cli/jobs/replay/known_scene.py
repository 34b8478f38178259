"""Scenes known to a replay: a baked grid, or splats over time."""

import math
from bisect import bisect_right
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import Config, fixed
from splatctrl_cli.control.audit import BallDistance, DistanceFunction, Observed, observed_at
from splatctrl_cli.control.barriers import SceneStep, guard_people
from splatctrl_cli.control.columns import UNREPRESENTED, Obstacle
from splatctrl_cli.control.near_space import Seen
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.field.clusters import NO_SPLAT, ObstacleSpheres, Spheres, obstacle_spheres
from splatctrl_cli.field.distance import SphereField, field_over
from splatctrl_cli.field.grid_cells import GridField, exact_channel
from splatctrl_cli.files.output import Parts, sha256
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.records import Bool, Box, DistanceField, DistanceGrid, Float64, Index, Label, SplatSet, UInt8
from splatctrl_cli.voxels import SWEPT, Balls, EvidenceClass, OccupancyGrid, SeenVoxels, VoxelState

Key = TypeVar("Key", bound=Hashable)
BY_CAMERA = (VoxelState.FREE, VoxelState.UNCERTAIN, VoxelState.OCCUPIED)  # voxels that a camera saw
ROUNDING = 1e-5  # [m] subtracted from distances to splats, far above what float32 rounds within 8 m
NUM_CACHED = 3  # scenes whose fields are kept: the last, this and the next


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownFields:
    """Fields of one scene: `barrier` for a controller, `distances` for an audit.

    obstacles: function of points (Q, 3) [m], world, to each one's nearest obstacle. human: field of people only.
    splats_alone: exact distance without voxels that no splat represents. is_person (N,): balls of the exact distance
    that are people, None for a grid. balls: the barrier's balls; None for a grid, or if people have a larger margin.
    """

    barrier: DistanceField
    distances: Mapping[str, DistanceFunction]
    median_radius: float
    obstacles: Callable[[Float64], tuple[Obstacle, ...]]
    splats_alone: DistanceFunction
    human: DistanceField | None = None
    is_person: Bool | None = None
    balls: BallDistance | None = None


@dataclass(frozen=True, kw_only=True)
class KnownScene:
    """Scene a replay may use at each time; unknown before `first_ns` (None: always known).

    `at(stamp_ns)` returns the same object while a scene is in use. observed, cameras: None if not recorded.
    stamps_ns: of scenes, each known from its `known_ns` on; empty if one scene serves all times. `advance` makes the
    scenes up to a stamp; call `finish` after the replay. box: of a grid's cell centres. moment_ns: stamp of a baked
    field. seen_at: when space was last seen, as known at a stamp; without has_seen_times, only if it ever was.
    """

    at: Callable[[int], KnownFields]
    observed: Observed | None
    first_ns: int | None
    cameras: tuple[str, ...] | None
    digests: dict[str, str]
    stamps_ns: Sequence[int] = ()
    known_ns: Sequence[int] = ()
    advance: Callable[[int], None] = lambda stamp_ns: None
    finish: Callable[[], None] = lambda: None
    box: Box | None = None
    moment_ns: int | None = None
    seen_at: Callable[[int], Seen | None] = lambda stamp_ns: None
    has_seen_times: bool = True
    figures: Callable[[], Mapping[str, Any]] = dict

    def age_s(self, stamp_ns: int) -> float:
        """Age [s] of the scene in use (of a field, from `moment_ns`); NaN without times."""
        if self.moment_ns is not None:
            return abs(stamp_ns - self.moment_ns) * 1e-9
        index = self._index_at(stamp_ns)
        return math.nan if index < 0 else (stamp_ns - self.stamps_ns[index]) * 1e-9

    def depth_ns(self, stamp_ns: int) -> int | None:
        """Stamp [ns] of the newest depth in the scene in use; None without times."""
        index = self._index_at(stamp_ns)
        return None if index < 0 else self.stamps_ns[index]

    def step_at(self, stamp_ns: int) -> SceneStep | None:
        """Two newest scenes at a stamp, None with only one."""
        index = self._index_at(stamp_ns)
        if index < 1:
            return None
        older_ns, newer_ns = self.stamps_ns[index - 1 : index + 1]
        older, newer = (self.at(known).barrier for known in self.known_ns[index - 1 : index + 1])
        return SceneStep(newer=newer, older=older, seconds=(newer_ns - older_ns) * 1e-9)

    def next_ns(self, stamp_ns: int) -> int | None:
        """Stamp [ns] from which the next scene is known; None if none follows within NEXT_SCENE_NS."""
        later = self._index_at(stamp_ns) + 1
        self.advance(stamp_ns + fixed.NEXT_SCENE_NS)
        latest = stamp_ns + fixed.NEXT_SCENE_NS
        return next((known for known in self.known_ns[later : later + 1] if known <= latest), None)

    def own_ns(self, stamp_ns: int) -> int:
        """Stamp [ns] at which depth of `stamp_ns` is the newest known; `stamp_ns` without times."""
        if not self.known_ns:
            return stamp_ns
        newest = max(0, bisect_right(self.stamps_ns, stamp_ns) - 1)
        delay = self.known_ns[newest] - self.stamps_ns[newest]
        return min([stamp_ns + delay, *(known - 1 for known in self.known_ns[newest + 1 : newest + 2])])

    def _index_at(self, stamp_ns: int) -> int:
        self.advance(stamp_ns)
        return bisect_right(self.known_ns, stamp_ns) - 1


def fields_at(
    known_ns: Sequence[int], key_of: Callable[[int], Key], fields_of: Callable[[Key], KnownFields]
) -> Callable[[int], KnownFields]:
    """Return a lookup of the newest scene at a stamp, which caches the last NUM_CACHED.

    The lookup raises NotEvaluableError before the first scene is known.
    """
    cached = lru_cache(maxsize=NUM_CACHED)(fields_of)

    def at(stamp_ns: int) -> KnownFields:
        index = bisect_right(known_ns, stamp_ns) - 1
        refuse_if(
            index < 0,
            f"no map is known yet at stamp {stamp_ns} ns",
            remedy="give a later time",
            error=NotEvaluableError,
        )
        return cached(key_of(index))

    return at


def read_grid_scene(path: Path) -> KnownScene:
    """Read a baked grid (folder or ``field.npz``) as one scene for all times."""
    file = path / "field.npz" if path.is_dir() else path
    grid = read_npz(Parts.from_folder(file).checked(file))
    barrier = GridField(grid)
    states = grid.channels.get("observed")
    observed = None if states is None else partial(observed_at, states.astype("uint8"), grid.origin, grid.voxel)
    seen = None if observed is None else _grid_seen(observed, grid)
    made_from = origins if isinstance(origins := grid.header.get("made_from"), dict) else {}
    exact = _distance(GridField(replace(grid, channels={"sdf": exact_channel(grid)})))
    fields = KnownFields(
        barrier=barrier,
        splats_alone=exact,
        distances={
            "exact": exact,
            "barrier": _distance(barrier),
            "certified": barrier.certified,
        },
        median_radius=_median_radius(file, grid.header),
        obstacles=lambda points: _nearest_cells(grid, barrier, points),
    )
    return KnownScene(
        at=lambda stamp_ns: fields,
        observed=observed,
        seen_at=lambda stamp_ns: seen,
        has_seen_times=False,
        first_ns=None,
        cameras=None,
        digests={file.name: sha256(file)},
        moment_ns=moment if isinstance(moment := grid.header.get("stamp_ns"), int) else None,
        box=barrier.box,
        figures=lambda: made_from,
    )


def read_splat_scene(path: Path, config: Config, threads: int, *, latency_ns: int = 0) -> KnownScene:
    """Read a reconstruction; each stamp uses the newest snapshot at least `latency_ns` old.

    Known space is what a camera saw, or the robot swept, at any time of the log.
    """
    scene = open_scene(path)
    stamps = sorted({snapshot.stamp_ns for snapshot in scene.snapshots} | {scene.stamp_ns})
    has_times = scene.has_clock and bool(scene.snapshots)
    refuse_if(
        latency_ns and not has_times,
        f"--latency: {path} is one scene for all times: expected snapshots",
        remedy="leave --latency out",
        error=UsageError,
    )

    known_ns = tuple(stamp + latency_ns for stamp in stamps)

    def fields(stamp_ns: int | None) -> KnownFields:
        splats = scene.splats() if stamp_ns is None else scene.splats_at(stamp_ns)
        return splat_fields(splats, config, threads, scene.unrepresented_at(stamp_ns))

    def key_of(index: int) -> int | None:
        return stamps[index] if index < len(stamps) - 1 else None  # the last is the final map

    @lru_cache(maxsize=NUM_CACHED)
    def voxels(index: int) -> SeenVoxels | None:
        is_last = not has_times or index == len(stamps) - 1
        return scene.seen() if is_last else scene.snapshot_at(stamps[index]).seen()

    def seen_at(stamp_ns: int) -> Seen | None:
        index = bisect_right(known_ns, stamp_ns) - 1 if has_times else 0
        known = None if index < 0 else voxels(index)
        return None if known is None else seen_of(known)

    return KnownScene(
        at=fields_at(known_ns if has_times else [-(2**63)], key_of if has_times else lambda _: None, fields),
        observed=known_space(scene.occupancy()),
        first_ns=known_ns[0] if has_times else None,
        cameras=tuple(scene.cameras),
        digests={"splats.ply": sha256(path / "splats.ply")},
        stamps_ns=tuple(stamps) if has_times else (),
        known_ns=known_ns if has_times else (),
        seen_at=seen_at,
        figures=lambda: scene.run.get("metrics", {}),
    )


def seen_of(voxels: SeenVoxels) -> Seen:
    edges = np.column_stack([voxels.edges.centers, voxels.edges.radii]).astype(np.float64)
    return Seen(
        look=voxels.look,
        edges=edges,
        origin=voxels.origin,
        voxel=voxels.voxel,
        shape=voxels.last_seen.shape,
        is_free=voxels.is_free,
    )


def _grid_seen(observed: Observed, grid: DistanceGrid) -> Seen:
    def look(points: Float64) -> tuple[NDArray[np.int64], UInt8]:
        is_seen = np.isin(observed(points), BY_CAMERA)  # the robot's spheres stick out: swept space is not seen
        classes = np.where(is_seen, EvidenceClass.FREE, EvidenceClass.OUT_OF_VIEW).astype(np.uint8)
        return np.where(is_seen, np.int64(0), np.int64(-1)), classes

    return Seen(look=look, origin=grid.origin, voxel=grid.voxel)


def known_space(occupancy: OccupancyGrid) -> Observed:
    """Return a lookup of places that a camera saw or the robot swept."""
    known = (occupancy.num_updates > 0) | ((occupancy.entity & SWEPT) > 0)
    return partial(observed_at, known.astype("uint8"), occupancy.origin, occupancy.voxel)


def splat_fields(splats: SplatSet, config: Config, threads: int, unrepresented: Balls | None = None) -> KnownFields:
    """Exact and barrier field of the obstacles; people are nearer in the barrier (`control.human_margin`)."""
    obstacles = obstacle_spheres(splats, unrepresented)
    chosen = obstacles.splats
    spheres = Spheres.of(chosen.centers, chosen.radii)
    people = chosen.labels == Label.HUMAN
    human = (
        SphereField(Spheres.of(chosen.centers[people], chosen.radii[people]), threads=threads)
        if people.any()
        else None
    )
    barrier = guard_people(field_over(spheres, config.field, threads=threads), human, config.control)
    exact = SphereField(spheres, threads=threads)
    balls = BallDistance(of_points=_distance(exact), centers=chosen.centers, radii=chosen.radii)
    return KnownFields(
        barrier=barrier,
        distances={
            "exact": balls,
            "barrier": _distance(barrier),
        },
        median_radius=float(np.median(chosen.radii)),
        obstacles=lambda points: _nearest_spheres(obstacles, exact.nearest(points), points),
        human=human,
        is_person=people,
        splats_alone=_splats_alone(obstacles, balls, threads),
        balls=balls if human is None or config.control.human_margin <= config.control.margin else None,
    )


def _splats_alone(obstacles: ObstacleSpheres, balls: BallDistance, threads: int) -> DistanceFunction:
    if not obstacles.num_unrepresented:
        return balls
    is_splat = obstacles.index != NO_SPLAT
    centers, radii = obstacles.splats.centers[is_splat], obstacles.splats.radii[is_splat]
    if not len(radii):
        return lambda points: np.full(len(points), np.inf)
    return BallDistance(
        of_points=_distance(SphereField(Spheres.of(centers, radii), threads=threads)), centers=centers, radii=radii
    )


def _nearest_spheres(obstacles: ObstacleSpheres, index: Index, points: Float64) -> tuple[Obstacle, ...]:
    splats = obstacles.splats
    in_file = [None if k == NO_SPLAT else int(k) for k in obstacles.index[index]]
    offset = points - splats.centers[index].astype(np.float64)
    gap = np.linalg.norm(offset, axis=1)
    radius = splats.radii[index].astype(np.float64)
    surface = splats.centers[index] + offset * (radius / np.maximum(gap, 1e-12))[:, None]
    return tuple(
        Obstacle(
            distance=float(gap[k] - radius[k]),
            position=_place(surface[k]),
            splat=in_file[k],
            label=UNREPRESENTED if in_file[k] is None else Label(splats.labels[sphere]).name.lower(),
        )
        for k, sphere in enumerate(index)
    )


def _nearest_cells(grid: DistanceGrid, field: GridField, points: Float64) -> tuple[Obstacle, ...]:
    distance, gradient = field.query(points)
    surface = points - gradient * (distance / np.maximum(np.linalg.norm(gradient, axis=1), 1e-12))[:, None]
    cells = np.nan_to_num(np.floor((surface - grid.origin) / grid.voxel + 0.5)).astype(np.int64)
    return tuple(
        Obstacle(
            distance=float(distance[k]), position=_place(surface[k]), cell=(int(cell[0]), int(cell[1]), int(cell[2]))
        )
        for k, cell in enumerate(cells)
    )


def _place(point: Float64) -> tuple[float, float, float]:
    return float(point[0]), float(point[1]), float(point[2])


def _distance(field: DistanceField) -> DistanceFunction:
    return lambda points: field.query(points)[0]


def _median_radius(file: Path, header: Mapping[str, object]) -> float:
    radius = header.get("radius")
    if not isinstance(radius, Mapping) or not isinstance(radius.get("median"), float):
        raise InputError(f"{file}: header: expected the splats' median radius, got none", remedy="bake it again")
    return float(radius["median"])


@dataclass(frozen=True, kw_only=True)
class Certified:
    """Adapter of `certified_distance` for the planner."""

    distance: DistanceFunction


def certified_distance(fields: KnownFields) -> DistanceFunction:
    """Return a lower bound of the exact, 1-Lipschitz distance to the splats.

    Kernel fields prove nothing from samples: their slope has no useful bound.
    """
    if (certified := fields.distances.get("certified")) is not None:
        return certified
    exact = fields.distances["exact"]
    return lambda points: exact(points) - ROUNDING
