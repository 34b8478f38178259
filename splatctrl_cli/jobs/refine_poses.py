"""``--refine-poses``: the views of a still scene where they see the same surfaces, and what is told of it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from splatctrl_cli.calibration.pose_refinement import refined_poses
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.jobs.progress import Progress
from splatctrl_cli.records import RecordSource, RgbdFrame
from splatctrl_cli.scene.scale import RecordedDepth


def check_refinable(source: RecordSource) -> None:
    """Raise UsageError for a recording over time."""
    if source.has_clock:
        raise UsageError(
            f"--refine-poses: {source.name} is recorded over time; the views of a still scene alone are put right",
            remedy="leave it out, and see 'splatctrl check' for cameras that stand wrong",
        )


def put_right(frames: Sequence[RgbdFrame], name: str, console: Progress) -> tuple[list[RgbdFrame], dict[str, Any]]:
    """The frames at poses that fit each other, and what ``run.json`` says of it.

    name: of the recording. Raises InputError where there is no depth that could tell.
    """
    depth = RecordedDepth.of(frames)
    if depth is None:
        raise InputError(f"{name}: --refine-poses: no view has depth, which alone says how poses are off")
    found = refined_poses(frames, depth.median / fixed.SCALE_DEPTH)
    moved = [replace(f, T_world_camera=T) for f, T in zip(frames, found.T_world_camera, strict=True)]
    held = [f"{frame.camera} at {frame.stamp_ns}" for frame, h in zip(frames, found.is_held, strict=True) if h]
    before, after, largest = (1e3 * value for value in (found.before, found.after, float(found.moved.max())))
    if found.is_better:
        console.log(
            f"poses: {len(frames)} views moved by {1e3 * float(np.median(found.moved)):.1f} mm in the median, at most"
            f" {largest:.1f} mm and {found.turned.max():.2f} deg: surfaces of two views are {after:.2f} mm apart"
            f" instead of {before:.2f}"
        )
    else:
        console.log(
            f"poses: stay as recorded: surfaces of two views are {before:.2f} mm apart, and no move betters it"
        )
    return moved, {
        "pose_residual": found.after,
        "poses": {
            "residual_before": found.before,
            "moved_median": float(np.median(found.moved)),
            "moved_max": float(found.moved.max()),
            "turned_max": float(found.turned.max()),
            "held": held,
        },
        "refined_poses": [
            {"camera": f.camera, "stamp_ns": f.stamp_ns, "T_world_camera": f.T_world_camera.ravel().tolist()}
            for f in moved
        ],
    }


def posed(frame: RgbdFrame, poses: Mapping[tuple[str, int], Any]) -> RgbdFrame:
    """The frame where a scene's `refined_poses` have it, if they do."""
    T = poses.get((frame.camera, frame.stamp_ns))
    return frame if T is None else replace(frame, T_world_camera=T)


def posed_among(frame: RgbdFrame, others: Sequence[RgbdFrame]) -> RgbdFrame:
    """The frame where it fits other views of a still scene, which stay; where nothing is gained, as it is."""
    depth = RecordedDepth.of(others)
    if depth is None:
        return frame
    free = np.zeros(len(others) + 1, np.bool_)
    free[0] = True
    found = refined_poses([frame, *others], depth.median / fixed.SCALE_DEPTH, free)
    return replace(frame, T_world_camera=found.T_world_camera[0])
