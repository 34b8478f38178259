"""Verdict of a reconstruction."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from splatctrl_cli.calibration.displacement import is_corrected, is_displaced
from splatctrl_cli.config import Config, fixed
from splatctrl_cli.evaluate.metrics import DECIBELS, DESCRIBES, FAULTS, Better, Scale
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, gate_reasons, note, plural, verdict_of
from splatctrl_cli.records import LossReport
from splatctrl_cli.robot.declared_contact import carried_words
from splatctrl_cli.scene.time_steps import AuditRow

UNREPRESENTED = Scale(better=Better.LOWER, absolute=8, relative=0.05)  # voxels; four seeds differ by six
GATED = {
    **dict.fromkeys(("time_steps", "iterations", "splats", "robot_splats", "added", "relocated"), DESCRIBES),
    **dict.fromkeys(("unmet", "evicted"), DESCRIBES),  # more iterations need more slots
    "unrepresented_voxels": UNREPRESENTED,
    "unrepresented_volume": Scale(unit="m3", better=Better.LOWER, absolute=1e-4, relative=0.05),
    "max_unrepresented_voxels": UNREPRESENTED,
    "self_mask_residual_mm": Scale(unit="mm", better=Better.LOWER, absolute=0.5, relative=0.02),
    "camera_displacement_mm": Scale(unit="mm", better=Better.LOWER, absolute=0.5, relative=0.1),
    "inside_robot_points": FAULTS,
    "pose_residual": Scale(unit="m", better=Better.LOWER, absolute=5e-4, relative=0.05),
    "depth_bend": DESCRIBES,
    "exposure_spread": DESCRIBES,
    "loss": Scale(better=Better.LOWER, absolute=1e-3, relative=0.02),
    "psnr": DECIBELS,
}  # figures --require can name, with their comparison scales
LONGEST_BLIND = 1.0  # [s], the age up to which depth is evidence in a replay, by default


@dataclass(frozen=True, kw_only=True)
class Reconstructed:
    """Input of the criteria; is_seeded: splats start from points, and depth was not used."""

    metrics: Mapping[str, Any]
    rows: Sequence[AuditRow]
    config: Config
    loss: LossReport
    is_seeded: bool = False
    learned: Sequence[str] = ()

    def seconds(self, stamp_ns: int) -> float:
        """Time since the first step [s]."""
        return (stamp_ns - self.rows[0].stamp_ns) * 1e-9


def reconstruct_verdict(run: Reconstructed, require: Sequence[str]) -> Verdict:
    metrics, counts = run.metrics, counts_of(run)
    return verdict_of(
        "reconstruct",
        [
            *(reason for criterion in (_map, _blind, _calibration, _inside) for reason in criterion(run)),
            *_notes(metrics, run.loss),
            *gate_reasons(require, {name: metrics[name] for name in GATED}, counts),
        ],
        scope=f"{plural(metrics['time_steps'], 'time step')} of {', '.join(metrics['cameras'])},"
        f" {plural(metrics['splats'], 'splat')}",
        notes=[*run.learned, *(carried_words(entry) for entry in metrics["carried"])],
        is_damaged=bool(run.loss.damaged),
        counts=counts,
    )


def counts_of(run: Reconstructed) -> dict[str, int]:
    links = run.metrics["self_mask"].values()
    seen = [row["num_pixels"] for row in links]
    return dict.fromkeys(GATED, len(run.rows)) | {
        "robot_splats": sum(seen),
        "inside_robot_points": sum(seen),
        "self_mask_residual_mm": sum(row["num_pixels"] for row in links if row["is_judged"]),
        "camera_displacement_mm": sum(row["num_pixels"] for row in run.metrics["displaced_cameras"].values()),
        "loss": sum(row.loss is not None for row in run.rows),
        "psnr": sum(row.psnr is not None for row in run.rows),
    }


def _notes(metrics: Mapping[str, Any], loss: LossReport) -> Iterator[Reason]:
    if stayed := metrics.get("poses", {}).get("held", []):
        shown = ", ".join(stayed[:3]) + (f" and {len(stayed) - 3} more" if len(stayed) > 3 else "")
        yield note(criterion="poses", sentence=f"not corrected, as too far off or without a common surface: {shown}")
    for camera, bend in metrics.get("depth_bends", {}).items():
        yield note(
            criterion="depth",
            sentence=f"{camera}: corrected for a bend of at most {100 * bend['largest']:.1f} % of the depth",
        )
    if loss.invalid_depth:
        yield note(
            criterion="input",
            sentence=f"{loss.invalid_depth} pixels of depth are NaN, infinite, negative or 65535: read as no return",
        )
    yield from (note(criterion="input", sentence=text) for text in loss.notes)


def _map(run: Reconstructed) -> Iterator[Reason]:
    metrics, num = run.metrics, run.metrics["unrepresented_voxels"]
    num_splats = metrics["splats"] - metrics["robot_splats"]
    is_empty = num_splats + num == 0
    yield Reason(
        criterion="map",
        outcome=Outcome.NOT_EVALUABLE if is_empty else Outcome.PASSED,
        sentence="expected splats of objects, got none" if is_empty else f"{num_splats} splats of objects",
        value=float(num_splats),
        threshold=1.0,
        remedy="give a --box that holds what the cameras saw, and check the depth with 'splatctrl check'"
        if is_empty
        else "",
        count=num_splats + num,
    )
    if num:
        yield note(
            criterion="represented space",
            sentence=f"{num} voxels ({1e3 * metrics['unrepresented_volume']:.2f} l) are occupied and have no splat; "
            "they count as obstacles",
            value=float(num),
            remedy=f"raise --max-splats above {run.config.scene.max_splats}",
            count=metrics["splats"] + num,
        )


def _blind(run: Reconstructed) -> Iterator[Reason]:
    for camera, num in run.metrics["repeated_frames"].items():
        yield note(
            criterion="depth", sentence=f"camera {camera}: left out {num} frames that repeat the depth before them"
        )
    without = run.metrics["frames_without_depth"]
    if run.is_seeded or not without:
        return
    longest = longest_blind(run.rows) if run.metrics["has_clock"] else {}
    long = {camera: span for camera, span in longest.items() if (span[1] - span[0]) * 1e-9 > LONGEST_BLIND}
    for camera, (first_ns, last_ns) in long.items():
        start, end = run.seconds(first_ns), run.seconds(last_ns)
        yield note(
            criterion="depth",
            sentence=f"camera {camera} returned no depth from {start:.2f} to {end:.2f} s",
            value=end - start,
            threshold=LONGEST_BLIND,
            unit="s",
            time_s=start,
            who=camera,
            remedy="its view is unknown during that time: run 'splatctrl check'",
            count=without,
        )
    if not long:
        frames = "1 frame has" if without == 1 else f"{without} frames have"
        yield note(criterion="depth", sentence=f"{frames} no depth, and seeded no splats")


def longest_blind(rows: Sequence[AuditRow]) -> dict[str, tuple[int, int]]:
    """First and last stamp [ns] of each camera's longest time without depth."""
    since: dict[str, int] = {}
    longest: dict[str, tuple[int, int]] = {}
    for row in rows:
        for camera in set(row.cameras) - set(row.blind):
            since.pop(camera, None)
        for camera in row.blind:
            span = (since.setdefault(camera, row.stamp_ns), row.stamp_ns)
            longest[camera] = max(longest.get(camera, span), span, key=lambda one: one[1] - one[0])
    return longest


