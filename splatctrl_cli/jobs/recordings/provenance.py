"""Checks that the contents of scene or field, log, truth and robot belong together.

Camera names are alike on every rig and prove nothing.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from splatctrl_cli.config import OccupancyConfig, SceneConfig, fixed
from splatctrl_cli.evaluate.verdict import Reason, not_evaluable
from splatctrl_cli.formats.scene.scene_folder import SceneFolder
from splatctrl_cli.geometry import compare_poses
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.source_options import CALIBRATION, PERTURB
from splatctrl_cli.records import Record, RecordSource, RgbdFrame, Stamps, UInt8
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.unrepresented import agreement_with_grid
from splatctrl_cli.simulate.truth import Truth


def first_frame(frame: RgbdFrame) -> dict[str, Any]:
    """Facts of a camera's first training frame for ``run.json``.

    intrinsics [px]: fx, fy, cx, cy, width, height; T_world_camera: 16 numbers by row; tiles: colours (0 to 255).
    """
    k = frame.intrinsics
    return {
        "camera": frame.camera,
        "stamp_ns": frame.stamp_ns,
        "intrinsics": [k.fx, k.fy, k.cx, k.cy, float(k.width), float(k.height)],
        "T_world_camera": [round(float(value), 9) for value in frame.T_world_camera.ravel()],
        "tiles": [round(value, 1) for value in _tiles(frame.color)],
    }


def differences(recorded: Sequence[Mapping[str, Any]], records: Iterator[Record]) -> list[str]:
    """Describe how `records` differ from a scene's first frames; empty if alike.

    Reads until each first frame was found or passed.
    """
    wanted = {str(first["camera"]): first for first in recorded}
    last = max(int(first["stamp_ns"]) for first in recorded)
    nearest: dict[str, RgbdFrame] = {}
    for record in records:
        if not isinstance(record, RgbdFrame) or record.camera not in wanted:
            continue
        stamp_ns = int(wanted[record.camera]["stamp_ns"])
        best = nearest.get(record.camera)
        if best is None or abs(record.stamp_ns - stamp_ns) < abs(best.stamp_ns - stamp_ns):
            nearest[record.camera] = record
        if record.stamp_ns >= last and len(nearest) == len(wanted):
            break
    return [
        line
        for camera, first in wanted.items()
        for line in (_differences(first, nearest[camera]) if camera in nearest else [f"has no camera {camera}"])
    ]


def changed_files(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Describe files with equal names but other digests; descriptions (.toml) may change."""
    common = [name for name in then if name in now and not name.endswith(".toml")]
    changed = [name for name in common if then[name] != now[name]]
    if len(common) == 1:
        return [f"{name} has other contents" for name in changed]
    return [f"{len(changed)} of {len(common)} files have other contents, such as {name}" for name in changed[:1]]


def _differences(first: Mapping[str, Any], frame: RgbdFrame) -> list[str]:
    camera = frame.camera
    then, now = np.array(first["intrinsics"], np.float64), np.array(first_frame(frame)["intrinsics"])
    if then[4:].tolist() != now[4:].tolist():
        return [f"{camera}: images of {now[4]:g}x{now[5]:g}, not {then[4]:g}x{then[5]:g}"]
    gap = float(np.abs(then[:4] - now[:4]).max())
    apart = (frame.stamp_ns - int(first["stamp_ns"])) * 1e-9
    then_pose = np.array(first["T_world_camera"], np.float64).reshape(4, 4)
    metres, degrees = compare_poses(then_pose, frame.T_world_camera)
    levels = float(np.abs(np.array(first["tiles"]) - np.array(_tiles(frame.color))).max())
    side = "after" if apart > 0 else "before"
    is_moved = metres > fixed.SAME_POSE_METRES or degrees > fixed.SAME_POSE_DEGREES
    texts = {
        f"intrinsics differ by {gap:.1f} px": gap > fixed.SAME_LENS_PIXELS,
        f"its nearest frame is {abs(apart):.3g} s {side} the one that trained": apart != 0,
        f"the pose differs by {1e3 * metres:.0f} mm and {degrees:.1f} degrees": is_moved,
        f"the picture differs by up to {levels:.0f} of 255 levels": levels > fixed.SAME_PICTURE_LEVELS,
    }
    return [f"{camera}: {text}" for text, differs in texts.items() if differs]


