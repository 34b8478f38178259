"""A reconstruction: recording to splats, occupancy, audit, snapshots, and a robot's own surface."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.calibration.displacement import correct_pose, displaced_cameras
from splatctrl_cli.calibration.evidence import Arm
from splatctrl_cli.config.fixed import STATES_CLOSE_NS
from splatctrl_cli.errors import InputError, refuse_if, require
from splatctrl_cli.evaluate.verdict import JudgedResult, check_gate_names, plural
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_run
from splatctrl_cli.formats.arrays import savez
from splatctrl_cli.formats.scene.scene_folder import SELF_MODEL
from splatctrl_cli.formats.scene.scene_writer import CHECKPOINT
from splatctrl_cli.jobs.calibrate import depth_frame, frames_nearest, stamps_by_camera
from splatctrl_cli.jobs.reconstruct.reconstruction import Reconstruction, ReconstructRequest, training_cameras
from splatctrl_cli.jobs.reconstruct.verdict import GATED, reconstruct_verdict
from splatctrl_cli.jobs.recordings.open_recording import guessed_unit
from splatctrl_cli.jobs.robot.logged_robot import (
    GIVE_ROBOT,
    NO_SELF_MODEL,
    RobotOptions,
    add_self_model,
    other_frame,
    urdf_of,
)
from splatctrl_cli.jobs.running.device import (
    FitDevice,
    advise_resumption,
    check_resumption,
    checkpoint_to_go_on_from,
    explain_faults,
    identity,
)
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RecordSource, RgbdFrame, spread
from splatctrl_cli.robot.declared_contact import Declarations, read_declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_fusion import REACH, choose_moments, learn
from splatctrl_cli.robot.self_model import SelfModel
from splatctrl_cli.robot.sphere_files import own_spheres
from splatctrl_cli.robot.urdf import read_urdf


def reconstruct(request: ReconstructRequest, progress: Progress = SILENT) -> JudgedResult:
    """Reconstruct into the output folder, or continue an interrupted run. Raises SplatCtrlError.

    Document: scene, metrics, and removed splats by reason.
    """
    check_gate_names(request.require, GATED)
    training_cameras(request.source)
    device = FitDevice(request.device)
    robot = _robot(request, progress)
    declared = declarations_of(request.declare, robot)
    stopwatch, checkpoint_file = Stopwatch(), partial_path(request.out) / CHECKPOINT
    goes_on = check_resumption(checkpoint_file, "run", progress, resume=request.resume)
    with (
        closing(device),
        advise_resumption(checkpoint_file),
        output_path(
            request.out, force=request.force, is_folder=True, checkpoint=CHECKPOINT, resume=request.resume
        ) as partial,
        explain_faults(device, checkpoint_file),
    ):
        inputs = request.source.digests()
        run = _identity(request, inputs)
        checkpoint = checkpoint_to_go_on_from(partial, run) if goes_on else None
        with stopwatch.stage("learn"):
            robot, off = _learn_self(robot, request, partial, progress, is_new=not goes_on)
        fitted = Reconstruction(
            request,
            robot,
            partial,
            identity=run,
            declared=declared,
            checkpoint=checkpoint,
            device=device,
            cameras_off=off,
        )
        if goes_on:
            progress.log(f"{partial}: continues after {fitted.num_read} time steps")
        with closing(fitted.writer):
            with stopwatch.stage("fit_since_resume" if goes_on else "fit"):
                fitted.run(progress)
            with stopwatch.stage("write"):
                fitted.finish()
        for index in [index for table, index in declared.unused() if table == "carried"]:
            progress.log(
                f"warning: {request.declare}: [[carried]] {index + 1}: no pixel of any frame needed it; check its"
                " link and box, or leave it out"
            )
        result = fitted.result()
        verdict = reconstruct_verdict(result, request.require)
        write_run(
            partial,
            command="reconstruct",
            config=fitted.config.as_dict(),
            inputs=inputs,
            metrics=result.metrics,
            stopwatch=stopwatch,
            seed=request.seed,
            verdict=verdict.as_dict(),
        )
    removed = {name: sum(row.removed[name] for row in fitted.rows) for name in fitted.rows[-1].removed}
    return JudgedResult(
        out=request.out,
        metrics=result.metrics,
        document={"scene": request.out, "metrics": result.metrics, "removed": removed},
        verdict=verdict,
        seconds=stopwatch.seconds,
    )


def _identity(request: ReconstructRequest, inputs: Mapping[str, str]) -> dict[str, Any]:
    off = {"learn": False} if request.self_model == NO_SELF_MODEL else {}
    files = {name: getattr(request, name) for name in ("urdf", "spheres", "points", "declare")}
    files |= {"self-model": None if off else request.self_model}
    return identity({"seed": request.seed, **request.options, **off}, files, request.config, inputs)


def _learn_self(
    robot: RobotModel | None, request: ReconstructRequest, folder: Path, progress: Progress, *, is_new: bool
) -> tuple[RobotModel | None, dict[str, dict[str, Any]]]:
    """Add the given, resumed or learned self-model to the robot; find `displaced_cameras`."""
    if robot is None:
        return None, {}
    seen = arm_seen(robot, request.source, progress)
    off = {} if seen is None else displaced_cameras(*seen)
    if seen and is_new and request.self_model is None:
        arm, frames = seen
        try:
            robot = robot.join_self_model(
                learn_from(arm, [correct_pose(f, off) for f in frames], request.source.name)
            )
        except InputError as error:
            progress.log(f"nothing is learned of the robot's own parts: {error.message}")
    if not is_new and request.self_model is None:
        robot = add_self_model(robot, None, folder)
    elif is_new and robot.self_model is not None:
        savez(folder / SELF_MODEL, robot.self_model.arrays())
    return robot, off


def declarations_of(path: Path | None, robot: RobotModel | None) -> Declarations:
    """Read declarations, none without a file. Raises UsageError without a robot."""
    if path is None:
        return Declarations()
    robot = require(robot, f"--declare {path}: needs the robot", **GIVE_ROBOT)
    return read_declarations(path, robot.frame_names)


def _robot(request: ReconstructRequest, progress: Progress) -> RobotModel | None:
    urdf = urdf_of(request.urdf, [request.recording] if request.recording else [], progress)
    if urdf is None:
        request.refuse_without_robot()
        refuse_if(request.self_model not in (None, NO_SELF_MODEL), "--self-model: needs the robot", **GIVE_ROBOT)
        return None
    refuse_if(
        guess := guessed_unit(request.source),
        f"{request.source.name}: {guess}; with a robot, lengths must be measured, in metres",
        remedy="write poses and depth in metres, or leave the robot out",
    )
    try:
        model = request.posed(urdf)
        if request.source.joint_names:
            frames = request.source.tf_frames if isinstance(request.source, FrameSource) else {}
            model = model.moved_by(request.source.joint_names, frames)
            model.joint_columns(request.source.joint_names)
        model = add_self_model(model, request.self_model)
        if request.urdf is None:
            refuse_if(
                words := other_frame(urdf, request.source) if request.base is None else "",
                f"{urdf.path}: {words}",
                remedy=f"give --world-frame {urdf.root}, or --base with its pose",
            )
            _check_has_states(request.source)
            progress.log(f"the robot is the log's own: {urdf.path}")
        notes = model.surface.notes
    except InputError as error:
        if any((request.urdf, request.spheres, request.self_model)):
            raise
        progress.log(f"warning: the robot stays in the map: {error.message}; {error.remedy}")  # not requested
        return None
    for doubt in model.doubts:
        progress.log(f"warning: {doubt}")
    for note in notes:
        progress.log(f"warning: {note}; correct the URDF")
    return model


def _check_has_states(source: RecordSource) -> None:
    refuse_if(
        not source.joint_names, f"{source.name}: expected joint states, got none", remedy="record /joint_states"
    )


@dataclass(frozen=True, kw_only=True)
class LearnRequest(RobotOptions):
    """Learn the self-model of the robot `urdf` from `log` into `out`.

    reach [m]: how far outside a link's visual surface to look for parts.
    """

    log: Path
    urdf: Path
    out: Path = Path("self.npz")
    options: SourceOptions = field(default_factory=SourceOptions)
    reach: float = REACH
    force: bool = False


def learn_robot(request: LearnRequest, progress: Progress = SILENT) -> SelfModel:
    """Learn and write the self-model. Raises InputError if no link moves."""
    urdf = read_urdf(request.urdf)
    model = request.posed(urdf, own_spheres(urdf))
    with output_path(request.out, force=request.force, is_folder=False) as partial:
        source = open_source(request.log, request.options)
        _check_has_states(source)
        arm = arm_of(model.moved_by(source.joint_names, source.tf_frames), source)
        frames = frames_of(arm, source, progress)
        off = displaced_cameras(arm, frames)
        learned = learn_from(arm, [correct_pose(frame, off) for frame in frames], source.name, request.reach)
        savez(partial, learned.arrays())
    return learned


def arm_of(model: RobotModel, source: FrameSource) -> Arm:
    return Arm(
        model, source.states.convert_joints(*model.joint_columns(source.joint_names)).postures(STATES_CLOSE_NS)
    )


def arm_seen(model: RobotModel, source: RecordSource, progress: Progress) -> tuple[Arm, list[RgbdFrame]] | None:
    """Arm of a log, and frames to measure it by.

    None without meshes, a log of joints, or (with a log line) posed frames.
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
    """Frames at the moments with the largest motion between them.

    Raises InputError if no frame is posed.
    """
    stamps = stamps_by_camera(source)
    stamps = {camera: its for camera, its in stamps.items() if camera in training_cameras(source)}
    surfaces = [(stamp, arm.surface_poses(stamp)) for stamp in spread(min(stamps.values(), key=len), 2000)]
    posed = [(stamp, T) for stamp, T in surfaces if T is not None]
    refuse_if(not posed, f"{source.name}: no frame has a joint state within {1e-9 * STATES_CLOSE_NS:g} s")
    order = choose_moments(arm.surface, np.array([T for _, T in posed]))
    chosen = frames_nearest(stamps, [posed[number][0] for number in order])
    frames = [
        depth_frame(item)
        for item in source.stored()
        if isinstance(item, StoredFrame)
        and (item.camera, item.stamp_ns) in chosen
        and arm.posture(item.stamp_ns) is not None
    ]
    progress.log(f"compares the robot with depth in {plural(len(frames), 'frame')} of {plural(len(order), 'moment')}")
    return frames
