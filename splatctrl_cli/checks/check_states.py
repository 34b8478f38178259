"""Whether joint states are there, finite, in radians, with velocities, and within the robot's limits."""

from collections.abc import Sequence

import numpy as np

from splatctrl_cli.checks.finding import Finding, error, note, warning
from splatctrl_cli.checks.state_check import PoseVerdict, check_angles, pose_agreement
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.rows import blocks_of
from splatctrl_cli.logs.joint_log import JointStream
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.logs.state_messages import STATE_TYPES
from splatctrl_cli.logs.state_topics import joint_records
from splatctrl_cli.logs.survey import Survey
from splatctrl_cli.records import Float64, JointState, LossReport
from splatctrl_cli.robot.model import RobotModel

TURN = 2 * np.pi
DEGREES = 3.0 * TURN  # that no joint of an arm turns to, in radians
MOVING = 1e-3  # [rad or m] of all motion under which nothing moves
LIMIT_SLACK = 0.01  # [rad or m]


def log_states(
    found: Survey, options: SourceOptions, model: RobotModel | None
) -> tuple[StateColumns | None, str, list[Finding]]:
    """The joint states (in the model's order where there is one), why there are none, and what is wrong with them."""
    findings: list[Finding] = []
    for topic in found.of_type(*STATE_TYPES):
        if options.joint_topic in (None, topic.topic.name):
            for stream in topic.joints.streams:
                findings += stream_findings(topic.topic.name, stream)
    loss = LossReport()
    wanted = None if model is None else model.joint_names
    try:
        names, states = joint_records(found, options, loss, wanted)
    except InputError as wrong:
        return None, str(wrong), [*findings, error("joints", "joint states", wrong.message, wrong.remedy)]
    findings += [note("joints", "joint states", text) for text in loss.notes]
    if not len(states):
        lack = "no joint states; record /joint_states, or give the states apart (docs/replay.md, Logs)"
        return None, lack, findings
    if model is None:
        return states, "", findings
    absent = [name for name in model.joint_names if name not in names]
    if absent:
        text = f"the robot's joints {', '.join(absent)} are in no joint state"
        remedy = "give this robot's URDF, or hold them still with --lock"
        return None, f"{text}; {remedy}", [*findings, error("joints", "joint states", text, remedy)]
    states = states.of_joints(np.asarray(model.joint_order(names), dtype=np.int64))
    is_said = any(f.code == "joints-degrees" for f in findings)
    of_robot = robot_findings(model, states, "joint states")
    return states, "", [*findings, *(f for f in of_robot if not (is_said and f.code == "joints-degrees"))]


def stream_findings(where: str, stream: JointStream) -> list[Finding]:
    """What is wrong with the states of a topic that name the same joints, as they were recorded."""
    found: list[Finding] = []
    position = stream.columns().get("position")
    if position is None:
        return []
    num_bad, first_bad, joint = 0, 0, 0
    lowest, highest = np.full(len(stream.names), np.inf), np.full(len(stream.names), -np.inf)
    at = 0
    for block in blocks_of(position):
        is_bad = ~np.isfinite(block)
        rows = np.flatnonzero(is_bad.any(axis=1))
        if len(rows) and not num_bad:
            first_bad, joint = at + int(rows[0]), int(np.argmax(is_bad[rows[0]]))
        num_bad += len(rows)
        lowest = np.fmin(lowest, np.where(is_bad, np.inf, block).min(axis=0, initial=np.inf))
        highest = np.fmax(highest, np.where(is_bad, -np.inf, block).max(axis=0, initial=-np.inf))
        at += len(block)
    if num_bad:
        text = f"{num_bad} of {at} states hold a position that is NaN or infinite; the first: {stream.names[joint]}"
        stamp = int(stream.stamp_ns[first_bad])
        remedy = "they are left out; look at the driver"
        found.append(warning("joints-nan", where, text, remedy, value=num_bad, stamp_ns=stamp))
    widest = np.maximum(np.abs(lowest), np.abs(highest))
    if np.isfinite(widest).any() and float(widest[np.isfinite(widest)].max()) > DEGREES:
        worst = int(np.argmax(np.where(np.isfinite(widest), widest, 0)))
        text = f"{stream.names[worst]} reaches {widest[worst]:.4g}: degrees, not radians?"
        remedy = 'record radians (REP 103), or convert the states to CSV or NPZ with unit = "deg"'
        found.append(error("joints-degrees", where, text, remedy, value=widest[worst]))
    found += _velocities(where, stream, bool((highest - lowest > MOVING).any()))
    return found


def _velocities(where: str, stream: JointStream, is_moving: bool) -> list[Finding]:
    if not is_moving:
        return [note("joints-still", where, "no joint moves")]
    velocity = stream.columns().get("velocity")
    if velocity is None:
        text = "no velocities were recorded: the change of the positions is taken"
        return [note("joints-velocity", where, text)]
    if all(not np.any(np.nan_to_num(block)) for block in blocks_of(velocity)):
        text = "all velocities are zero while joints move: the change of the positions is taken"
        return [warning("joints-velocity", where, text, "let the driver fill them in")]
    return []


def robot_findings(model: RobotModel, states: Sequence[JointState], where: str) -> list[Finding]:
    """The states (model order) against the robot's limits and, where logged, end-effector poses against its FK."""
    try:
        check_angles(model, states, where)
    except InputError as wrong:
        return [error("joints-degrees", where, wrong.message, wrong.remedy)]
    found = _limits(model, states, where)
    agreement = pose_agreement(model, states)
    if agreement is not None and agreement.verdict is not PoseVerdict.STILL:
        is_good = agreement.verdict in {PoseVerdict.AGREE, PoseVerdict.TOOL}
        value = 1e3 * agreement.difference.median_position
        make = note if is_good else error
        remedy = "" if is_good else "give the URDF of this very robot, and its --base"
        found.append(make("end-effector", where, agreement.sentence, remedy, value=value, unit="mm"))
    return found


def _limits(model: RobotModel, states: Sequence[JointState], where: str) -> list[Finding]:
    worst: Float64 = np.zeros(model.num_joints)
    num, first = 0, None
    for state in states:
        beyond = np.maximum(model.lower - state.position, state.position - model.upper)
        worst = np.maximum(worst, beyond)
        if beyond.max() > LIMIT_SLACK:
            num += 1
            first = state.stamp_ns if first is None else first
    if first is None:
        return []
    joint = int(np.argmax(worst))
    text = f"{num} of {len(states)} states are beyond the URDF's limits"
    text += f", {model.joint_names[joint]} by {worst[joint]:.3g}"
    remedy = "is it the right URDF, are the joints in its units, or were its limits lowered?"
    return [warning("joints-limits", where, text, remedy, value=worst[joint], unit="rad", stamp_ns=first)]
