"""The job of `robot learn`: it chooses frame sets in which the arm has moved, and fuses what they show of it."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatctrl_cli.config.fixed import STATES_CLOSE_NS
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import output_path
from splatctrl_cli.formats.arrays import savez
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.calibrate import depth_frame, frames_nearest, stamps_by_camera
from splatctrl_cli.jobs.reconstruct.reconstruction import training_cameras
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, RgbdFrame, SphereSet, spread
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_fusion import REACH, choose_moments, learn
from splatctrl_cli.robot.self_model import SelfModel

MOST_MOMENTS = 2000  # of a recording, among which those are chosen that are read


@dataclass(frozen=True, kw_only=True)
class LearnRequest(RobotOptions):
    """Learn the self-model of the robot `urdf` from `log` into the file `out`.

    reach [m]: how far outside of a link's visual surface its parts are looked for.
    """

    log: Path
    urdf: Path
    out: Path = Path("self.npz")
    options: SourceOptions = field(default_factory=SourceOptions)
    reach: float = REACH
    force: bool = False


def learn_robot(request: LearnRequest, progress: Progress = SILENT) -> SelfModel:
    """Learn and write the self-model. Raises InputError for a recording that shows no link moving."""
    model = RobotModel.from_urdf(
        request.urdf,
        request.spheres or SphereSet(links=(), centers=np.zeros((0, 3)), radii=np.zeros(0)),
        T_world_base=None if request.base is None else transform_from(request.base[:3], request.base[3:]),
        locked=request.locked,
        packages=request.packages,
    )
    with output_path(request.out, force=request.force, is_folder=False) as partial:
        source = open_source(request.log, request.options)
        if not source.joint_names:
            raise InputError(f"{source.name}: expected joint states, got none", remedy="record /joint_states")
        found = learn_from(model.moved_by(source.joint_names), source, progress, reach=request.reach)
        savez(partial, found.arrays())
    return found


def learn_from(
    model: RobotModel, source: FrameSource, progress: Progress = SILENT, *, reach: float = REACH
) -> SelfModel:
    """The self-model of a robot by a log that moves its joints. Raises InputError where no link can be learned."""
    frames, T_world_link = _read(model, source, progress)
    return learn(model.surface, model.urdf.links, frames, T_world_link, name=source.name, reach=reach)


def _read(model: RobotModel, source: FrameSource, progress: Progress) -> tuple[list[RgbdFrame], Float64]:
    """Frames of the moments between which the arm moved farthest, by stamp, and the poses (V, L, 4, 4) of the links
    of its surface.
    """
    posture = source.states.of_log(*model.joint_columns(source.joint_names)).postures(STATES_CLOSE_NS)
    surface, stamps = model.surface, stamps_by_camera(source)
    stamps = {camera: its for camera, its in stamps.items() if camera in training_cameras(source)}

    def placed(stamp_ns: int) -> Float64 | None:
        q = posture(stamp_ns)
        return None if q is None else surface.poses({link: model.frame_pose(q, link) for link in surface.links})

    found = [(stamp, placed(stamp)) for stamp in spread(min(stamps.values(), key=len), MOST_MOMENTS)]
    posed = [(stamp, T) for stamp, T in found if T is not None]
    if not posed:
        raise InputError(f"{source.name}: no frame has a joint state within {1e-9 * STATES_CLOSE_NS:g} s")
    order = choose_moments(surface, np.array([T for _, T in posed]))
    chosen = frames_nearest(stamps, [posed[number][0] for number in order])
    frames, poses = [], []
    for item in source.stored():
        if isinstance(item, StoredFrame) and (item.camera, item.stamp_ns) in chosen:
            T = placed(item.stamp_ns)
            if T is not None:
                frames.append(depth_frame(item))
                poses.append(T)
    progress.log(f"robot learn: {len(frames)} frames, moments: {len(order)}")
    return frames, np.array(poses)
