"""Learning a robot's own surface: choose frame sets of distinct postures, and fuse them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatctrl_cli.calibration.displacement import displaced_cameras, placed
from splatctrl_cli.calibration.evidence import Arm
from splatctrl_cli.config.fixed import STATES_CLOSE_NS
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.verdict import counted
from splatctrl_cli.files.output import output_path
from splatctrl_cli.formats.arrays import savez
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.calibrate import depth_frame, frames_nearest, stamps_by_camera
from splatctrl_cli.jobs.reconstruct.reconstruction import training_cameras
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RecordSource, RgbdFrame, spread
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_fusion import REACH, choose_moments, learn
from splatctrl_cli.robot.self_model import SelfModel
from splatctrl_cli.robot.sphere_files import own_spheres
from splatctrl_cli.robot.urdf import read_urdf


@dataclass(frozen=True, kw_only=True)
class LearnRequest(RobotOptions):
    """Learn the self-model of the robot `urdf` from `log` into `out`.

    reach [m]: how far outside a link's visual surface parts are sought.
    """

    log: Path
    urdf: Path
    out: Path = Path("self.npz")
    options: SourceOptions = field(default_factory=SourceOptions)
    reach: float = REACH
    force: bool = False


def learn_robot(request: LearnRequest, progress: Progress = SILENT) -> SelfModel:
    """Learn and write the self-model. Raises InputError if no link moves."""
    model = RobotModel.from_urdf(
        request.urdf,
        request.spheres or own_spheres(read_urdf(request.urdf)),
        T_world_base=None if request.base is None else transform_from(request.base[:3], request.base[3:]),
        locked=request.locked,
        packages=request.packages,
    )
    with output_path(request.out, force=request.force, is_folder=False) as partial:
        source = open_source(request.log, request.options)
        if not source.joint_names:
            raise InputError(f"{source.name}: expected joint states, got none", remedy="record /joint_states")
        arm = arm_of(model.moved_by(source.joint_names), source)
        frames = frames_of(arm, source, progress)
        off = displaced_cameras(arm, frames)
        found = learn_from(arm, [placed(frame, off) for frame in frames], source.name, request.reach)
        savez(partial, found.arrays())
    return found


def arm_of(model: RobotModel, source: FrameSource) -> Arm:
    """The robot with a log's joint positions."""
    return Arm(model, source.states.of_log(*model.joint_columns(source.joint_names)).postures(STATES_CLOSE_NS))


def arm_seen(model: RobotModel, source: RecordSource, progress: Progress) -> tuple[Arm, list[RgbdFrame]] | None:
    """`arm_of` a log and its `frames_of`.

    None without meshes, without a log that moves the robot, or (logged) without posed frames.
    """
    if not isinstance(source, LOGGED) or not source.joint_names or not model.surface.trees:
        return None
    arm = arm_of(model, source)
    try:
        return arm, frames_of(arm, source, progress)
    except InputError as error:
        progress.log(f"the robot is not measured: {error.message}")
        return None


def learn_from(arm: Arm, frames: Sequence[RgbdFrame], name: str, reach: float = REACH) -> SelfModel:
    """Learn the self-model from posed frames. Raises InputError if no link can be learned."""
    poses = np.array([arm.surface_poses(frame.stamp_ns) for frame in frames])
    return learn(arm.surface, arm.model.urdf.links, frames, poses, name=name, reach=reach)


def frames_of(arm: Arm, source: FrameSource, progress: Progress = SILENT) -> list[RgbdFrame]:
    """Frames of the moments with the most motion between them, by stamp.

    Raises InputError if no frame is posed.
    """
    stamps = stamps_by_camera(source)
    stamps = {camera: its for camera, its in stamps.items() if camera in training_cameras(source)}
    found = [(stamp, arm.surface_poses(stamp)) for stamp in spread(min(stamps.values(), key=len), 2000)]
    posed = [(stamp, T) for stamp, T in found if T is not None]
    if not posed:
        raise InputError(f"{source.name}: no frame has a joint state within {1e-9 * STATES_CLOSE_NS:g} s")
    order = choose_moments(arm.surface, np.array([T for _, T in posed]))
    chosen = frames_nearest(stamps, [posed[number][0] for number in order])
    frames = [
        depth_frame(item)
        for item in source.stored()
        if isinstance(item, StoredFrame) and (item.camera, item.stamp_ns) in chosen and arm.is_posed(item.stamp_ns)
    ]
    progress.log(f"the robot is measured in {counted(len(frames), 'frame')} of {counted(len(order), 'moment')}")
    return frames
