"""What the cameras of a study see: an arm at rest, through depth cameras that stand nearly where they say."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.jobs.studies.problems import Problem
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.depth_camera import DepthNoise
from splatctrl_cli.simulate.environments import ring_of_cameras
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import START_NS
from splatctrl_cli.simulate.render import Camera, Renderer
from splatctrl_cli.simulate.tabletop import arm_solids
from splatctrl_cli.sources.calibrated import Perturbation

D435 = DepthNoise(baseline=0.05, max_range=6.0)
POSE_ERROR, POSE_TURN = 0.001, 0.05  # [m], [degrees] of each camera: somewhat more than `calibrate` leaves
STEP_NS = 200_000_000  # [ns] between time steps
SEEN_WITHIN = 0.02  # [m] of a measured point: a voxel

Step = tuple[RgbdFrame, ...]


@dataclass(frozen=True, kw_only=True)
class Views:
    """Time steps of frames, one of each camera, with the arm at rest at the problem's start."""

    steps: tuple[Step, ...]

    @property
    def frames(self) -> list[RgbdFrame]:
        """All of them, by time."""
        return [frame for step in self.steps for frame in step]

    def has_seen(self, points_world: Float64) -> list[bool]:
        """Whether a camera measured something within `SEEN_WITHIN` of points (Q, 3)."""
        measured = np.concatenate([_points(frame) for frame in self.steps[0]])
        away = cKDTree(measured).query(points_world)[0] if len(measured) else np.full(len(points_world), np.inf)
        return [bool(each <= SEEN_WITHIN) for each in np.asarray(away)]


def views_of(problem: Problem, num_cameras: int, *, width: int, num_steps: int) -> Views:
    """What the first cameras of the ring see, with noise, and poses as a calibration has them."""
    cameras = ring_of_cameras(num_cameras, width, 3 * width // 4)
    arm = solids_at(problem.model, problem.start)
    return recorded(cameras, problem.primitives, arm, seed=problem.number, num_steps=num_steps)


def solids_at(model: RobotModel, q: Float64) -> list[Primitive]:
    """An arm's shapes as solids at joint positions q (J,)."""
    return arm_solids(model.urdf.shapes, {link: model.frame_pose(q, link) for link in model.urdf.links})


def recorded(
    cameras: Sequence[Camera],
    primitives: Sequence[Primitive],
    arm: Sequence[Primitive],
    *,
    seed: int,
    num_steps: int,
    first: int = 0,
) -> Views:
    """Time steps of frames from the step `first` on, with the noise and the errors of the poses that a seed draws."""
    images = [Renderer(camera, primitives, color_rays=0).image(arm) for camera in cameras]
    calibrated = Perturbation(pose_error=POSE_ERROR, pose_turn=POSE_TURN, seed=seed)
    poses = [calibrated.pose(camera.name, camera.T_world_camera) for camera in cameras]

    def frame(step: int, number: int) -> RgbdFrame:
        camera, (color, depth) = cameras[number], images[number]
        rng = np.random.default_rng([seed, number, step])
        return RgbdFrame(
            stamp_ns=START_NS + STEP_NS * step,
            camera=camera.name,
            color=color,
            depth=D435.applied(depth, rng, focal=camera.intrinsics.fx),
            intrinsics=camera.intrinsics,
            T_world_camera=poses[number],
        )

    steps = range(first, first + num_steps)
    return Views(steps=tuple(tuple(frame(step, n) for n in range(len(cameras))) for step in steps))


def _points(frame: RgbdFrame) -> Float64:
    """(Q, 3) [m], world, that a frame measured."""
    points = back_project(frame.intrinsics, frame.depth)[frame.depth > 0]
    return np.asarray(transform_points(frame.T_world_camera, points))
