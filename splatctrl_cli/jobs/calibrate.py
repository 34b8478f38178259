"""A calibration: cameras against each other and the robot."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatctrl_cli.calibration.board import Board, Rig, Sighting, board_start, other_size, sighting_of
from splatctrl_cli.calibration.calibration_file import CalibratedCamera, Calibration, calibration_text
from splatctrl_cli.calibration.certainty import plane_of, unobserved
from splatctrl_cli.calibration.evidence import Arm, Estimate, Evidence, evidence_of, moving_cameras, twist_of
from splatctrl_cli.calibration.solution import Solution, solved
from splatctrl_cli.checks.limits import VIEWS_RANGE
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.files.output import finite, output_path
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.jobs.check import SessionRequest, pose_robot
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source import open_session
from splatctrl_cli.records import Float64, RgbdFrame, spread
from splatctrl_cli.robot.model import RobotModel

BASE = "the robot's base"


@dataclass(frozen=True, kw_only=True)
class CalibrateRequest(SessionRequest, RobotOptions):
    """Calibration of a recording's cameras.

    out: None for calibration.toml here. urdf: a recorded robot to place cameras against. hold: the fixed camera. None
    fixes the first if there is no robot or moving camera. board: for initial poses. allow_unobserved: write an
    incomplete calibration.
    """

    out: Path | None = None
    urdf: Path | None = None
    hold: str | None = None
    board: Board | None = None
    allow_unobserved: bool = False
    force: bool = False


@dataclass(frozen=True, kw_only=True, repr=False)
class CalibrateResult(Result):
    """Written calibration, and distances between surfaces that cameras or robot show.

    before, after [m]: `Adjustment.distance`. moved: translation [m] and rotation [deg] by camera.
    """

    calibration: Calibration
    moved: Mapping[str, tuple[float, float]]
    before: float | None
    after: float | None


def calibrate(request: CalibrateRequest, progress: Progress = SILENT) -> CalibrateResult:
    """Find the calibration and write it.

    Raises UsageError for contradictory options, InputError for an unreadable recording. Raises NotEvaluableError if
    cameras stay undetermined.
    """
    out = request.out or Path("calibration.toml")
    refuse_if(
        request.options.calibration is not None,
        "--calibration: what is calibrated is the recording as it is",
        remedy="leave it out",
        error=UsageError,
    )
    model = pose_robot(request.paths, request.urdf, request)
    source = open_session(request.paths, request.options)
    arm = None if model is None else _arm(model, source)
    with output_path(out, force=request.force, is_folder=False) as partial:
        frames, sightings = _frames(source, request.board, progress)
        if arm is not None:
            travel = arm.travel(sorted({frame.stamp_ns for frame in frames}))
            # any wrong model explains a single posture
            refuse_if(
                travel < fixed.CALIBRATION_TRAVEL,
                f"calibrate: the robot hardly moves: {1e3 * travel:.0f} mm at most (expected"
                f" {1e3 * fixed.CALIBRATION_TRAVEL:.0f})",
                remedy="record it moving through the space that the cameras see, or leave --urdf out to place the"
                " cameras against each other",
                error=NotEvaluableError,
            )
        cameras, moving = sorted({frame.camera for frame in frames}), moving_cameras(frames)
        anchors = _choose_fixed(request, cameras, has_anchor=arm is not None or bool(moving))
        begin = {camera: np.eye(4) for camera in cameras}
        if request.board is not None:
            by_stamp = {c: {f.stamp_ns: f.T_world_camera for f in frames if f.camera == c} for c in cameras}
            begin = board_start(
                request.board, sightings, Rig(recorded=by_stamp, moving=moving, arm=arm, anchors=anchors)
            )
        frames = [replace(frame, T_world_camera=frame.T_world_camera @ begin[frame.camera]) for frame in frames]
        evidence = evidence_of(frames, arm)
        progress.log(f"calibrate: {len(frames)} frames of {', '.join(evidence.cameras)}")
        start = Estimate(corrections={camera: np.eye(4) for camera in evidence.cameras})
        solution = solved(evidence, start, anchors)
        unknown = _find_unobserved(solution)
        if any(unknown.values()):
            if not request.allow_unobserved:
                raise _refusal(unknown, evidence)
            solution = solution.within_observed(start)
        calibration = _calibration(source, solution, begin, unknown)
        partial.write_text(calibration_text(calibration), encoding="utf-8")
    recorded = Estimate(corrections={camera: invert_transform(T) for camera, T in begin.items()})
    before, after = (solution.adjustment.distance(estimate) for estimate in (recorded, solution.estimate))
    twists = {camera: twist_of(begin[camera] @ solution.estimate.corrections[camera]) for camera in evidence.cameras}
    moved = {
        camera: (float(np.linalg.norm(twist[3:])), float(np.degrees(np.linalg.norm(twist[:3]))))
        for camera, twist in twists.items()
    }
    clock = calibration.clock
    metrics = {
        "frames": len(frames),
        "distance_before_mm": None if before is None else round(1e3 * before, 2),
        "distance_after_mm": None if after is None else round(1e3 * after, 2),
        "clock_offset_ms": None if clock is None else round(1e3 * clock, 3),
        "sigma_clock_ms": None if clock is None else round(1e3 * calibration.sigma_clock, 3),
        "cameras": {
            name: {
                "moved_mm": round(1e3 * moved[name][0], 3),
                "turned_deg": round(moved[name][1], 4),
                "sigma_mm": round(1e3 * max(camera.sigma_position), 3),
                "sigma_deg": round(float(np.degrees(max(camera.sigma_rotation))), 4),
                "depth_scale": camera.scale,
                "depth_bias_mm": round(1e3 * camera.bias, 3),
                "depth_bias_noticed_mm": finite(round(1e3 * camera.depth_noticed[1], 3)),
                "held": calibration.is_held(name),
                "unobserved": list(camera.unobserved),
            }
            for name, camera in calibration.cameras.items()
        },
    }
    return CalibrateResult(out=out, metrics=metrics, calibration=calibration, moved=moved, before=before, after=after)


def _arm(model: RobotModel, source: FrameSource) -> Arm:
    refuse_if(
        not len(source.states),
        f"{source.name}: --urdf: expected joint states, got none",
        remedy="record /joint_states, or leave --urdf out to place the cameras against each other",
    )
    refuse_if(
        len(model.surface.vague) == len(model.surface.links),
        f"{model.urdf.path}: expected collision geometry, got spheres alone, which enclose the surface",
        remedy="give the URDF with its meshes (--packages DIR where they are in packages)",
    )
    model = model.moved_by(source.joint_names, source.tf_frames)
    states = source.states.convert_joints(*model.joint_columns(source.joint_names))
    return Arm(model, states.postures(fixed.STATES_CLOSE_NS))


def _frames(source: FrameSource, board: Board | None, progress: Progress) -> tuple[list[RgbdFrame], list[Sighting]]:
    stamps = stamps_by_camera(source)
    chosen = frames_nearest(stamps, spread(min(stamps.values(), key=len), fixed.CALIBRATION_FRAMES))
    frames: list[RgbdFrame] = []
    sightings: list[Sighting | None] = []
    others: Counter[tuple[int, int]] = Counter()
    for item in source.stored():
        if isinstance(item, StoredFrame) and (item.camera, item.stamp_ns) in chosen:
            frames.append(depth_frame(item))
            if board is not None:
                sightings.append(sighting_of(board, item.frame))
                other = None if any(sightings) or sum(others.values()) > 3 else other_size(item.frame)
                others.update([] if other is None else [other])
            if len(frames) % 30 == 0:
                progress.log(f"calibrate: {len(frames)} of {len(chosen)} frames read")
    if board is not None and not any(sightings):
        raise _no_board(board, len(frames), others)
    return frames, [sighting for sighting in sightings if sighting is not None]


def stamps_by_camera(source: FrameSource) -> dict[str, list[int]]:
    """Stamps [ns] of each camera's frames. Raises InputError without frames."""
    stamps: dict[str, list[int]] = {}
    for stamp, camera, _ in source.poses():
        stamps.setdefault(camera, []).append(stamp)
    refuse_if(not stamps, f"{source.name}: no frame could be read", remedy="see `splatctrl info`")
    return stamps


