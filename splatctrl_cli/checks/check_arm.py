"""The robot's motion against depth images, and corrections of clocks or joint order."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from splatctrl_cli.checks import limits
from splatctrl_cli.checks.check_views import rescale_remedy
from splatctrl_cli.checks.clock_offset import ImageMotion, estimate_clock_offset, select_states
from splatctrl_cli.checks.finding import Finding, note, warning
from splatctrl_cli.geometry import strided_lens
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.records import Float64, Posture, RgbdFrame, spread
from splatctrl_cli.robot.model import RobotModel

LATE = "synchronise the clocks, or shift the stamps: robot labels and replay come too {}"


@dataclass(frozen=True, kw_only=True)
class ArmAgreement:
    """Measured minus rendered depth on the robot's pixels, in one camera's frames.

    median [m]: of differences within `ARM_NEAR`, positive if measured behind the surface. misfit [m]: mean distance
    from the median (within 0 and `ARM_COVER`), each cut at `ARM_NEAR`. seen_through: share more than `ARM_NEAR`
    behind. num_pixels: with depth; num_frames: with joint states. scale: measured over rendered depth, if one ratio
    fits most.
    """

    median: float
    misfit: float
    seen_through: float
    num_pixels: int
    num_frames: int
    scale: float | None = None

    @property
    def is_good(self) -> bool:
        """True if the arm is where the joints say."""
        is_there = self.seen_through <= limits.ARM_SEEN_THROUGH and abs(self.median) <= limits.ARM_OFFSET
        return is_there and self.misfit <= limits.ARM_MISFIT


def thin_frames(frames: Sequence[RgbdFrame]) -> list[RgbdFrame]:
    strides = [max(1, -(-frame.depth.shape[0] // limits.ARM_ROWS)) for frame in frames]
    return [
        replace(f, depth=f.depth[::s, ::s], color=f.color[::s, ::s], intrinsics=strided_lens(f.intrinsics, s))
        for f, s in zip(frames, strides, strict=True)
    ]


def arm_agreement(
    model: RobotModel, frames: Sequence[RgbdFrame], posture: Posture, *, offset_s: float = 0.0
) -> ArmAgreement | None:
    """One camera's agreement; None if too little of the arm shows.

    offset_s: the camera's clock minus the joints'.
    """
    parts: list[Float64] = []
    for frame in frames:
        q = posture(frame.stamp_ns - round(offset_s * 1e9))
        if q is None:
            continue
        T_world_link = model.surface.poses({link: model.frame_pose(q, link) for link in model.surface.links})
        predicted = model.surface.render(T_world_link, frame.intrinsics, frame.T_world_camera, frame.depth).depth
        both = (predicted > 0) & (frame.depth > 0)
        parts.append(np.stack([frame.depth[both], predicted[both]]).astype(np.float64))
    rows = np.concatenate(parts, axis=1) if parts else np.zeros((2, 0))
    if rows.shape[1] < limits.ARM_PIXELS:
        return None
    offsets = rows[0] - rows[1]
    reach = limits.ARM_NEAR
    visible = offsets[offsets > -reach]  # what is nearer by more hides the arm
    near = visible[visible < reach]
    behind = float(np.clip(np.median(near), 0.0, limits.ARM_COVER)) if len(near) else 0.0
    ratio = rows[0] / rows[1]
    scale = float(np.median(ratio))
    is_scaled = abs(scale - 1) > limits.ARM_SCALE and np.median(np.abs(ratio / scale - 1)) < limits.ARM_SPREAD / 2
    if len(visible) < limits.ARM_PIXELS and not is_scaled:
        return None
    return ArmAgreement(
        median=float(np.median(near)) if len(near) else float("inf"),
        misfit=float(np.minimum(np.abs(visible - behind), reach).mean()) if len(visible) else reach,
        seen_through=float((visible > reach).mean()) if len(visible) else 0.0,
        num_pixels=rows.shape[1],
        num_frames=len(parts),
        scale=scale if is_scaled else None,
    )


def arm_timing(model: RobotModel, frames: Sequence[RgbdFrame], posture: Posture) -> tuple[float, float] | None:
    """Best clock offset [s] of a camera against the joint states, and its misfit [m].

    None if other offsets fit about as well, or the best fits badly or lies at the search's edge.
    """

    def misfit(offset: float) -> float:
        agreement = arm_agreement(model, frames, posture, offset_s=offset)
        return limits.ARM_NEAR if agreement is None else agreement.misfit

    tried = np.round(np.arange(-limits.TIME_REACH, limits.TIME_REACH + limits.TIME_STEP / 2, limits.TIME_STEP), 3)
    costs = np.array([misfit(float(offset)) for offset in tried])
    best = int(np.argmin(costs))
    if best in {0, len(tried) - 1} or costs[best] > limits.ARM_MISFIT:
        return None
    ends = min(costs[max(best - 4, 0)], costs[min(best + 4, len(tried) - 1)])
    if costs[best] > limits.TIME_CHEAPER * ends or ends - costs[best] < limits.TIME_SAVED:
        return None
    step, fine = limits.TIME_STEP, limits.TIME_FINE
    near = np.round(np.arange(tried[best] - step, tried[best] + step + fine / 2, fine), 3)
    costs = np.array([misfit(float(offset)) for offset in near])
    low = int(np.argmin(costs[1:-1])) + 1
    before, least, after = costs[low - 1 : low + 2]
    bend = before - 2 * least + after
    shift = float(np.clip(0.5 * fine * (before - after) / bend, -fine, fine)) if bend > 0 else 0.0
    return float(near[low]) + shift, float(least)


def _exchanged(posture: Posture, i: int, j: int) -> Posture:
    def exchanged(stamp_ns: int) -> Float64 | None:
        q = posture(stamp_ns)
        return None if q is None else q[[{i: j, j: i}.get(joint, joint) for joint in range(len(q))]]

    return exchanged


def motion_findings(
    frames: Sequence[RgbdFrame],
    motion: ImageMotion,
    states: StateColumns,
    model: RobotModel | None,
    units: Iterable[float | None] = (None,),
) -> list[Finding]:
    """Findings that compare joint states (model order, if any) with the cameras.

    frames: reduced, a few per camera. motion: in each camera's first images. units: [m] per count of depth, or None.
    """
    offsets, findings = ({}, []) if model is None else _arm_findings(model, frames, states, units)
    if offsets:
        return [*_timing_findings(offsets), *findings]
    if not motion.cameras:
        return findings
    offset = estimate_clock_offset(list(states.select(select_states(states.stamp_ns, motion))), motion)
    if offset.offset_s is None or offset.uncertainty_s is None:
        return [note("robot-clock", "joint states", offset.sentence), *findings]
    least_s = limits.TIME_OFFSET + 2 * offset.uncertainty_s
    return [
        _clock_finding("joint states", offset.sentence, offset.offset_s, least_s, 1e3 * offset.offset_s),
        *findings,
    ]


def _arm_findings(
    model: RobotModel, frames: Sequence[RgbdFrame], states: StateColumns, units: Iterable[float | None]
) -> tuple[dict[str, float], list[Finding]]:
    posture = states.postures(limits.ARM_CLOSE_NS)
    findings: list[Finding] = []
    timings: dict[str, tuple[float, float]] = {}
    bad: dict[str, ArmAgreement] = {}
    for camera in sorted({frame.camera for frame in frames}):
        its = thin_frames([frame for frame in frames if frame.camera == camera])
        where = f"camera {camera}"
        agreement = arm_agreement(model, its, posture)
        if agreement is None:
            findings.append(
                note("arm", where, "too little of the arm is in view to compare its depth with the joint states")
            )
            continue
        timing = arm_timing(model, its, posture)
        if timing is not None:
            timings[camera] = timing
            agreement = arm_agreement(model, its, posture, offset_s=timing[0]) or agreement
        if agreement.scale is not None:
            findings.append(
                warning(
                    "arm",
                    where,
                    f"the arm's depth is {agreement.scale:.3g} times its distance by the joint states",
                    f"{rescale_remedy(units, 1 / agreement.scale)}, or check --base and the camera's pose",
                    value=round(agreement.scale, 3),
                )
            )
        elif agreement.is_good:
            findings.append(
                note(
                    "arm",
                    where,
                    f"the arm's depth is {1e3 * agreement.median:+z.0f} mm behind its surface (median of"
                    f" {agreement.num_pixels} pixels in {agreement.num_frames} images);"
                    f" {100 * agreement.seen_through:.0f} % of them show the background",
                    value=round(1e3 * agreement.median, 1),
                    unit="mm",
                )
            )
        else:
            bad[camera] = agreement
    if bad:
        off = [1e3 * agreement.misfit for agreement in bad.values()]
        through = ", ".join(f"{100 * agreement.seen_through:.0f}" for agreement in bad.values())
        findings.insert(
            0,
            warning(
                "arm",
                f"camera{'s' if len(bad) > 1 else ''} {', '.join(bad)}",
                f"the arm is not where the joints say: {', '.join(f'{each:.0f}' for each in off)} mm off in the mean"
                f" (each pixel counted as {1e3 * limits.ARM_NEAR:.0f} mm at most); {through} % of its pixels show"
                " what is behind it",
                _swap(model, frames, posture)
                or "check the URDF, --base, the joints' zeros and the camera's pose; robot labels will be wrong",
                value=round(max(off), 1),
                unit="mm",
            ),
        )
    return _own_offsets(timings, model, frames, posture), findings


def _own_offsets(
    timings: Mapping[str, tuple[float, float]], model: RobotModel, frames: Sequence[RgbdFrame], posture: Posture
) -> dict[str, float]:
    middle = float(np.median([offset_s for offset_s, _ in timings.values()] or [0.0]))
    offsets = {}
    for camera, (offset_s, misfit) in timings.items():
        at_middle = arm_agreement(
            model, thin_frames([frame for frame in frames if frame.camera == camera]), posture, offset_s=middle
        )
        is_other = abs(offset_s - middle) > limits.TIME_OFFSET + limits.TIME_ERROR
        if not is_other or at_middle is None or misfit < limits.TIME_OWN * at_middle.misfit:
            offsets[camera] = offset_s
    return offsets


def _swap(model: RobotModel, frames: Sequence[RgbdFrame], posture: Posture) -> str:
    """Remedy that names two joints to exchange.

    The arm is then where depth shows it. Empty without such a pair.
    """
    few = spread(thin_frames(frames), limits.SWAPPED_FRAMES)
    plain = arm_agreement(model, few, posture)
    tried = (
        (arm_agreement(model, few, _exchanged(posture, *p)), p) for p in combinations(range(model.num_joints), 2)
    )
    good = ((agreement.misfit, pair) for agreement, pair in tried if agreement is not None and agreement.is_good)
    best = min(good, default=None)
    pair = None if best is None or plain is None or best[0] > limits.SWAPPED_MISFIT * plain.misfit else best[1]
    if pair is None:
        return ""
    a, b = (model.joint_names[i] for i in pair)
    return f"exchange {a} and {b}: with their values swapped the arm is where the depth images show it"


def _timing_findings(offsets: Mapping[str, float]) -> list[Finding]:
    middle = float(np.median(list(offsets.values())))
    apart = limits.TIME_OFFSET + limits.TIME_ERROR
    others = {c: offset for c, offset in offsets.items() if abs(offset - middle) > apart and len(offsets) > 2}
    most = f"; those of most cameras {1e3 * middle:+.0f} ms"
    findings = [_offset_finding(f"camera {c}", offset, most) for c, offset in others.items()]
    same = {c: offset for c, offset in offsets.items() if c not in others}
    if len(same) == 2 and np.ptp(list(same.values())) > apart:
        return [*findings, *(_offset_finding(f"camera {c}", offset, "") for c, offset in same.items())]
    return [
        *findings,
        _offset_finding("joint states", float(np.mean(list(same.values()))), f" ({len(same)} cameras)"),
    ]


def _offset_finding(where: str, offset_s: float, rest: str) -> Finding:
    return _clock_finding(
        where,
        f"frames are stamped {1e3 * offset_s:+z.0f} ms against the joint states (+-{1e3 * limits.TIME_ERROR:.0f} ms,"
        f" by the arm's depth){rest}",
        offset_s,
        limits.TIME_OFFSET + limits.TIME_ERROR,
        round(1e3 * offset_s, 1),
    )


def _clock_finding(where: str, text: str, offset_s: float, least_s: float, value: float) -> Finding:
    if abs(offset_s) <= least_s:
        return note("robot-clock", where, text, "", value=value, unit="ms")
    return warning(
        "robot-clock", where, text, LATE.format("late" if offset_s > 0 else "early"), value=value, unit="ms"
    )
