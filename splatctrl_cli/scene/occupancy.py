"""The occupancy grid of III-C: free, occupied and never-seen space."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.ndimage import label

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.kernels import native
from splatctrl_cli.records import Bool, Box, Float32, Float64, Index, Label, RgbdFrame, UInt8, UInt16
from splatctrl_cli.voxels import (
    MOST_VOXELS,
    NO_EDGES,
    SOLID,
    SWEPT,
    Balls,
    KnownVoxels,
    LostEdges,
    OccupancyGrid,
    Unseen,
    voxels_at,
)

MAX_STEPS = min(Unseen) - 1  # distinct time steps in `last_seen`


class OccupancyMap:
    """A dense log-odds grid over a workspace, changed in place."""

    def __init__(self, workspace: Box, config: OccupancyConfig, num_threads: int) -> None:
        self.config = config
        self.num_threads = num_threads
        extent = workspace.upper - workspace.lower
        shape = tuple(int(n) for n in np.maximum(np.ceil(extent / config.voxel), 1))
        size = " x ".join(f"{e:.1f}" for e in extent)
        refuse_if(
            np.prod([float(n) for n in shape]) > MOST_VOXELS,
            f"workspace of {size} m: too large for {config.voxel} m voxels",
            remedy="give --box, or a larger occupancy.voxel",
            error=UsageError,
        )
        self.origin: Float64 = workspace.lower + 0.5 * config.voxel
        self.log_odds: Float32 = np.zeros(shape, np.float32)
        self.num_updates: UInt16 = np.zeros(shape, np.uint16)
        self.entity: UInt8 = np.zeros(shape, np.uint8)
        self.last_seen: UInt16 = np.zeros(shape, np.uint16)
        self.step_stamps_ns: list[int] = []  # of the time steps that `last_seen` counts, from 1
        self.edges: dict[str, LostEdges] = {}  # of the newest image of each camera
        self._hits: UInt8 = np.zeros(shape, np.uint8)
        self._was_free: Bool = np.zeros(shape, bool)  # before this time step
        self._packed: Float64 = np.concatenate([self.origin, [config.voxel], shape]).astype(np.float64)  # for kernels

    def take_in(self, frames: Sequence[RgbdFrame]) -> None:
        """Add the depth images of one time step; human pixels set the human bit.

        Rays that pass a voxel clear its human and solid bits. If masked images hit it only with non-human pixels,
        they clear the human bit, too.
        """
        self._begin_step(frames)
        self._was_free = self.log_odds < 0
        masked = [(frame, frame.human) for frame in frames if frame.human is not None]
        entity, log_odds = self.entity.reshape(-1), self.log_odds.reshape(-1)
        known = np.flatnonzero(entity & (Label.HUMAN | SOLID) > 0)
        before = log_odds[known]
        for frame in frames:
            self.integrate(frame)
        entity[known[log_odds[known] < before]] &= np.uint8(~(Label.HUMAN | SOLID) & 0xFF)
        for frame, mask in masked:
            self._label_hits(frame, mask == 0, clear_bits=Label.HUMAN)
        for frame, mask in masked:
            self._label_hits(frame, mask != 0, set_bits=Label.HUMAN)

    def _begin_step(self, frames: Sequence[RgbdFrame]) -> None:
        """Count a time step; at `MAX_STEPS`, pairs of steps merge."""
        if len(self.step_stamps_ns) == MAX_STEPS:
            self.step_stamps_ns = self.step_stamps_ns[::2]
            is_step = self.last_seen < min(Unseen)
            self.last_seen[is_step] -= self.last_seen[is_step] // 2  # (n + 1) // 2, without an overflow
        self.step_stamps_ns.append(min(frame.stamp_ns for frame in frames))

    def integrate(self, frame: RgbdFrame) -> None:
        """Add one depth image: voxels are free along its rays, hit at their ends.

        A voxel with a pixel's point is a hit. Otherwise it is a miss if its centre is before its pixel's depth. A
        pixel without depth uses the nearest pixel's depth, while their rays are within half a voxel. Depth below
        `min_range` does not count; depth beyond `max_range` only frees.
        """
        config = self.config
        native.integrate_depth(
            self._packed, self.log_odds, self.num_updates, self.last_seen, self._hits, *_camera_arrays(frame),
            config.min_range, config.max_range, config.log_odds_hit, config.log_odds_miss, config.log_odds_limit,
            len(self.step_stamps_ns), self.num_threads,
        )  # fmt: skip

    def mark_unseen(self, points: Float64, reason: Unseen) -> None:
        """Note why no camera saw the voxels at points (K, 3) [m], world.

        Seen, contradicted and unanswered voxels keep their value.
        """
        cells, is_inside = voxels_at(points, self.origin, self.config.voxel, self.last_seen.shape)
        i, j, k = cells[is_inside].T
        before = self.last_seen[i, j, k]
        is_never = (before == 0) | (before >= min(Unseen)) & (before < Unseen.CONTRADICTED)
        self.last_seen[i[is_never], j[is_never], k[is_never]] = reason

    def unexplained(self, centers: Float64, radii: Float64) -> Index:
        """Flat indices (K,) of never-seen voxels in spheres (S, 3), (S,) [m] whose reason can change."""
        is_near = np.zeros(self.entity.shape, bool)
        native.mark_spheres(self._packed, is_near.view(np.uint8), centers, radii, 1, self.num_threads)
        voxels = np.flatnonzero(is_near)
        last = self.last_seen.reshape(-1)[voxels]
        is_open = (last == 0) | (last >= Unseen.OUT_OF_VIEW) & (last < Unseen.CONTRADICTED)
        return np.asarray(voxels[is_open])

    def keep_edges(self, edges: Mapping[str, LostEdges]) -> None:
        """Replace these cameras' lost edges, within the grid."""
        upper = self.origin + self.config.voxel * (np.array(self.log_odds.shape) - 1)
        for camera, each in edges.items():
            self.edges[camera] = each.select(np.all((each.centers >= self.origin) & (each.centers <= upper), axis=1))

    def label_robot(self, centers: Float64, radii: Float64, seen: Sequence[tuple[RgbdFrame, Bool, Bool]]) -> None:
        """Set the robot bit only where spheres (S, 3), (S,) [m] or pixels show the robot.

        seen: frames of one time step, pixels (H, W) of robot and objects. A voxel that an object pixel hits is solid,
        not robot, until rays pass it or only robot pixels hit it. If it was swept, its log-odds fall to those of one
        hit.
        """
        before, entity, log_odds = self.entity.flatten(), self.entity.reshape(-1), self.log_odds.reshape(-1)
        self.mark_robot(centers, radii)
        for frame, is_robot, _ in seen:
            self._label_hits(frame, is_robot, set_bits=Label.ROBOT | SWEPT, clear_bits=SOLID)
        for frame, _, is_object in seen:
            self._label_hits(frame, is_object, set_bits=SOLID)
        solid = np.flatnonzero(entity & SOLID > 0)
        entity[solid] &= np.uint8(~Label.ROBOT & 0xFF)
        new = solid[(entity[solid] & SWEPT > 0) & (before[solid] & SOLID == 0)]
        log_odds[new] = np.minimum(log_odds[new], self.config.log_odds_hit)
        arrived = solid[self._was_free.reshape(-1)[solid]]
        self._hide_beside(arrived, math.ceil(len(self.edges) / max(len(seen), 1)))

    def _hide_beside(self, arrived: Index, num_steps: int) -> None:
        """Forget views of space within `HIDDEN` of voxels (K,) of an arrived object.

        Views of the last `num_steps` steps stay.
        """
        reach = math.ceil(fixed.HIDDEN / self.config.voxel)
        cells = np.stack(np.unravel_index(arrived, self.entity.shape), axis=1)
        around = (cells[:, None] + np.argwhere(np.ones(3 * [2 * reach + 1])) - reach).reshape(-1, 3)
        i, j, k = around[np.all((around >= 0) & (around < self.last_seen.shape), axis=1)].T
        last = self.last_seen[i, j, k]
        is_old = (last > 0) & (last <= len(self.step_stamps_ns) - num_steps)
        self.last_seen[i[is_old], j[is_old], k[is_old]] = Unseen.HIDDEN_BY_THING

    def forget_hidden(self, centers: Float64, radii: Float64, is_within: Callable[[Float32, float], Bool]) -> None:
        """Clear solid voxels within the robot, unless they connect to solid voxels outside.

        Spheres (S, 3), (S,) [m] contain the robot; is_within: `RobotPosture.is_within`.
        """
        reach = radii.max() + 2.0 * self.config.voxel
        low, high = ((f - self.origin) / self.config.voxel for f in (centers.min(axis=0), centers.max(axis=0)))
        pad = int(np.ceil(reach / self.config.voxel))
        start = np.clip(np.floor(low).astype(int) - pad, 0, self.entity.shape)
        stop = np.clip(np.ceil(high).astype(int) + pad, start, self.entity.shape)
        crop = self.entity[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))]
        is_solid = crop & SOLID > 0
        cells = np.argwhere(is_solid)
        points = (self.origin + self.config.voxel * (start + cells)).astype(np.float32)
        is_met = is_within(points, 0.5 * np.sqrt(3.0) * self.config.voxel)
        groups = label(is_solid, np.ones((3, 3, 3)))[0][is_solid]
        is_forgotten = is_met & ~np.isin(groups, groups[~is_met])
        crop[tuple(cells[is_forgotten].T)] &= np.uint8(~SOLID & 0xFF)

    def mark_robot(self, centers: Float64, radii: Float64) -> None:
        """Set the robot bit only in voxels that spheres (S, 3), (S,) [m] meet; mark them swept."""
        self.entity &= np.uint8(~Label.ROBOT & 0xFF)
        native.mark_spheres(self._packed, self.entity, centers, radii, Label.ROBOT | SWEPT, self.num_threads)

    def _label_hits(self, frame: RgbdFrame, chosen: Bool, *, set_bits: int = 0, clear_bits: int = 0) -> None:
        native.label_hits(
            self._packed, self.entity, *_camera_arrays(frame), np.ascontiguousarray(chosen).view(np.uint8),
            self.config.min_range, self.config.max_range, set_bits, clear_bits, self.num_threads,
        )  # fmt: skip

    def entity_at(self, points_world: Float32) -> UInt8:
        """Entity bits (N,) at points (N, 3); 0 outside."""
        cells, is_inside = voxels_at(points_world, self.origin, self.config.voxel, self.entity.shape)
        return np.where(is_inside, self.entity[tuple(cells.T)], np.uint8(0))

    def was_free(self, points_world: Float32) -> Bool:
        """True (N,) at points (N, 3) that were free before the last time step."""
        cells, is_inside = voxels_at(points_world, self.origin, self.config.voxel, self.entity.shape)
        return np.asarray(is_inside & self._was_free[tuple(cells.T)])

    def entity_around(self, points_world: Float32) -> UInt8:
        """ORed entity bits (N,) of the eight nearest voxels."""
        bits = np.zeros(len(points_world), np.uint8)
        for corner in np.ndindex(2, 2, 2):
            offset = self.config.voxel * (np.array(corner, np.float32) - np.float32(0.5))
            bits |= self.entity_at(points_world + offset)
        return bits

    def occupancy_around(self, points_world: Float32) -> tuple[Float32, Bool]:
        """Largest occupancy (N,) of the eight nearest voxels; True (N,) if any was seen.

        Never-seen voxels do not count; if all are, it is one half.
        """
        base = np.floor((points_world - self.origin) / self.config.voxel).astype(np.int64)
        limit = np.array(self.log_odds.shape) - 1
        largest = np.full(len(points_world), -np.inf, np.float32)
        for corner in np.ndindex(2, 2, 2):
            i, j, k = np.clip(base + corner, 0, limit).T
            is_seen = self.num_updates[i, j, k] > 0
            largest = np.where(is_seen, np.maximum(largest, self.log_odds[i, j, k]), largest)
        is_observed = np.isfinite(largest)
        log_odds = np.where(is_observed, largest, np.float32(0.0))
        return (1.0 / (1.0 + np.exp(-log_odds))).astype(np.float32), is_observed

    def occupied_voxels(self) -> Index:
        """Flat indices (K,) of voxels hit more than once, except the robot's."""
        config = self.config
        threshold = float(np.log(config.occupied_above / (1.0 - config.occupied_above)))
        voxels = np.flatnonzero(self.log_odds > max(threshold, 1.5 * config.log_odds_hit))
        # Swept voxels that no object pixel hit since may be the robot's.
        return np.asarray(voxels[self.entity.reshape(-1)[voxels] & (SWEPT | SOLID) != SWEPT])

    def swept_box(self) -> Box | None:
        """Box of the robot's path so far; None without any."""
        is_swept = self.entity & SWEPT > 0
        cells = [np.flatnonzero(is_swept.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
        if not len(cells[0]):
            return None
        lower, upper = (np.array([indices[end] for indices in cells]) for end in (0, -1))
        return Box(lower=self.origin + self.config.voxel * lower, upper=self.origin + self.config.voxel * upper)

    def centers_of(self, voxels: Index) -> Float32:
        """Centres (K, 3) [m], world, of flat indices (K,)."""
        cells = np.stack(np.unravel_index(voxels, self.log_odds.shape), axis=1)
        return (self.origin + self.config.voxel * cells).astype(np.float32)

    def grid(self) -> OccupancyGrid:
        return OccupancyGrid(
            origin=self.origin.copy(),
            voxel=self.config.voxel,
            log_odds=self.log_odds.copy(),
            num_updates=self.num_updates.copy(),
            entity=self.entity.copy(),
        )

    def known(self, unrepresented: Balls) -> KnownVoxels:
        return KnownVoxels(
            grid=self.grid(),
            last_seen=self.last_seen.copy(),
            step_stamps_ns=np.array(self.step_stamps_ns, np.int64),
            unrepresented=unrepresented,
            edges=NO_EDGES.joined(*(self.edges[camera] for camera in sorted(self.edges))),
        )


class PeopleMemory:
    """Flat indices `voxels` (K,) of people, and `stamps_ns` (K,) of their last observation.

    Voxels unobserved for longer than `memory` [s] become unknown.
    """

    def __init__(self, memory: float) -> None:
        self.memory = memory
        self.voxels: Index = np.zeros(0, np.int64)
        self.stamps_ns: Index = np.zeros(0, np.int64)

    def take_in(self, occupancy: OccupancyMap, frames: Sequence[RgbdFrame]) -> None:
        """Add a time step's depth images; forget people."""
        num_updates, log_odds = occupancy.num_updates.reshape(-1), occupancy.log_odds.reshape(-1)
        entity = occupancy.entity.reshape(-1)
        before = num_updates[self.voxels]
        occupancy.take_in(frames)
        is_unseen = num_updates[self.voxels] == before
        unseen, since_ns = self.voxels[is_unseen], self.stamps_ns[is_unseen]
        now_ns = max(frame.stamp_ns for frame in frames)
        lost = unseen[now_ns - since_ns > self.memory * 1e9]
        entity[lost] &= np.uint8(~Label.HUMAN & 0xFF)
        log_odds[lost], num_updates[lost] = 0.0, 0
        if not len(self.voxels) and all(frame.human is None for frame in frames):
            return  # no people before or now
        self.voxels = np.flatnonzero(entity & Label.HUMAN)
        self.stamps_ns = np.full(len(self.voxels), now_ns, np.int64)
        is_still = np.isin(unseen, self.voxels)
        self.stamps_ns[np.searchsorted(self.voxels, unseen[is_still])] = since_ns[is_still]


def _camera_arrays(frame: RgbdFrame) -> tuple[Float64, Float64, Float32]:
    """Intrinsics (6,), T_world_camera (4, 4) and depth (H, W) [m] as the kernels take them."""
    k = frame.intrinsics
    intrinsics = np.array([k.fx, k.fy, k.cx, k.cy, k.width, k.height], np.float64)
    return (
        intrinsics,
        np.ascontiguousarray(frame.T_world_camera, np.float64),
        np.ascontiguousarray(frame.depth, np.float32),
    )
