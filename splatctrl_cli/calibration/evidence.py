"""The evidence of a calibration: views laid over each other, where the arm says its links are; and its unknowns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.calibration.views import (
    DepthView,
    bend,
    depth_sigma,
    still_frame,
    strided,
    surface_normals,
    tiles_of,
)
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import back_project, invert_transform, pose_at, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, Index, Intrinsics, Posture, RgbdFrame, spread
from splatctrl_cli.robot.model import RobotModel

POSE, DEPTH = 6, 2  # unknowns of a camera: a turn and a move in its own frame, the scale and bias of its depths
OF_CAMERA = POSE + DEPTH
HELD = -1


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """T_recorded_camera (4, 4) by camera, so that ``T_world_camera = T_world_recorded @ T_recorded_camera``; scale
    and bias [m] of its depths, so that the true one is ``scale depth + bias``; clock [s]: a frame's stamp less that
    of the joint state at that instant.
    """

    corrections: Mapping[str, Float64]
    depth: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    clock: float = 0.0

    def depth_of(self, camera: str) -> tuple[float, float]:
        """Scale and bias."""
        return self.depth.get(camera, (1.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """The cameras, of which those in `poses` are moved, and the depths of those in `scales` and `biases` get one;
    has_clock: the clock of the joint states is shifted, too. Everything else is held.
    """

    cameras: Sequence[str]
    poses: Sequence[str]
    scales: Sequence[str] = ()
    biases: Sequence[str] = ()
    has_clock: bool = False

    @property
    def size(self) -> int:
        """P."""
        return POSE * len(self.poses) + len(self.scales) + len(self.biases) + self.has_clock

    def columns(self, camera: str) -> Index:
        """Where the unknowns of a camera (8,) stand, `HELD` for what is none."""
        at = np.full(OF_CAMERA, HELD)
        if camera in self.poses:
            at[:POSE] = POSE * self.poses.index(camera) + np.arange(POSE)
        first = POSE * len(self.poses)
        for number, named in enumerate((self.scales, self.biases)):
            if camera in named:
                at[POSE + number] = first + named.index(camera)
            first += len(named)
        return at

    @property
    def clock_column(self) -> int:
        """Where the clock stands, `HELD` where it is none."""
        return self.size - 1 if self.has_clock else HELD

    def moved(self, estimate: Estimate, step: Float64) -> Estimate:
        """The estimate after a step (P,)."""
        corrections, depth = dict(estimate.corrections), dict(estimate.depth)
        for camera in self.poses:
            corrections[camera] = corrections[camera] @ transform_of(step[self.columns(camera)[:POSE]])
        for camera in dict.fromkeys((*self.scales, *self.biases)):
            columns = self.columns(camera)[POSE:]
            scale, bias = np.where(columns < 0, 0.0, step[columns])
            depth[camera] = (estimate.depth_of(camera)[0] + scale, estimate.depth_of(camera)[1] + bias)
        clock = estimate.clock + (float(step[-1]) if self.has_clock else 0.0)
        return Estimate(corrections=corrections, depth=depth, clock=clock)


def transform_of(twist: Float64) -> Float64:
    """T (4, 4) of a turn [rad] and a move [m] (6,)."""
    return pose_at(twist[3:], cv2.Rodrigues(np.asarray(twist[:3], np.float64))[0])


def twist_of(T: Float64) -> Float64:
    """The turn [rad] and the move [m] (6,) of T (4, 4)."""
    return np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]])


def twist_between(T_before: Float64, T_after: Float64) -> Float64:
    """The twist (6,) that follows a pose (4, 4) to become another."""
    return twist_of(invert_transform(T_before) @ T_after)


REMEMBERED = 1024  # times, at which the links' poses are kept: the rounds after the clock is found ask for the same
STEP_NS = 10_000_000  # [ns] before and after, from which a velocity is taken: less than the time between two states


@dataclass(frozen=True, kw_only=True)
class ArmRows:
    """Distances of M measured points from the robot's surface: residual (M,) [m], positive outside; jacobian (M, 6)
    by a turn and a move of the camera in its own frame; clock (M,) [m/s], the derivative by the clock; points and
    normals (M, 3), in the camera's frame; links, tiles (M,). num_seen: pixels that should show the robot's surface;
    num_hidden: of these, those that show something by more than `width` before it.
    """

    residual: Float64
    jacobian: Float64
    clock: Float64
    points: Float64
    normals: Float64
    links: NDArray[np.int64]
    tiles: Index
    num_seen: int
    num_hidden: int


class Arm:
    """A robot with the joint positions of a recording, in the model's order of joints."""

    def __init__(self, model: RobotModel, posture: Posture) -> None:
        self.model = model
        self.surface = model.surface
        self._posture = posture
        self._vague = np.array(sorted(self.surface.vague), dtype=np.int64)
        self.surface_poses = lru_cache(maxsize=REMEMBERED)(self._surface_poses)

    def is_posed(self, stamp_ns: int) -> bool:
        """Whether joint states are near a time [ns]."""
        return self._posture(stamp_ns) is not None

    def link_pose(self, link: str, stamp_ns: int) -> Float64 | None:
        """T_world_link (4, 4) at a time of the joint states; None where they are too far away."""
        q = self._posture(stamp_ns)
        return None if q is None else self.model.frame_pose(q, link)

    def _surface_poses(self, stamp_ns: int) -> Float64 | None:
        """T_world_link (L, 4, 4) of the surface's links, likewise."""
        q = self._posture(stamp_ns)
        if q is None:
            return None
        return self.surface.poses({link: self.model.frame_pose(q, link) for link in self.surface.links})

    def rows(
        self,
        depth: Float32,
        lens: Intrinsics,
        T_world_camera: Float64,
        camera_twist: Float64,
        stamp_ns: int,
        width: float,
    ) -> ArmRows | None:
        """Of the pixels (H, W) [m] that show the robot as it was at a time [ns] of the joint states, no farther than
        `width` [m] from its rendered surface; None where its joints are not known then.

        camera_twist (6,) [1/s]: how the camera moves with the clock, in its own frame. Pixels at the border of a
        link, and links that spheres or boxes stand for, do not count.
        """
        poses, before, after = (self.surface_poses(stamp_ns + step) for step in (0, -STEP_NS, STEP_NS))
        if poses is None:
            return None
        shown = self.surface.render(poses, lens, T_world_camera, depth)
        part, corner = _around(shown.link >= 0)
        near, links, depths = shown.depth[part], shown.link[part], depth[part]
        cut = replace(lens, cx=lens.cx - corner[1], cy=lens.cy - corner[0], width=near.shape[1], height=near.shape[0])
        surface = back_project(cut, near)
        normals = surface_normals(surface)
        is_used = _inside_links(links, near) & np.any(normals != 0, axis=-1) & (depths > 0)
        is_used &= ~np.isin(links, self._vague)
        facing = -np.einsum("hwi,hwi->hw", normals, surface)
        is_used &= facing > fixed.CALIBRATION_FACING * np.linalg.norm(surface, axis=-1)
        v, u = np.nonzero(is_used & (np.abs(depths - near) < width))
        normal, seen, link = normals[v, u], surface[v, u], links[v, u].astype(np.int64)
        points = seen * (depths[v, u] / near[v, u].astype(np.float64))[:, None]
        jacobian = np.hstack([np.cross(points, normal), normal])
        moving = np.zeros(len(points))
        if before is not None and after is not None:
            velocity = _velocities(before, after, poses, T_world_camera)  # of the links, in the camera's frame
            speed = np.einsum("kij,kj->ki", velocity[link][:, :3, :3], seen) + velocity[link][:, :3, 3]
            moving = np.einsum("ki,ki->k", normal, speed)  # a later clock takes an earlier surface
        return ArmRows(
            residual=np.einsum("ki,ki->k", normal, points - seen),
            jacobian=jacobian,
            clock=moving + jacobian @ camera_twist,
            points=points,
            normals=normal,
            links=link,
            tiles=tiles_of((v + corner[0]) * depth.shape[1] + u + corner[1], depth.shape),
            num_seen=int(is_used.sum()),
            num_hidden=int(np.count_nonzero(is_used & (depths < near - width))),
        )

    def mount_of(self, poses: list[tuple[int, Float64]]) -> tuple[str, Float64] | None:
        """The link that a camera with these stamps [ns] and recorded T_world_camera rides on, and T_link_camera; None
        where it rides on none.
        """
        for link in reversed(self.model.frame_names):
            mounted = [(self.link_pose(link, stamp), T) for stamp, T in poses]
            offsets = np.array([invert_transform(at) @ T for at, T in mounted if at is not None])
            if len(offsets) < max(2, len(poses) // 2):
                continue
            middle = offsets[len(offsets) // 2]
            if np.abs(offsets - middle).max() < fixed.CALIBRATION_MOUNT:
                return link, middle
        return None

    def travel(self, stamps: list[int]) -> float:
        """How far [m] any of the robot's links is from where it is first, at some of these times."""
        places = []
        for stamp in stamps:
            poses = self.surface_poses(stamp)
            if poses is not None:
                tips = [transform_points(T, 0.1 * np.eye(3)) for T in poses]
                places.append(np.concatenate([poses[:, :3, 3], *tips]))
        if len(places) < 2:
            return 0.0
        return float(np.linalg.norm(np.array(places) - places[0], axis=2).max())


def _velocities(before: Float64, after: Float64, poses: Float64, T_world_camera: Float64) -> Float64:
    """(L, 4, 4): what a point fixed to a link moves by in a second, in the camera's frame."""
    T_camera_world = invert_transform(T_world_camera)
    moved = [T_camera_world @ at @ np.linalg.inv(poses) @ T_world_camera for at in (before, after)]
    return np.asarray((moved[1] - moved[0]) / (2e-9 * STEP_NS))


def _around(shows: Bool) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """The part (rows, columns) of an image that shows something, with a border of one pixel, and its corner."""
    rows, columns = (np.flatnonzero(shows.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return (slice(0, 3), slice(0, 3)), (0, 0)
    v, u = max(int(rows[0]) - 1, 0), max(int(columns[0]) - 1, 0)
    return (slice(v, int(rows[-1]) + 2), slice(u, int(columns[-1]) + 2)), (v, u)


def _inside_links(link: NDArray[np.int16], depth: Float32) -> Bool:
    """Pixels whose four neighbours show the same link, and no edge of it between them."""
    inside = np.zeros(link.shape, np.bool_)
    middle = link[1:-1, 1:-1]
    around = (link[1:-1, 2:], link[1:-1, :-2], link[2:, 1:-1], link[:-2, 1:-1])
    inside[1:-1, 1:-1] = (middle >= 0) & np.logical_and.reduce([middle == other for other in around])
    return np.asarray(inside & (bend(depth) < fixed.CALIBRATION_BEND * depth))


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """views: of cameras that stand still one each (`still_frame`), of moving ones several; pairs (i, j) of them that
    may see one surface, where the points of view i are laid on view j; frames: in which the robot is looked for; arm:
    None where it is not known; mounts: the link that a moving camera rides on, and T_link_camera as recorded; moving:
    the cameras that move.
    """

    views: Sequence[DepthView]
    pairs: Sequence[tuple[int, int]]
    frames: Sequence[RgbdFrame] = ()
    arm: Arm | None = None
    mounts: Mapping[str, tuple[str, Float64]] = field(default_factory=dict)
    moving: frozenset[str] = frozenset()

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """All that have a view or a frame."""
        return tuple(sorted({v.camera for v in self.views} | {f.camera for f in self.frames}))

    @cached_property
    def scale(self) -> float:
        """The depth [m] of most points."""
        return float(np.median(np.concatenate([view.points[:, 2] for view in self.views] + [np.ones(1)])))

    def recorded(self, item: DepthView | RgbdFrame, clock: float) -> tuple[Float64, Float64]:
        """T_world_camera (4, 4) of a view or a frame without correction, and how it moves with the clock (6,) [1/s].

        A camera that rides on the robot is where the joint states have it at its stamp by their clock.
        """
        if self.arm is None or item.camera not in self.mounts:
            return item.T_world_camera, np.zeros(POSE)
        link, T_link_camera = self.mounts[item.camera]
        stamp = item.stamp_ns - round(clock * 1e9)
        poses = [self.arm.link_pose(link, stamp + step) for step in (0, -STEP_NS, STEP_NS)]
        now, before, after = (None if pose is None else pose @ T_link_camera for pose in poses)
        if now is None:
            return item.T_world_camera, np.zeros(POSE)
        if before is None or after is None:
            return now, np.zeros(POSE)
        return now, twist_between(after, before) / (2e-9 * STEP_NS)  # a later clock takes an earlier pose

    def thinned(self) -> "Evidence":
        """For a first look: with fewer frames that show the robot, as many of each camera, and fewer pairs."""
        frames = [
            frame
            for camera in self.cameras
            for frame in spread([f for f in self.frames if f.camera == camera], fixed.CALIBRATION_FEW[0])
        ]
        return replace(self, frames=frames, pairs=spread(self.pairs, fixed.CALIBRATION_FEW[1]))


def evidence_of(frames: Sequence[RgbdFrame], arm: Arm | None) -> Evidence:
    """That of some frames of each camera, by stamp, without people. arm: the robot, where it is known."""
    by_camera: dict[str, list[RgbdFrame]] = {}
    for frame in frames:
        by_camera.setdefault(frame.camera, []).append(strided(frame, fixed.CALIBRATION_ROWS))
    moving = moving_cameras(frames)
    mounts = {
        camera: arm.mount_of([(f.stamp_ns, f.T_world_camera) for f in by_camera[camera]])
        for camera in moving
        if arm is not None
    }
    views: list[DepthView] = []
    for camera, its in sorted(by_camera.items()):
        if camera not in moving:
            still = still_frame(its)
            step = _step(still, min(len(its), fixed.CALIBRATION_AVERAGED))
            views.append(DepthView.of(still, fixed.CALIBRATION_POINTS[0], step))
            continue
        for frame in its:
            seen = np.where(_robot_near(frame, arm), np.float32(0.0), frame.depth)
            views.append(DepthView.of(replace(frame, depth=seen), fixed.CALIBRATION_POINTS[1], _step(frame, 1)))
    return Evidence(
        views=views,
        pairs=_pairs(views, moving),
        frames=[
            strided(f, fixed.CALIBRATION_ARM_ROWS) for f in frames if arm is not None and arm.is_posed(f.stamp_ns)
        ],
        arm=arm,
        mounts={camera: mount for camera, mount in mounts.items() if mount is not None},
        moving=moving,
    )


def moving_cameras(frames: Sequence[RgbdFrame]) -> frozenset[str]:
    """Those whose recorded poses differ."""
    first: dict[str, Float64] = {}
    moving = set()
    for frame in frames:
        T = first.setdefault(frame.camera, frame.T_world_camera)
        if np.abs(frame.T_world_camera - T).max() >= fixed.CALIBRATION_MOUNT:
            moving.add(frame.camera)
    return frozenset(moving)


def _step(frame: RgbdFrame, num_averaged: int) -> int:
    """Pixels on either side that normals are taken from: so many that the noise of depth turns them little."""
    depth = frame.depth[frame.depth > 0]
    if not len(depth):
        return 1
    middle = float(np.median(depth))
    noise = float(depth_sigma(np.array(middle))) / np.sqrt(num_averaged)
    pixel = middle / frame.intrinsics.fx
    return int(np.clip(round(0.5 * fixed.CALIBRATION_BASELINE * noise / pixel), 1, frame.depth.shape[0] // 8))


def _robot_near(frame: RgbdFrame, arm: Arm | None) -> Bool:
    """Pixels (h, w) at which the robot may be seen, whatever the camera's pose is off by."""
    poses = None if arm is None else arm.surface_poses(frame.stamp_ns)
    if arm is None or poses is None:
        return np.zeros(frame.depth.shape, np.bool_)
    shown = arm.surface.render(poses, frame.intrinsics, frame.T_world_camera, frame.depth).depth
    if not (shown > 0).any():
        return np.zeros(frame.depth.shape, np.bool_)
    pixels = fixed.CALIBRATION_ASIDE * frame.intrinsics.fx / float(np.median(shown[shown > 0]))
    reach = min(pixels, len(shown) / 8)  # a hand close to its camera would leave nothing
    window = np.ones((2 * int(np.ceil(reach)) + 1,) * 2, np.uint8)
    return np.asarray(cv2.dilate((shown > 0).astype(np.uint8), window) > 0)


def _pairs(views: Sequence[DepthView], moving: frozenset[str]) -> list[tuple[int, int]]:
    """Ordered pairs of views of two cameras, or of one that moves, from different places."""
    still, others = [], []
    for i, a in enumerate(views):
        for j, b in enumerate(views):
            if i == j:
                continue
            if a.camera not in moving and b.camera not in moving:
                still.append((i, j))
            elif np.linalg.norm(a.T_world_camera[:3, 3] - b.T_world_camera[:3, 3]) > fixed.CALIBRATION_APART:
                others.append((i, j))
    return [*still, *spread(others, fixed.CALIBRATION_PAIRS)]