def frames_nearest(stamps: Mapping[str, Sequence[int]], moments: Sequence[int]) -> set[tuple[str, int]]:
    """Camera and stamp [ns] of each camera's frames nearest to the moments [ns]."""
    return {
        (camera, its[int(np.argmin(np.abs(np.array(its) - moment)))])
        for camera, its in stamps.items()
        for moment in moments
    }


def _no_board(board: Board, num_frames: int, others: Counter[tuple[int, int]]) -> NotEvaluableError:
    text = f"calibrate: no board of {board} inner corners in {num_frames} frames"
    (columns, rows), times = others.most_common(1)[0] if others else ((board.columns, board.rows), 0)
    if times > 1 and {columns, rows} != {board.columns, board.rows}:
        return NotEvaluableError(
            f"{text}, but one of {columns}x{rows}", remedy=f"give --board {columns}x{rows}:{board.square:g}"
        )
    if not board.is_one_way_up:
        return NotEvaluableError(
            f"{text} with markers; without them, one of that size looks the same after half a turn",
            remedy="use a ChArUco board, or a chessboard of an odd and an even number of inner corners, as 9x6",
        )
    return NotEvaluableError(text, remedy="show its printed side, whole and lit, to every camera, or give its size")


def depth_frame(stored: StoredFrame) -> RgbdFrame:
    low, high = VIEWS_RANGE
    is_used = (stored.depth >= low) & (stored.depth <= high)
    if stored.human is not None:
        is_used &= stored.human == 0
    return RgbdFrame(
        stamp_ns=stored.stamp_ns,
        camera=stored.camera,
        color=np.zeros((1, 1, 3), np.uint8),
        depth=np.where(is_used, stored.depth, np.float32(0.0)),
        intrinsics=stored.intrinsics,
        T_world_camera=stored.T_world_camera,
    )


