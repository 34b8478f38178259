"""Correction of a still scene's poses (``--refine-poses``) and exposures between its views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatctrl_cli.calibration.gray_views import band_ratios, exposed, exposure_gains
from splatctrl_cli.calibration.pose_refinement import (
    FoundBends,
    depth_bends,
    freed,
    largest_share,
    refined_poses,
    unbent,
)
from splatctrl_cli.checks import limits
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import UsageError, refuse_if, require
from splatctrl_cli.formats.scene.scene_folder import ViewCorrection
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.recording.folder.folder_views import HOLDOUT
from splatctrl_cli.records import Float64, RecordSource, RgbdFrame
from splatctrl_cli.scene.scale import RecordedDepth


@dataclass(frozen=True, kw_only=True)
class Corrections:
    """Requested corrections of a still scene's views.

    Without a robot, exposure is corrected even unrequested, if `check` would report brightness or colour.
    """

    poses: bool = False
    exposure: bool = False

    def __bool__(self) -> bool:
        return self.poses or self.exposure

    @property
    def options(self) -> str:
        return " ".join(
            n for n, is_set in (("--refine-poses", self.poses), ("--refine-exposure", self.exposure)) if is_set
        )

    def check(self, source: RecordSource) -> None:
        """Raise UsageError for corrections of a recording over time."""
        refuse_if(
            self and source.has_clock,
            f"{self.options}: {source.name} is recorded over time; only views of a still scene are corrected",
            remedy="leave it out; 'splatctrl calibrate' places the cameras of a log",
            error=UsageError,
        )

    def of(
        self, frames: Sequence[RgbdFrame], source: RecordSource, console: Progress, *, has_robot: bool = False
    ) -> tuple[list[RgbdFrame], dict[str, Any]]:
        """Correct the frames; also return the facts for ``run.json``.

        has_robot: depth stays as measured, since the map will judge motion. Raises InputError if requested without
        depth.
        """
        depth = RecordedDepth.of(frames)
        if not self and (source.has_clock or has_robot or depth is None):
            return list(frames), {}
        depth = require(depth, f"{source.name}: {self.options}: expected views with depth, got none")
        scale, report = depth.median / fixed.SCALE_DEPTH, dict[str, Any]()
        rows = [{"camera": frame.camera, "stamp_ns": frame.stamp_ns} for frame in frames]
        moved = list(frames)
        if self.poses:
            moved, poses = _correct_poses(moved, scale, has_robot, console)
            report |= poses
            rows = [
                row | {"T_world_camera": f.T_world_camera.ravel().tolist()}
                for row, f in zip(rows, moved, strict=True)
            ]
        if (gains := _gains(moved, scale, console, is_requested=self.exposure)) is not None:
            report["exposure_spread"] = float(np.abs(np.log(gains)).max())
            rows = [row | {"gain": gain.tolist()} for row, gain in zip(rows, gains, strict=True)]
            moved = [exposed(frame, gain) for frame, gain in zip(moved, gains, strict=True)]
        return moved, report | {"corrected_views": rows} if report else {}


def _correct_poses(
    recorded: list[RgbdFrame], scale: float, has_robot: bool, console: Progress
) -> tuple[list[RgbdFrame], dict[str, Any]]:
    refined, frames = refined_poses(recorded, scale), recorded
    recorded_apart, apart = refined.before, refined.after  # [m], with depth as recorded
    bends = FoundBends() if has_robot else depth_bends(frames, refined, scale)
    if bends.grids:
        frames = freed(recorded, bends.grids)
        refined = refined_poses(frames, scale)
    before, after, median = (
        1e3 * value for value in (recorded_apart, refined.after, float(np.median(refined.moved)))
    )
    console.log(
        f"poses: {len(frames)} views moved by {median:.1f} mm in the median, at most"
        f" {1e3 * refined.moved.max():.1f} mm and {refined.turned.max():.2f} deg: surfaces of two views are"
        f" {after:.2f} mm apart instead of {before:.2f}"
        if refined.is_better
        else f"poses: stay as recorded: surfaces of two views are {after:.2f} mm apart, and no correction reduces it"
    )
    return [replace(f, T_world_camera=T) for f, T in zip(frames, refined.T_world_camera, strict=True)], {
        "pose_residual": refined.after,
        "poses": {
            "residual_before": recorded_apart,
            "moved_median": float(np.median(refined.moved)),
            "moved_max": float(refined.moved.max()),
            "turned_max": float(refined.turned.max()),
            "held": [
                f"{f.camera} at {f.stamp_ns}" for f, is_held in zip(frames, refined.is_held, strict=True) if is_held
            ],
        },
    } | ({} if has_robot else _describe(bends, scale, apart, refined.after, console))


def _describe(bends: FoundBends, scale: float, apart: float, after: float, console: Progress) -> dict[str, Any]:
    """apart, after [m]: residuals without and with the depth bends."""
    depth = scale * fixed.SCALE_DEPTH
    rows = {
        camera: {
            "largest": largest_share(grid, depth),
            "residual_before": apart,
            "residual_after": after,
            "gains": list(bends.gains),
            "offsets": grid.tolist(),
        }
        for camera, grid in bends.grids.items()
    }
    for camera, row in rows.items():
        console.log(
            f"depth: {camera}: freed of a bend, the same in all its views, of at most {100 * row['largest']:.1f} % at"
            f" {depth:.2f} m: surfaces of two views are {1e3 * after:.2f} mm apart, {1e3 * apart:.2f} by poses alone"
        )
    if not rows and (bends.gains or bends.unlike):
        console.log("depth: stays as recorded: the two halves of the views show different bends")
    return {"depth_bend": max((row["largest"] for row in rows.values()), default=0.0)} | (
        {"depth_bends": rows} if rows else {}
    )


def _gains(frames: list[RgbdFrame], scale: float, console: Progress, *, is_requested: bool) -> Float64 | None:
    """Gains (N, 3), all 1 if below `EXPOSURE_GAIN`; None if neither requested nor found."""
    gains = exposure_gains(frames, scale)
    least, most = float(gains.min()), float(gains.max())
    if is_requested and np.abs(np.log(gains)).max() < fixed.EXPOSURE_GAIN:
        console.log(f"exposure: the same in all {len(frames)} views, within {100 * max(most - 1, 1 - least):.1f} %")
        return np.ones_like(gains)
    if not is_requested and not _are_exposures(gains, frames, scale):
        return None
    console.log(f"exposure: {len(frames)} views are divided by {least:.2f} to {most:.2f}, each colour by its own")
    return gains


def _are_exposures(gains: Float64, frames: Sequence[RgbdFrame], scale: float) -> bool:
    """True if gains differ, and explain half of the differences between image bands."""
    if (gains.max(axis=0) / gains.min(axis=0)).max() <= 1 + limits.EXPOSURE_RATIO:
        return False
    bands = band_ratios(frames, scale, np.ones(len(frames), np.bool_), limits.EXPOSURE_BANDS)
    return bands.misfit(gains[:, None]) < limits.EXPOSURE_EXPLAINED * bands.misfit(np.ones((1, 1, 3)))


def corrected(frame: RgbdFrame, corrections: Mapping[tuple[str, int], ViewCorrection]) -> RgbdFrame:
    """Apply a scene's training correction to a frame, if any."""
    row = corrections.get((frame.camera, frame.stamp_ns))
    if row is None:
        return frame
    frame = frame if row.bend is None else unbent(frame, row.bend)
    frame = frame if row.T_world_camera is None else replace(frame, T_world_camera=row.T_world_camera)
    return frame if row.gain is None else exposed(frame, row.gain)


def corrected_among(
    frame: RgbdFrame, others: Sequence[RgbdFrame], corrections: Mapping[tuple[str, int], ViewCorrection]
) -> RgbdFrame:
    """Correct a frame against already corrected views; a training frame gets its own correction."""
    if (frame.camera, frame.stamp_ns) in corrections:
        return corrected(frame, corrections)
    depth = RecordedDepth.of(others)
    if depth is None:
        return frame
    scale, free = depth.median / fixed.SCALE_DEPTH, np.arange(len(others) + 1) == 0
    respects = next(iter(corrections.values()))
    # bend of the frame's camera, or of the only camera with its intrinsics
    cameras = {other.camera for other in others if other.intrinsics == frame.intrinsics}
    camera = frame.camera if frame.camera != HOLDOUT or len(cameras) != 1 else cameras.pop()
    bend = next((row.bend for (name, _), row in corrections.items() if name == camera), None)
    frame = frame if bend is None else unbent(frame, bend)
    if respects.T_world_camera is not None:
        frame = replace(frame, T_world_camera=refined_poses([frame, *others], scale, free).T_world_camera[0])
    if respects.gain is not None:
        frame = exposed(frame, exposure_gains([frame, *others], scale, free)[0])
    return frame
