"""Evidence of a calibration (overlapping views, the arm's links), and its unknowns."""

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
FIXED = -1


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Poses, depth corrections and clock offset.

    corrections: T_recorded_camera (4, 4). depth: scale and bias [m]. clock [s]: a frame's stamp minus the joint
    state's at that instant.
    """

    corrections: Mapping[str, Float64]
    depth: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    clock: float = 0.0

    def depth_of(self, camera: str) -> tuple[float, float]:
        """Scale and bias [m]."""
        return self.depth.get(camera, (1.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Unknowns of a calibration: `poses`, depth `scales` and `biases` by camera, and the clock."""

    cameras: Sequence[str]
    poses: Sequence[str]
    scales: Sequence[str] = ()
    biases: Sequence[str] = ()
    has_clock: bool = False

    @property
    def size(self) -> int:
        return POSE * len(self.poses) + len(self.scales) + len(self.biases) + self.has_clock

    def columns(self, camera: str) -> Index:
        """The columns (8,) of a camera's unknowns, `FIXED` if fixed."""
        at = np.full(OF_CAMERA, FIXED)
        if camera in self.poses:
            at[:POSE] = POSE * self.poses.index(camera) + np.arange(POSE)
        first = POSE * len(self.poses)
        for number, named in enumerate((self.scales, self.biases)):
            if camera in named:
                at[POSE + number] = first + named.index(camera)
            first += len(named)
        return at

    def moved(self, estimate: Estimate, step: Float64) -> Estimate:
        corrections, depth = dict(estimate.corrections), dict(estimate.depth)
        for camera in self.poses:
            corrections[camera] = corrections[camera] @ transform_of(step[self.columns(camera)[:POSE]])
        for camera in dict.fromkeys((*self.scales, *self.biases)):
            columns = self.columns(camera)[POSE:]
            scale, bias = np.where(columns < 0, 0.0, step[columns])
            depth[camera] = (estimate.depth_of(camera)[0] + scale, estimate.depth_of(camera)[1] + bias)
        return Estimate(
            corrections=corrections, depth=depth, clock=estimate.clock + (float(step[-1]) if self.has_clock else 0.0)
        )


def transform_of(twist: Float64) -> Float64:
    """T (4, 4) of a rotation vector [rad] and a translation [m] (6,)."""
    return pose_at(twist[3:], cv2.Rodrigues(np.asarray(twist[:3], np.float64))[0])


def twist_of(T: Float64) -> Float64:
    """The rotation vector [rad] and translation [m] (6,) of T (4, 4)."""
    return np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]])


def twist_between(T_before: Float64, T_after: Float64) -> Float64:
    """The twist (6,) from one pose (4, 4) to another, applied on the right."""
    return twist_of(invert_transform(T_before) @ T_after)


REMEMBERED = 1024  # times, at which the links' poses are kept: the rounds after the clock is found ask for the same
STEP_NS = 10_000_000  # [ns] before and after, from which a velocity is taken: less than the time between two states


@dataclass(frozen=True, kw_only=True)
class ArmRows:
    """Distances of M points from the robot's surface: residual (M,) [m], positive outside.

    jacobian (M, 6): by the camera's rotation and translation, own frame. clock (M,) [m/s]: by the clock. points,
    normals (M, 3): camera frame. num_seen: pixels that should show the robot. num_hidden: pixels of num_seen with
    depth over `width` nearer.
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
    """A robot with a recording's joint positions, in model order."""

    def __init__(self, model: RobotModel, posture: Posture) -> None:
        self.model = model
        self.surface = model.surface
        self.posture = posture
        self._vague = np.array(sorted(self.surface.vague), dtype=np.int64)
        self.surface_poses = lru_cache(maxsize=REMEMBERED)(self._surface_poses)

    def link_pose(self, link: str, stamp_ns: int) -> Float64 | None:
        """T_world_link (4, 4) at a time [ns]; None without joint positions."""
        q = self.posture(stamp_ns)
        return None if q is None else self.model.frame_pose(q, link)

    def _surface_poses(self, stamp_ns: int) -> Float64 | None:
        q = self.posture(stamp_ns)
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
        """Rows of pixels within `width` [m] of the robot's rendered surface; None without joint states.

        stamp_ns: of the joint states. camera_twist (6,) [1/s]: the camera's motion per second of clock, own frame.
        Link borders, and links modelled by spheres or boxes, do not count.
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
        """The link that carries a camera, and T_link_camera (4, 4); or None.

        poses: stamps [ns] and T_world_camera (4, 4).
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
        """The largest distance [m] of any link from its first pose."""
        posed = [poses for stamp in stamps if (poses := self.surface_poses(stamp)) is not None]
        places = [
            np.concatenate([poses[:, :3, 3], *[transform_points(T, 0.1 * np.eye(3)) for T in poses]])
            for poses in posed
        ]
        return 0.0 if len(places) < 2 else float(np.linalg.norm(np.array(places) - places[0], axis=2).max())


def _velocities(before: Float64, after: Float64, poses: Float64, T_world_camera: Float64) -> Float64:
    """Velocity matrices (L, 4, 4) [1/s] of points fixed to each link, camera frame."""
    T_camera_world = invert_transform(T_world_camera)
    moved = [T_camera_world @ at @ np.linalg.inv(poses) @ T_world_camera for at in (before, after)]
    return np.asarray((moved[1] - moved[0]) / (2e-9 * STEP_NS))


