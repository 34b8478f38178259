"""Whether joint states fit a robot, and its motion fits what the cameras see: arm, clocks, joint order."""

from collections.abc import Sequence

import numpy as np

from splatctrl_cli.checks.check_arm import (
    ArmAgreement,
    ArmTiming,
    Posture,
    arm_agreement,
    arm_finding,
    arm_timing,
    misplaced_finding,
    posture_at,
    reduced,
    swapped_joints,
)
from splatctrl_cli.checks.finding import Finding, note, warning
from splatctrl_cli.checks.state_motion import ImageMotion
from splatctrl_cli.checks.state_offset import ClockOffset, estimate_clock_offset, states_asked
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.robot.model import RobotModel

OFFSET = 0.030  # [s] between the clocks of cameras and robot
ERROR = 0.010  # [s] of an offset found by the arm; on the simulated log, 0, 80 and 100 ms are found within 7 ms
OWN = 0.85  # of the misfit at the offset of most cameras, for a camera to have an offset of its own
LATE = "synchronise the clocks, or shift the stamps: robot labels and replay come too {}"


def motion_findings(
    frames: Sequence[RgbdFrame], motion: ImageMotion, states: StateColumns, model: RobotModel | None
) -> list[Finding]:
    """What the cameras say of the joint states (in the model's order where there is one).

    frames: reduced, a few of each camera; motion: of the first images of each.
    """
    found: list[Finding] = []
    timings: list[ArmTiming] = []
    if model is not None:
        timings, found = _arm(model, frames, states)
    if timings:
        return [*_timing_findings(timings), *found]
    asked = states.select(states_asked(states.stamp_ns, motion))
    if not motion.cameras:
        return found
    return [_clock_finding(estimate_clock_offset(list(asked), motion)), *found]


def _arm(
    model: RobotModel, frames: Sequence[RgbdFrame], states: StateColumns
) -> tuple[list[ArmTiming], list[Finding]]:
    posture = posture_at(states)
    found: list[Finding] = []
    timings: list[ArmTiming] = []
    bad: dict[str, ArmAgreement] = {}
    for camera in sorted({frame.camera for frame in frames}):
        its = reduced([frame for frame in frames if frame.camera == camera])
        where = f"camera {camera}"
        agreement = arm_agreement(model, its, posture)
        if agreement is None:
            found.append(note("arm", where, "too little of the arm is in view to compare it with the joints"))
            continue
        timing = arm_timing(model, its, posture)
        if timing is not None:
            timings.append(timing)
            agreement = arm_agreement(model, its, posture, offset_s=timing.offset_s) or agreement
        if agreement.is_good or agreement.scale is not None:
            found.append(arm_finding(where, agreement))
        else:
            bad[camera] = agreement
    if bad:
        found.insert(0, misplaced_finding(bad, _swap(model, frames, posture)))
    return _own_timings(timings, model, frames, posture), found


def _own_timings(
    timings: Sequence[ArmTiming], model: RobotModel, frames: Sequence[RgbdFrame], posture: Posture
) -> list[ArmTiming]:
    """Those of cameras that show the arm much better at their own offset than at that of most: another has other
    causes, as a camera that stands elsewhere.
    """
    middle = float(np.median([timing.offset_s for timing in timings] or [0.0]))
    kept = []
    for timing in timings:
        its = reduced([frame for frame in frames if frame.camera == timing.camera])
        at_middle = arm_agreement(model, its, posture, offset_s=middle)
        is_other = abs(timing.offset_s - middle) > OFFSET + ERROR
        if not is_other or at_middle is None or timing.misfit < OWN * at_middle.misfit:
            kept.append(timing)
    return kept


def _swap(model: RobotModel, frames: Sequence[RgbdFrame], posture: Posture) -> str:
    pair = swapped_joints(model, reduced(frames), posture)
    if pair is None:
        return ""
    a, b = (model.joint_names[i] for i in pair)
    return f"exchange {a} and {b}: with their values swapped the arm is where the depth images show it"


def _timing_findings(timings: Sequence[ArmTiming]) -> list[Finding]:
    """One finding for all cameras of one clock, and one for each that has another."""
    middle = float(np.median([timing.offset_s for timing in timings]))
    others = [t for t in timings if abs(t.offset_s - middle) > OFFSET + ERROR] if len(timings) > 2 else []
    found = [
        _offset_finding(f"camera {t.camera}", t.offset_s, f"; those of most cameras {1e3 * middle:+.0f} ms")
        for t in others
    ]
    same = [t for t in timings if t not in others]
    if len(same) == 2 and abs(same[0].offset_s - same[1].offset_s) > OFFSET + ERROR:
        return [*found, *(_offset_finding(f"camera {t.camera}", t.offset_s, "") for t in same)]
    mean = float(np.mean([t.offset_s for t in same]))
    return [*found, _offset_finding("joint states", mean, f" ({len(same)} cameras)")]


def _offset_finding(where: str, offset_s: float, rest: str) -> Finding:
    text = f"frames are stamped {1e3 * offset_s:+.0f} ms against the joint states (+-{1e3 * ERROR:.0f} ms, by where"
    text = f"{text} depth shows the arm){rest}"
    is_off = abs(offset_s) > OFFSET + ERROR
    make = warning if is_off else note
    remedy = LATE.format("late" if offset_s > 0 else "early") if is_off else ""
    return make("robot-clock", where, text, remedy, value=round(1e3 * offset_s, 1), unit="ms")


def _clock_finding(offset: ClockOffset) -> Finding:
    if offset.offset_s is None or offset.uncertainty_s is None:
        return note("robot-clock", "joint states", offset.sentence)
    is_off = abs(offset.offset_s) > OFFSET + 2 * offset.uncertainty_s
    make = warning if is_off else note
    remedy = LATE.format("late" if offset.offset_s > 0 else "early") if is_off else ""
    return make("robot-clock", "joint states", offset.sentence, remedy, value=1e3 * offset.offset_s, unit="ms")