def _tiles(color: UInt8) -> list[float]:
    rows, columns = (
        # the picture is stored as 6 rows and 8 columns of tiles
        np.linspace(0, size, num + 1).astype(int)
        for size, num in zip(color.shape[:2], (6, 8), strict=True)
    )
    return [
        float(value)
        for top, bottom in zip(rows[:-1], np.maximum(rows[1:], rows[:-1] + 1), strict=True)
        for left, right in zip(columns[:-1], np.maximum(columns[1:], columns[:-1] + 1), strict=True)
        for value in color[top:bottom, left:right].reshape(-1, 3).mean(axis=0)
    ]


S = TypeVar("S", SceneConfig, OccupancyConfig)


def scene_mismatches(
    scene: SceneFolder, source: RecordSource, states: StateColumns, model: RobotModel
) -> Iterator[Reason]:
    """Mismatches of a reconstruction with a log and robot: provenance, times, and splats against occupancy."""
    if scene.parts.digests is None:
        yield not_evaluable(
            sentence=f"{scene.path}: expected digests of its files, got none: an earlier version wrote it",
            remedy="reconstruct again",
        )
    yield from made_from_mismatches(scene.path, scene.made_from, source, model)
    if scene.has_clock and not scene.snapshots:
        yield not_evaluable(
            sentence=f"{scene.path}: expected snapshots over time, got only the map of its end",
            remedy="reconstruct again",
        )
    if scene.has_clock and len(states):
        stamps = [*(snapshot.stamp_ns for snapshot in scene.snapshots), scene.stamp_ns]
        if (gap := times_apart(states.stamp_ns, (min(stamps), max(stamps)))) is not None:
            yield gap
    yield from _map_mismatches(scene)


def made_from_mismatches(
    path: Path, made_from: Mapping[str, Any], source: RecordSource, model: RobotModel
) -> Iterator[Reason]:
    """Mismatches of a scene or field, described by `made_from`, with a log and robot.

    Compares digests, training cameras' first frames, and the segmented robot. Corrected depth is also a mismatch.
    """
    files, digests = made_from.get("inputs", {}), source.digests()
    other, recorded = changed_files(files, digests), made_from.get("first_frames")
    earlier, current = _calibrations(files), _calibrations(digests)
    if earlier.keys() != current.keys():
        with_made, with_given = (
            f"with {', '.join(names.values())}" if names else "without one" for names in (earlier, current)
        )
        yield not_evaluable(
            sentence=f"calibration: {path} was made {with_made}, this log is read {with_given}",
            remedy="give the --calibration that it was made with, or reconstruct",
        )
    elif not other and recorded and source.cameras:
        other = differences(recorded, source.records())
    if other:
        yield not_evaluable(
            sentence=f"{path} was made from another recording: {'; '.join(other[:3])}", remedy="reconstruct this log"
        )
    if made_from.get("depth_bend"):
        yield not_evaluable(
            sentence=f"{path} rests on depth corrected by up to {100 * made_from['depth_bend']:.1f} %, which no"
            " sensor measured",
            remedy="reconstruct with --urdf or without --refine-poses: depth stays as recorded",
        )
    if robot := _robot_difference(made_from, model):
        yield not_evaluable(
            sentence=f"{path} was segmented with another robot, {robot}",
            remedy="reconstruct with this --urdf, or give the one that it was made with",
        )


def _calibrations(files: Mapping[str, str]) -> dict[str, str]:
    return {
        digest: name.removeprefix(CALIBRATION)
        for name, digest in files.items()
        if name.startswith((CALIBRATION, PERTURB))
    }