def _around(shows: Bool) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Bounding part (rows, columns) of `shows` with a one-pixel border, and its corner."""
    rows, columns = (np.flatnonzero(shows.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return (slice(0, 3), slice(0, 3)), (0, 0)
    v, u = max(int(rows[0]) - 1, 0), max(int(columns[0]) - 1, 0)
    return (slice(v, int(rows[-1]) + 2), slice(u, int(columns[-1]) + 2)), (v, u)


def _inside_links(link: NDArray[np.int16], depth: Float32) -> Bool:
    inside = np.zeros(link.shape, np.bool_)
    middle = link[1:-1, 1:-1]
    around = (link[1:-1, 2:], link[1:-1, :-2], link[2:, 1:-1], link[:-2, 1:-1])
    inside[1:-1, 1:-1] = (middle >= 0) & np.logical_and.reduce([middle == other for other in around])
    return np.asarray(inside & (bend(depth) < fixed.CALIBRATION_BEND * depth))


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Views, frames and robot of a calibration.

    views: one per stationary camera (`still_frame`), several per moving one. pairs (i, j): points of view i are
    compared with view j. frames: searched for the robot. mounts: link of a camera on the robot, and recorded
    T_link_camera.
    """

    views: Sequence[DepthView]
    pairs: Sequence[tuple[int, int]]
    frames: Sequence[RgbdFrame] = ()
    arm: Arm | None = None
    mounts: Mapping[str, tuple[str, Float64]] = field(default_factory=dict)
    moving: frozenset[str] = frozenset()

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        return tuple(sorted({v.camera for v in self.views} | {f.camera for f in self.frames}))

    @cached_property
    def scale(self) -> float:
        """The median depth [m]."""
        return float(np.median(np.concatenate([view.points[:, 2] for view in self.views] + [np.ones(1)])))

    def recorded(self, item: DepthView | RgbdFrame, clock: float) -> tuple[Float64, Float64]:
        """Uncorrected T_world_camera (4, 4), and its motion (6,) [1/s] per second of clock.

        Joint states place a camera on the robot, at the camera's stamp minus `clock` [s].
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
        """Fewer pairs and robot frames, for a first look."""
        return replace(
            self,
            frames=[
                frame
                for camera in self.cameras
                for frame in spread([f for f in self.frames if f.camera == camera], fixed.CALIBRATION_FEW[0])
            ],
            pairs=spread(self.pairs, fixed.CALIBRATION_FEW[1]),
        )


def evidence_of(frames: Sequence[RgbdFrame], arm: Arm | None) -> Evidence:
    """Evidence from frames without people, in order of stamp."""
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
            views.append(
                DepthView.of(
                    replace(frame, depth=np.where(_robot_near(frame, arm), np.float32(0.0), frame.depth)),
                    fixed.CALIBRATION_POINTS[1],
                    _step(frame, 1),
                )
            )
    return Evidence(
        views=views,
        pairs=_pairs(views, moving),
        frames=[
            strided(f, fixed.CALIBRATION_ARM_ROWS)
            for f in frames
            if arm is not None and arm.posture(f.stamp_ns) is not None
        ],
        arm=arm,
        mounts={camera: mount for camera, mount in mounts.items() if mount is not None},
        moving=moving,
    )


def moving_cameras(frames: Sequence[RgbdFrame]) -> frozenset[str]:
    first: dict[str, Float64] = {}
    moving = set()
    for frame in frames:
        T = first.setdefault(frame.camera, frame.T_world_camera)
        if np.abs(frame.T_world_camera - T).max() >= fixed.CALIBRATION_MOUNT:
            moving.add(frame.camera)
    return frozenset(moving)


def _step(frame: RgbdFrame, num_averaged: int) -> int:
    depth = frame.depth[frame.depth > 0]
    if not len(depth):
        return 1
    middle = float(np.median(depth))
    noise = float(depth_sigma(np.array(middle))) / np.sqrt(num_averaged)
    pixel = middle / frame.intrinsics.fx
    return int(np.clip(round(0.5 * fixed.CALIBRATION_BASELINE * noise / pixel), 1, frame.depth.shape[0] // 8))


def _robot_near(frame: RgbdFrame, arm: Arm | None) -> Bool:
    poses = None if arm is None else arm.surface_poses(frame.stamp_ns)
    shown = np.zeros(frame.depth.shape, np.float32)
    if arm is not None and poses is not None:
        shown = arm.surface.render(poses, frame.intrinsics, frame.T_world_camera, frame.depth).depth
    if not (shown > 0).any():
        return np.zeros(frame.depth.shape, np.bool_)
    pixels = fixed.CALIBRATION_ASIDE * frame.intrinsics.fx / float(np.median(shown[shown > 0]))
    reach = min(pixels, len(shown) / 8)  # a hand close to its camera would leave nothing
    return np.asarray(
        cv2.dilate((shown > 0).astype(np.uint8), np.ones((2 * int(np.ceil(reach)) + 1,) * 2, np.uint8)) > 0
    )


def _pairs(views: Sequence[DepthView], moving: frozenset[str]) -> list[tuple[int, int]]:
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