def displaced_camera(camera: str, row: Mapping[str, Any]) -> Reason:
    left = f"; its pose is corrected to within {row['left_mm']:.1f} mm" if is_corrected(row) else ""
    return note(
        criterion="calibration",
        sentence=f"{camera} sees the robot {row['distance_mm']:.1f} mm from where its joints put it{left}",
        value=row["distance_mm"],
        threshold=1e3 * fixed.MISPLACED,
        unit="mm",
        who=camera,
        remedy="find the cameras' poses ('splatctrl calibrate'), and give --calibration",
        count=int(row["num_pixels"]),
    )


def _calibration(run: Reconstructed) -> Iterator[Reason]:
    cameras = run.metrics["displaced_cameras"]
    yield from (displaced_camera(camera, row) for camera, row in cameras.items() if is_displaced(row))
    medians = {link: row["median_mm"] for link, row in run.metrics["self_mask"].items() if row["is_judged"]}
    if not medians:
        if run.metrics.get("robot_links") and not run.metrics["self_mask"] and not run.is_seeded:
            yield note(
                criterion="calibration",
                sentence="no camera sees the robot where its joints put it",
                remedy="give the pose of its root with --base, or make its root the world with --world-frame",
            )
        return
    link = max(medians, key=lambda name: abs(medians[name]))
    median, allowed = medians[link], 1e3 * run.config.occupancy.self_mask_tolerance
    is_off = abs(median) > allowed
    side = "behind" if median > 0 else "before"
    yield Reason(
        criterion="calibration",
        outcome=Outcome.PASSED,
        sentence=f"{link} is measured {abs(median):.1f} mm {side} where its joints put it (median; tolerance "
        f"{allowed:g} mm)",
        value=median,
        threshold=allowed,
        unit="mm",
        who=link,
        remedy="calibrate camera and robot again, or raise occupancy.self_mask_tolerance" if is_off else "",
        count=int(run.metrics["self_mask"][link]["num_pixels"]),
        is_note=is_off,
    )


def _inside(run: Reconstructed) -> Iterator[Reason]:
    num, link = run.metrics["inside_robot_points"], run.metrics["inside_robot_first_link"]
    if num:
        yield note(
            criterion="points inside the robot",
            sentence=f"{num} measured points, which its surface does not explain, first in {link}",
            value=float(num),
            time_s=run.seconds(run.metrics["inside_robot_first_ns"]),
            who=link,
            remedy="look for contact, a carried object, or a wrong calibration ('splatctrl check')",
            count=num,
        )