def _robot_difference(made_from: Mapping[str, Any], model: RobotModel) -> str:
    joints = made_from.get("robot_joints")
    if joints is None:
        return ""
    if tuple(joints) != tuple(model.joint_names):
        return f"with joints {', '.join(joints)}"
    base = np.array(made_from.get("robot_base") or model.T_world_base)
    if not np.allclose(base, model.T_world_base, atol=fixed.SAME_LINK):
        x, y, z = base[:3, 3]
        return f"its root at ({x:.3f}, {y:.3f}, {z:.3f}) m or turned otherwise: give that place with --base"
    theirs, ours = made_from.get("robot_links"), model.extents()
    if theirs is None:
        return "of which an earlier version stored the joints alone"
    for link, (*corners, area) in theirs.items():
        if link not in ours:
            return f"with link {link}, which this one does not have"
        if (off := np.abs(np.subtract(corners, ours[link][:-1])).max()) > fixed.SAME_LINK:
            return f"whose link {link} reaches {1e3 * off:.1f} mm farther, or less far"
        if abs(area / ours[link][-1] - 1) > fixed.SAME_LINK_AREA:
            return f"whose link {link} has a surface of {area:.4f} m^2, not {ours[link][-1]:.4f}"
    return ""


def times_apart(states_ns: Stamps, scene_ns: tuple[int, int]) -> Reason | None:
    """Mismatch of state stamps (T,) [ns] and a scene's span; None if they overlap, or almost."""
    first, last = int(states_ns[0]), int(states_ns[-1])
    apart_ns = max(scene_ns[0] - last, first - scene_ns[1])
    if apart_ns <= fixed.RECORDINGS_APART_NS:
        return None
    ours, theirs = (f"from {start * 1e-9:.2f} to {end * 1e-9:.2f} s" for start, end in ((first, last), scene_ns))
    return not_evaluable(
        sentence=f"joint states {ours} and a scene {theirs} are "
        + ("on clocks that do not overlap" if (apart_ns > fixed.CLOCK_MIXED * 1e9) else "of different times"),
        remedy="record both by one clock, or reconstruct this log",
    )


def _map_mismatches(scene: SceneFolder) -> Iterator[Reason]:
    known = scene.known() if scene.parts.digests is not None else None
    if known is None:
        return
    used = scene.run.get("config", {})
    agreement = agreement_with_grid(
        scene.splats(),
        known,
        _read_section(SceneConfig, used.get("scene")),
        _read_section(OccupancyConfig, used.get("occupancy")),
    )
    if not agreement.holds and agreement.num_voxels:
        yield not_evaluable(
            sentence=f"{scene.path}: splats and occupancy disagree: {100 * agreement.on_surface:.0f} % of the splats "
            f"lie on occupied voxels, {100 * agreement.represented:.0f} % of {agreement.num_voxels} occupied "
            "voxels are represented",
            remedy="check the splats' units and frame, or reconstruct again",
        )


def _read_section(section: type[S], values: object) -> S:
    known = {field.name for field in fields(section)}
    table = values if isinstance(values, dict) else {}
    return section(**{name: value for name, value in table.items() if name in known})


def truth_mismatch(truth: Truth, states: StateColumns, model: RobotModel) -> Reason | None:
    """Mismatch of a truth file and logged states, by stamps and clearances."""
    stamps = states.stamp_ns
    shared = np.intersect1d(truth.stamps, stamps)
    if not len(shared):
        return not_evaluable(
            sentence=f"{truth.path} is of another recording: the log has none of its {len(truth.stamps)} stamps",
            remedy="give the truth.json that simulate wrote with the log",
        )
    if tuple(truth.joint_names) != tuple(model.joint_names) or not truth.robot_spheres.is_file():
        return None  # another model on purpose: nothing to compare with
    own = RobotModel.from_urdf(truth.robot_urdf, truth.robot_spheres, T_world_base=truth.T_world_base)
    own = own.moved_by(truth.joint_names)
    moving = np.flatnonzero(own.moving_spheres)
    worst = 0.0
    for stamp in shared[:: max(len(shared) // fixed.SAME_MOTION_STATES, 1)]:
        q = states.position[int(np.searchsorted(stamps, stamp))]
        gap = truth.distance(own.sphere_centers(q)[moving], int(stamp)) - own.sphere_set.radii[moving]
        recorded = truth.clearance[int(np.searchsorted(truth.stamps, stamp))]
        worst = max(worst, abs(float(gap.min()) - float(recorded)))
    if worst <= fixed.SAME_CLEARANCE:
        return None
    return not_evaluable(
        sentence=f"{truth.path} is of another recording: its clearances differ by up to {1e3 * worst:.0f} mm from "
        "those of the logged motion",
        remedy="give the truth.json that simulate wrote with the log",
    )
