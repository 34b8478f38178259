"""A reconstruction from its request to its result: a recording into splats, occupancy, audit and snapshots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatctrl_cli.config import Config
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.gates import check_gate_names
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_run
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.reconstruct_verdict import GATED, Reconstructed, reconstruct_verdict
from splatctrl_cli.jobs.reconstruction import Reconstruction, training_cameras
from splatctrl_cli.jobs.resume import checkpoint_to_go_on_from, identity, told_how_to_go_on
from splatctrl_cli.logs.stored_frame import FrameSource
from splatctrl_cli.records import Box, RecordSource
from splatctrl_cli.robot.declared import Declarations, read_declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.consistency import largest_jump
from splatctrl_cli.scene_files.scene_writer import CHECKPOINT
from splatctrl_cli.splat_files.points import read_points


@dataclass(frozen=True, kw_only=True)
class ReconstructRequest:
    """One reconstruction of `source` into the folder `out`.

    urdf, spheres: the robot, whose splats are told apart and whose reach is the workspace unless `box` is given.
    points: a coloured cloud to start from, instead of depth. declare: a TOML of what the robot carries. resume: go on
    with what an interrupted run left. require: gates on its metrics. options: what else decides the bytes, by the
    names of the options: a run that is resumed must have the same.
    """

    source: RecordSource
    out: Path
    config: Config = field(default_factory=Config)
    urdf: Path | None = None
    spheres: Path | None = None
    box: Box | None = None
    points: Path | None = None
    declare: Path | None = None
    allow_disagreement: bool = False
    force: bool = False
    resume: bool = False
    seed: int = 0
    threads: int = 0
    require: Sequence[str] = ()
    options: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ReconstructResult:
    """The scene folder `out`, its metrics and verdict as in ``run.json``, splats removed by reason, and wall time by
    stage [s].
    """

    out: Path
    metrics: Mapping[str, Any]
    verdict: Verdict
    removed: Mapping[str, int]
    seconds: Mapping[str, float]


def reconstruct(request: ReconstructRequest, progress: Progress = SILENT) -> ReconstructResult:
    """Reconstruct into the output folder, or go on with what an interrupted run left of it.

    Raises SplatCtrlError for a recording that cannot be reconstructed.
    """
    source, config = request.source, request.config
    check_gate_names(request.require, GATED)
    training_cameras(source)
    robot = _robot(request)
    for doubt in () if robot is None else robot.doubts:
        progress.log(f"warning: {doubt}")
    if robot is not None and robot.surface.by_spheres:
        links = ", ".join(robot.surface.by_spheres)
        progress.log(f"warning: spheres stand for {links}: their collision geometry is missing or cannot be read")
    declared = declarations_of(request.declare, robot)
    stopwatch = Stopwatch()
    checkpoint_file = partial_path(request.out) / CHECKPOINT
    goes_on = _goes_on(request, checkpoint_file, progress)
    with (
        told_how_to_go_on(checkpoint_file),
        output_path(
            request.out, force=request.force, is_folder=True, checkpoint=CHECKPOINT, resume=request.resume
        ) as partial,
    ):
        inputs = source.digests()
        files = {
            "urdf": request.urdf,
            "spheres": request.spheres,
            "points": request.points,
            "declare": request.declare,
        }
        run_identity = identity({"seed": request.seed, **request.options}, files, config, inputs)
        fitted = Reconstruction(
            source,
            robot,
            config,
            partial,
            box=request.box,
            cloud=None if request.points is None else read_points(request.points),
            seed=request.seed,
            threads=request.threads,
            identity=run_identity,
            allow_disagreement=request.allow_disagreement,
            declared=declared,
            checkpoint=checkpoint_to_go_on_from(partial, run_identity) if goes_on else None,
        )
        if goes_on:
            progress.log(f"{partial}: goes on after {fitted.num_read} time steps")
        with stopwatch.stage("fit_since_resume" if goes_on else "fit"):
            fitted.run(progress)
        with stopwatch.stage("write"):
            fitted.finish()
        metrics = fitted.metrics()
        for table, index in declared.unused():
            if table == "carried":
                progress.log(f"warning: {request.declare}: [[carried]] {index + 1}: no pixel of any frame needed it")
        made = Reconstructed(
            metrics=metrics,
            rows=fitted.rows,
            config=config,
            loss=source.loss,
            is_seeded=request.points is not None,
        )
        verdict = reconstruct_verdict(made, request.require)
        write_run(
            partial,
            command="reconstruct",
            config=config.as_dict(),
            inputs=inputs,
            metrics=metrics,
            stopwatch=stopwatch,
            seed=request.seed,
            verdict=verdict.as_dict(),
        )
    return ReconstructResult(
        out=request.out,
        metrics=metrics,
        verdict=verdict,
        removed={name: sum(row.removed[name] for row in fitted.rows) for name in fitted.rows[-1].removed},
        seconds=stopwatch.seconds,
    )


def declarations_of(path: Path | None, robot: RobotModel | None) -> Declarations:
    """What a file declares; nothing without one. Raises UsageError where there is no robot that it could be of."""
    if path is None:
        return Declarations()
    if robot is None:
        raise UsageError(f"--declare {path}: belongs to a robot", remedy="give its --urdf as well")
    return read_declarations(path, robot.frame_names)


def _goes_on(request: ReconstructRequest, checkpoint_file: Path, progress: Progress) -> bool:
    """Whether there is a checkpoint to go on from, and that was asked for."""
    partial = partial_path(request.out)
    if request.resume and not checkpoint_file.is_file():
        progress.log(f"{partial}: has no checkpoint to go on from; starts at the beginning")
    elif checkpoint_file.is_file() and not request.resume:
        progress.log(f"warning: {partial}: an interrupted run is replaced; --resume would have continued it")
    return request.resume and checkpoint_file.is_file()


def _robot(request: ReconstructRequest) -> RobotModel | None:
    if request.urdf is None:
        if request.spheres is not None:
            raise UsageError(f"--spheres {request.spheres}: belongs to a robot", remedy="give its --urdf as well")
        return None
    model = RobotModel.from_urdf(request.urdf, request.spheres)
    if request.source.joint_names:
        model.joint_order(request.source.joint_names)
    return model


def check_pose_jumps(source: FrameSource, limit: float) -> None:
    """Raise InputError for a camera that is suddenly elsewhere; where nobody knows when, views may lie anywhere."""
    if not limit > 0:
        raise UsageError(f"--max-pose-jump: expected metres, got {limit}")
    jump = largest_jump(source.poses()) if source.has_clock else None
    if jump is not None and jump.distance > limit:
        later = (jump.after_ns - jump.before_ns) * 1e-9
        raise InputError(
            f"{source.name}: camera {jump.camera} jumps by {jump.distance:.2f} m from stamp {jump.before_ns} to"
            f" {jump.after_ns} ns, {later:.3g} s later (expected at most {limit:g} m)",
            remedy=f"correct the poses, leave the camera out with --cameras, or give --max-pose-jump"
            f" {jump.distance + 0.01:.2f}",
        )
