"""What of a recording a calibration rests on: views laid over each other, and frames that show the robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np

from splatctrl_cli.calibration.arm import STEP_NS, Arm, twist_by_clock
from splatctrl_cli.calibration.unknowns import POSE
from splatctrl_cli.calibration.views import DepthView, depth_sigma, still_frame, strided
from splatctrl_cli.config import fixed
from splatctrl_cli.records import Bool, Float64, RgbdFrame, spread


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
        return now, np.zeros(POSE) if before is None or after is None else twist_by_clock(before, after)

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
    mounts = {camera: _mount(arm, by_camera[camera]) for camera in moving} if arm is not None else {}
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


def _mount(arm: Arm | None, frames: Sequence[RgbdFrame]) -> tuple[str, Float64] | None:
    return None if arm is None else arm.mount_of([(frame.stamp_ns, frame.T_world_camera) for frame in frames])


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
