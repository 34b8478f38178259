"""What a calibration solves for, and where each of it stands in the vector of unknowns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from splatctrl_cli.geometry import invert_transform, pose_at
from splatctrl_cli.records import Float64, Index

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
            own = step[self.columns(camera)[:POSE]]
            corrections[camera] = corrections[camera] @ transform_of(own)
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
