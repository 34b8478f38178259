"""Voxels: state of space, age of evidence, and occupied voxels without a splat."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from splatctrl_cli.records import Bool, Columns, Float32, Float64, Floats, Index, UInt8, UInt16

MOST_VOXELS = 400_000_000  # of a grid
FIRST_REASON = 0xF0  # `last_seen` from here on (0xFFF0 in two bytes) is the reason why a voxel was never seen
SWEPT = 0b100  # entity bit of a voxel that the robot occupied at some time
SOLID = 0b1000  # entity bit, with a known robot: an object's pixel hit the voxel after its last free view


def voxels_at(points: Floats, origin: Float64, voxel: float, shape: tuple[int, ...]) -> tuple[Index, Bool]:
    """Voxels (Q, 3) at points (Q, 3) [m], 0 outside; True (Q,) inside the grid.

    Voxel (0, 0, 0) of the grid of `shape` (X, Y, Z) is centred at `origin` (3,) [m]; edges are `voxel` [m] long.
    """
    cells = np.floor((points - origin) / voxel + 0.5)
    is_inside = np.all((cells >= 0) & (cells < shape), axis=1)
    return np.where(is_inside[:, None], cells, 0).astype(np.int64), is_inside


class VoxelState(IntEnum):
    """State of a voxel."""

    NEVER_SEEN = 0
    FREE = 1
    OCCUPIED = 2
    UNCERTAIN = 3
    SWEPT_BY_ROBOT = 4  # never seen, but the robot was in it


class Unseen(IntEnum):
    """Reason why no camera got depth through or on a voxel (two-byte `last_seen`).

    The largest of several cameras' reasons counts. The last two reasons stay until a ray passes.
    """

    SWEPT = 0xFFF0  # the robot's body was in it
    OUT_OF_VIEW = 0xFFF1
    HIDDEN_BY_ARM = 0xFFF2
    HIDDEN_BY_THING = 0xFFF3  # also where an object arrived since the last view
    NO_RETURN = 0xFFF4  # a camera has no depth there now
    CONTRADICTED = 0xFFFE  # a ray passed it, through a surface that another camera measured
    UNANSWERED = 0xFFFF  # no return, though the ray meets a surface or depth surrounds it


class EvidenceClass(IntEnum):
    """Evidence about a point near the arm at one time; exactly one per point."""

    FREE = 0  # a camera got depth through or on it, not too long ago
    SWEPT = 1  # never seen, but the robot's body was there
    STALE = 2  # seen too long ago
    HIDDEN_BY_ARM = 3
    HIDDEN_BY_THING = 4
    OUT_OF_VIEW = 5  # in no camera's view; or without a recorded reason, far from the arm
    NO_RETURN = 6  # no depth in its pixel, which may show empty background
    CONTRADICTED = 7
    UNANSWERED = 8  # no depth where some is expected
    DEPTH_EDGE = 9  # a surface may extend there past its lost edge
    OUTSIDE = 10  # of the workspace
    SURFACE = 11  # within a surface of the map


@dataclass(frozen=True, kw_only=True)
class OccupancyGrid:
    """Log-odds voxels; voxel (i, j, k) is centred at ``origin + voxel * (i, j, k)``, world [m].

    log_odds (X, Y, Z) float32; num_updates (X, Y, Z) uint16, 0 = never seen; entity (X, Y, Z) uint8 bits of `Label`,
    `SWEPT` and `SOLID`. Occupancy is ``1 / (1 + exp(-log_odds))``; below 0.3 is free, above 0.7 occupied.
    """

    origin: Float64
    voxel: float
    log_odds: Float32
    num_updates: UInt16
    entity: UInt8

    def states(self, free_below: float, occupied_above: float) -> UInt8:
        """`VoxelState` (X, Y, Z) by thresholds of occupancy."""
        low, high = (float(np.log(p / (1.0 - p))) for p in (free_below, occupied_above))
        states = np.full(self.log_odds.shape, np.uint8(VoxelState.UNCERTAIN))
        states[self.log_odds < low] = VoxelState.FREE
        states[self.log_odds > high] = VoxelState.OCCUPIED
        is_unseen = self.num_updates == 0
        states[is_unseen] = VoxelState.NEVER_SEEN
        states[is_unseen & (self.entity & SWEPT > 0)] = VoxelState.SWEPT_BY_ROBOT
        return states

    @classmethod
    def from_states(cls, origin: Float64, voxel: float, states: UInt8) -> "OccupancyGrid":
        """Build a grid with these `states` (X, Y, Z) by any thresholds.

        Log-odds are -20, 0 or 20, updates 0 or 1.
        """
        is_seen = (states != VoxelState.NEVER_SEEN) & (states != VoxelState.SWEPT_BY_ROBOT)
        log_odds = np.zeros(states.shape, np.float32)
        log_odds[states == VoxelState.FREE] = -20.0
        log_odds[states == VoxelState.OCCUPIED] = 20.0
        return cls(
            origin=origin,
            voxel=voxel,
            log_odds=log_odds,
            num_updates=is_seen.astype(np.uint16),
            entity=np.where(states == VoxelState.SWEPT_BY_ROBOT, np.uint8(SWEPT), np.uint8(0)),
        )


@dataclass(frozen=True, kw_only=True)
class Balls(Columns):
    """Equal balls for voxels: centers (K, 3) float32 [m], world; labels (K,) uint8 (`Label`).

    radius [m]: half a voxel's diagonal, to contain the voxel.
    """

    centers: Float32
    radius: float
    labels: UInt8

    @classmethod
    def from_voxels(cls, centers: Float32, voxel: float, labels: UInt8) -> "Balls":
        """Balls around voxels of edge `voxel` [m] at centers (K, 3)."""
        return cls(centers=centers, radius=0.5 * 3**0.5 * voxel, labels=labels)

    @property
    def volume(self) -> float:
        """[m^3] of their voxels."""
        return len(self) * (2.0 * self.radius / 3**0.5) ** 3


@dataclass(frozen=True, kw_only=True)
class LostEdges(Columns):
    """Balls in which surfaces may extend into pixels without depth.

    centers (K, 3) [m], world, radii (K,) [m], float32.
    """

    centers: Float32
    radii: Float32


NO_EDGES = LostEdges(centers=np.zeros((0, 3), np.float32), radii=np.zeros(0, np.float32))


@dataclass(frozen=True, kw_only=True)
class SeenVoxels:
    """Last view of each voxel, centred at `origin` + index times `voxel` [m].

    last_seen (X, Y, Z) uint8 or uint16: 1 + the index into step_stamps_ns (T,) int64 of the last step with depth
    through or on the voxel. 0: never. The type's largest numbers: the reason (`Unseen`, its lower byte in uint8).
    edges: of the newest images. is_free (X, Y, Z): `VoxelState.FREE` now; None if not recorded.
    """

    origin: Float64
    voxel: float
    last_seen: UInt8 | UInt16
    step_stamps_ns: Index
    edges: LostEdges = NO_EDGES
    is_free: Bool | None = None

    def look(self, points: Floats) -> tuple[Index, UInt8]:
        """Stamps (Q,) [ns] of the last views, -1 for never, and `EvidenceClass` (Q,).

        points (Q, 3) [m], world. The class is `FREE` for every voxel ever seen.
        """
        cells, is_inside = voxels_at(points, self.origin, self.voxel, self.last_seen.shape)
        step = np.where(is_inside, self.last_seen[tuple(cells.T)], 0).astype(np.int64)
        first = int(np.iinfo(self.last_seen.dtype).max) & ~0xF
        reason = np.where(step >= first, step - first + 1, 0)
        step[reason > 0] = 0
        classes = np.where(step > 0, np.uint8(EvidenceClass.FREE), _CLASS_OF[reason])
        classes[~is_inside] = EvidenceClass.OUTSIDE
        return np.concatenate([[-1], self.step_stamps_ns])[step], classes


_CLASS_OF = np.full(17, np.uint8(EvidenceClass.OUT_OF_VIEW))  # by 1 + the lower four bits of `Unseen`; 0: no reason
_CLASS_OF[[1 + (reason & 0xF) for reason in Unseen]] = [EvidenceClass[reason.name] for reason in Unseen]


@dataclass(frozen=True, kw_only=True)
class KnownVoxels:
    """State of space at one moment, and its evidence's age.

    last_seen, step_stamps_ns, edges: as in `SeenVoxels`. unrepresented: occupied voxels without a splat, except the
    robot's.
    """

    grid: OccupancyGrid
    last_seen: UInt16
    step_stamps_ns: Index
    unrepresented: Balls
    edges: LostEdges = NO_EDGES

    @property
    def seen(self) -> SeenVoxels:
        grid = self.grid
        return SeenVoxels(
            origin=grid.origin,
            voxel=grid.voxel,
            last_seen=self.last_seen,
            step_stamps_ns=self.step_stamps_ns,
            edges=self.edges,
        )
