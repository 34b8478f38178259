"""Maps to measure on: random maps, and the map of the sample log's beginning."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import islice

import numpy as np

from benchmarks.measure import SAMPLE
from splatctrl_cli.config import Config
from splatctrl_cli.kernels.raster import TargetView
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import Float32, Float64, Intrinsics, JointState, Label, RgbdFrame, SplatSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import make_view
from splatctrl_cli.scene.render import camera_array
from splatctrl_cli.scene.seeding import inside_workspace
from splatctrl_cli.scene.time_steps import time_steps
from tests.plain import plain_splats

TRAINING = ("cam0", "cam1", "cam2")
VGA = Intrinsics(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
WALL = 1.2  # [m] from the camera to the random map


@dataclass(frozen=True, kw_only=True)
class FitProblem:
    """A map as the optimiser holds it, parameters (N, 8), and a view to fit it to."""

    name: str
    parameters: Float32
    camera: Float64
    target: TargetView


def wall_problem(num_splats: int) -> FitProblem:
    """A wall of random splats that fills a 640x480 view. Their radii are 0.95 of the mean spacing, so that layers per
    pixel do not depend on their number. Opacities are 0.3 to 0.95.
    """
    rng = np.random.default_rng(num_splats)
    half = 1.05 * WALL * np.array([VGA.width / VGA.fx, VGA.height / VGA.fy]) / 2
    spacing = float(np.sqrt(4 * half.prod() / num_splats))
    opacity = rng.uniform(0.3, 0.95, num_splats)
    parameters = np.column_stack(
        [
            rng.uniform(-half, half, (num_splats, 2)),
            WALL + rng.uniform(0.0, 0.05, num_splats),
            np.full(num_splats, np.log(0.95 * spacing)),
            rng.uniform(0.0, 1.0, (num_splats, 3)),
            np.log(opacity / (1 - opacity)),
        ]
    ).astype(np.float32)
    target = TargetView(
        color=rng.integers(0, 256, (3, VGA.height, VGA.width), np.uint8),
        depth=np.full((VGA.height, VGA.width), WALL, np.float32),
        counted=np.ones((VGA.height, VGA.width), np.uint8),
    )
    return FitProblem(
        name=f"random wall, {num_splats} splats, 640x480",
        parameters=parameters,
        camera=camera_array(VGA, np.eye(4)),
        target=target,
    )


@cache
def sample_fitter(config: Config | None = None) -> SceneFitter:
    """The fitter after the first three time steps of the sample log, with the robot's reach as workspace."""
    robot, config = sample_robot(), config or Config()
    fitter = SceneFitter(config.scene, config.occupancy, robot.reach_box)
    source = open_source(SAMPLE / "log.mcap")
    for step in islice(time_steps(source.records(), TRAINING, has_clock=source.has_clock), 3):
        fitter.step(step.frames)
    return fitter


def sample_problem(num_splats: int) -> FitProblem:
    """The sample log's own map with a budget of `num_splats`, nearly all of it in use, and the newest view of its
    first camera, enlarged to 640x480.
    """
    config = Config()
    scene = replace(config.scene, max_splats=num_splats, fill=1.0, gap_reserve=0.0)
    fitter = sample_fitter(replace(config, scene=scene))
    frame = enlarged(fitter.window.newest[0].frame)
    mappable = inside_workspace(frame, fitter.workspace, config.occupancy.min_range)
    view = make_view(frame, mappable)
    height, width = view.target.depth.shape
    return FitProblem(
        name=f"sample log, {len(fitter.splats())} splats, {width}x{height}",
        parameters=fitter.buffer.parameters.copy(),
        camera=view.camera,
        target=view.target,
    )


def enlarged(frame: RgbdFrame) -> RgbdFrame:
    """A frame with four pixels for each of its own; the ray through an old pixel's centre passes the common corner of
    its four.
    """
    k = frame.intrinsics
    return replace(
        frame,
        color=np.repeat(np.repeat(frame.color, 2, axis=0), 2, axis=1),
        depth=np.repeat(np.repeat(frame.depth, 2, axis=0), 2, axis=1),
        intrinsics=Intrinsics(
            fx=2 * k.fx, fy=2 * k.fy, cx=2 * k.cx + 0.5, cy=2 * k.cy + 0.5, width=2 * k.width, height=2 * k.height
        ),
    )


@cache
def sample_robot() -> RobotModel:
    """The sample log's arm, its fingers held."""
    names = [f"panda_joint{number}" for number in range(1, 8)]
    return RobotModel.from_urdf(SAMPLE / "robot.urdf", SAMPLE / "robot_spheres.yaml").moved_by(names)


@cache
def sample_states() -> tuple[JointState, ...]:
    """Its logged joint states, in the model's order."""
    source, model = open_source(SAMPLE / "log.mcap"), sample_robot()
    order = [source.joint_names.index(name) for name in model.joint_names]
    return tuple(
        JointState(stamp_ns=r.stamp_ns, position=r.position[order], velocity=r.velocity[order])
        for r in source.records()
        if isinstance(r, JointState)
    )


def surface_splats(num_splats: int) -> SplatSet:
    """Splats of 1 cm on a table of 1.2 m and on a box and a ball that stand on it."""
    rng = np.random.default_rng(7)
    table = np.column_stack([rng.uniform(-0.6, 0.6, (num_splats // 2, 2)), np.zeros(num_splats // 2)])
    ball = rng.normal(size=(num_splats // 4, 3))
    ball = 0.15 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0.25, 0.2, 0.15]
    box = rng.uniform(-1.0, 1.0, (num_splats - len(table) - len(ball), 3))
    axis = rng.integers(0, 3, len(box))
    box[np.arange(len(box)), axis] = np.sign(box[np.arange(len(box)), axis])
    box = box * [0.1, 0.15, 0.2] + [-0.2, -0.1, 0.2]
    centers = np.concatenate([table, ball, box]).astype(np.float32)
    return plain_splats(centers, 0.01, colors=0.5, labels=Label.OBJECT)