def _choose_fixed(request: CalibrateRequest, cameras: Sequence[str], *, has_anchor: bool) -> tuple[str, ...]:
    """Fixed cameras: --hold's, else none with a robot or moving camera, else the first."""
    refuse_if(
        request.hold is not None and request.hold not in cameras,
        f"--hold {request.hold}: no such camera",
        remedy=f"use one of: {', '.join(cameras)}",
        error=UsageError,
    )
    if request.hold is not None:
        return (request.hold,)
    if has_anchor:
        return ()
    refuse_if(
        len(cameras) < 2,
        f"calibrate: one camera that stands still, {cameras[0]}, and no robot to place it against",
        remedy="give --urdf of a robot that it sees, or a recording of several cameras",
        error=NotEvaluableError,
    )
    return (cameras[0],)


def _find_unobserved(solution: Solution) -> dict[str, tuple[str, ...]]:
    evidence = solution.adjustment.evidence
    missing = {}
    for camera in solution.adjustment.unknowns.poses:
        view = next((view for view in evidence.views if view.camera == camera), None)
        T = np.eye(4) if view is None else view.T_world_camera @ solution.estimate.corrections[camera]
        missing[camera] = unobserved(solution.certainty, camera, T, None if view is None else plane_of(view, T))
    return missing


def _refusal(unknown: Mapping[str, tuple[str, ...]], evidence: Evidence) -> NotEvaluableError:
    listed = "; ".join(f"{', '.join(names)} of {camera}" for camera, names in unknown.items() if names)
    remedy = (
        "put objects of different shapes where all cameras see them"
        + (", turn the moving camera about two axes" if evidence.moving else "")
        + (", or give --urdf of a robot in view" if evidence.arm is None else "")
    )
    return NotEvaluableError(
        f"calibrate: the recording does not say all: not observed: {listed}",
        remedy=f"{remedy}; --allow-unobserved writes the rest, with these as recorded",
    )


def _calibration(
    source: FrameSource, solution: Solution, begin: Mapping[str, Float64], unknown: Mapping[str, tuple[str, ...]]
) -> Calibration:
    """begin: initial T_recorded_camera (4, 4) by camera."""
    evidence, estimate, certainty = solution.adjustment.evidence, solution.estimate, solution.certainty
    cameras = {}
    for camera in evidence.cameras:
        begun = next(view.T_world_camera for view in evidence.views if view.camera == camera)
        moves = camera in evidence.moving
        T = (begin[camera] if moves else begun) @ estimate.corrections[camera]
        R = np.eye(3) if moves else T[:3, :3]
        to_axes = np.zeros((6, 6))
        to_axes[:3, 3:], to_axes[3:, :3] = R, R
        covariance = to_axes @ certainty.slice_covariance(camera) @ to_axes.T
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        scale, bias = estimate.depth_of(camera)
        unknowns = solution.adjustment.unknowns
        counts = {"pose": unknowns.poses, "depth scale": unknowns.scales, "depth bias": unknowns.biases}
        cameras[camera] = CalibratedCamera(
            T=T,
            recorded=None if moves else begun @ invert_transform(begin[camera]),
            scale=float(scale),
            bias=float(bias),
            sigma_position=tuple(map(float, sigma[:3])),
            sigma_rotation=tuple(map(float, sigma[3:])),
            sigma_depth=certainty.sigma_depth(camera),
            depth_noticed=tuple(map(float, solution.noticed.get(camera, (np.inf, np.inf)))),
            covariance=covariance,
            as_recorded=tuple(name for name, of_cameras in counts.items() if camera not in of_cameras),
            unobserved=unknown.get(camera, ()),
        )
    return Calibration(
        recording=source.name,
        world_frame=source.world_frame,
        digests=source.digests(),
        cameras=cameras,
        as_recorded=(
            *((BASE,) if evidence.arm is not None else ()),
            *(f"camera {camera}" for camera in solution.fixed),
        ),
        clock=float(estimate.clock) if solution.adjustment.unknowns.has_clock else None,
        sigma_clock=certainty.sigma_clock,
    )
