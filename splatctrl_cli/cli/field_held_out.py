"""A baked field beside the depth of cameras that did not train: which frames, and which of their pixels."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from splatctrl_cli.cli.bake_source import BakeSource
from splatctrl_cli.cli.common import table
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.evaluate.held_out_depth import HeldOutComparison, compare_with_held_out_depth
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Bool, Box, DistanceGrid, Float64, JointState, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.sources.source import open_source

ROBOT_MARGIN = 0.03  # [m] about the robot's spheres in which a pixel does not count


def compare_with_held_out(grid: DistanceGrid, source: BakeSource, args: argparse.Namespace) -> HeldOutComparison:
    """The field against the newest depth, not later than the scene's stamp, of each camera that --held-out names.

    Pixels do not count that show what is outside the box of the scene, or, where --urdf says where it is, the robot:
    neither is in the field. Raises as `held_out_cameras`, and
    NotEvaluableError where there is no frame.
    """
    log, cameras = held_out_cameras(args.held_out, source.cameras)
    recording = open_source(log)
    newest: dict[str, RgbdFrame] = {}
    joints: dict[str, JointState | None] = {}
    state: JointState | None = None
    for record in recording.records():
        if source.stamp_ns is not None and record.stamp_ns > source.stamp_ns:
            break
        if isinstance(record, JointState):
            state = record
        elif record.camera in cameras:
            newest[record.camera], joints[record.camera] = record, state
    if not newest:
        raise NotEvaluableError(f"{log}: no frame of {', '.join(cameras)} up to the time of the scene")
    robot = None if args.urdf is None else RobotModel.from_urdf(args.urdf, args.spheres)
    counted = []
    for camera, frame in newest.items():
        at, centers = joints[camera], None
        if robot is not None and at is not None:
            centers = robot.sphere_centers(at.position[robot.joint_order(recording.joint_names)])
        counted.append(_counted(frame, source.workspace, centers, None if robot is None else robot.sphere_set.radii))
    return compare_with_held_out_depth(grid, list(newest.values()), seed=args.seed, counted=counted)


def split_cameras(text: str) -> tuple[Path, tuple[str, ...]]:
    """The log and the cameras of ``LOG:camera,...``; none named means every one that did not train."""
    path, colon, cameras = text.rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ()
    return Path(path), tuple(name.strip() for name in cameras.split(",") if name.strip())


def held_out_lines(compared: HeldOutComparison) -> list[str]:
    """A short table: the field at measured points, and before them."""
    header = ("field", "from depth cm", "count", "mean mm", "rmse mm", "95 % mm", "max mm")
    rows: list[Sequence[object]] = []
    bands = {name: [("on it", band)] for name, band in compared.on_surface.items()}
    for name, found in compared.before.seen.items():
        bands[name] += [(f"{band.lower * 100:g}-{band.upper * 100:g}", band) for band in found]
    for name, entries in bands.items():
        for place, band in entries:
            values = (band.mean, band.rmse, band.over_95, band.over_max)
            shown = ["-" if value is None else f"{value * 1e3:.1f}" for value in values]
            rows.append((name, place, band.count, *shown))
    note = (
        f"held-out depth of {compared.num_frames} frames; before it: points whose ball up to it was seen to be free"
    )
    return [note, *table(header, rows)]


def held_out_cameras(text: str, trained: Sequence[str] | None) -> tuple[Path, tuple[str, ...]]:
    """The log and the cameras of --held-out; trained: those that made the scene, where that is known.

    Raises UsageError for a camera that trained or is not there, or where none is left.
    """
    log, names = split_cameras(text)
    known = open_source(log).cameras
    wrong = [name for name in names if name not in known]
    if wrong:
        raise UsageError(f"--held-out: {log} has no camera {wrong[0]}", remedy=f"it has: {', '.join(known)}")
    also = [name for name in names if trained is not None and name in trained]
    if also:
        raise UsageError(f"--held-out: camera {also[0]} trained the scene", remedy="name one that did not")
    chosen = tuple(names) or tuple(name for name in known if trained is None or name not in trained)
    if not chosen:
        raise UsageError(f"--held-out: every camera of {log} trained the scene", remedy="give another log")
    return log, chosen


def _counted(frame: RgbdFrame, workspace: Box | None, centers: Float64 | None, radii: Float64 | None) -> Bool:
    """(H, W) False where a pixel's point lies outside the scene's box, or in a sphere (S, 3), (S,) or near it."""
    counted = np.ones(frame.depth.shape, np.bool_)
    is_deep = frame.depth > 0
    points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[is_deep])
    is_wanted = np.ones(len(points), np.bool_) if workspace is None else workspace.contains(points)
    if centers is not None and radii is not None:
        for center, radius in zip(centers, radii, strict=True):
            is_wanted &= np.square(points - center).sum(axis=1) > (radius + ROBOT_MARGIN) ** 2
    counted[is_deep] = is_wanted
    return counted
