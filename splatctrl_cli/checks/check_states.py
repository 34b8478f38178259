"""Checks of joint states: values, units, velocities, limits and end-effector poses."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from splatctrl_cli.checks import limits
from splatctrl_cli.checks.finding import ERROR, NOTE, WARNING, Finding, error, judge, note, warning
from splatctrl_cli.config.fixed import STATES_STILL
from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_if
from splatctrl_cli.files.spilled_rows import blocks_of, ranges
from splatctrl_cli.geometry import invert_transform, pose_at
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.log.state_messages import STATE_TYPES, JointStream
from splatctrl_cli.recording.log.state_topics import joint_records, refuse_contradiction, state_topics
from splatctrl_cli.recording.log.survey import Survey
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, Index, JointState, LossReport, spread
from splatctrl_cli.robot.model import RobotModel

JOINT_STATES = "joint states"
"""The place of a finding on them."""
DEGREES = 6 * np.pi  # [rad] that no joint of an arm turns to: three turns


PoseVerdict = Literal["agree", "tool", "base", "disagree", "still"]  # of logged end-effector poses on a robot model


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Median and largest pose difference, in position [m] and rotation [rad]."""

    median_position: float
    max_position: float
    median_rotation: float
    max_rotation: float

    @property
    def is_small(self) -> bool:
        return self.max_position < limits.POSES_POSITION and self.max_rotation < limits.POSES_ROTATION

    @property
    def words(self) -> str:
        return (
            f"median {1e3 * self.median_position:.2f} mm and {np.degrees(self.median_rotation):.2f} deg, "
            f"largest {1e3 * self.max_position:.2f} mm and {np.degrees(self.max_rotation):.2f} deg"
        )


@dataclass(frozen=True)
class PoseAgreement:
    """Logged end-effector poses against forward kinematics.

    difference: from `link`, which explains the poses best. offset (4, 4): the constant transform that explains most,
    T_link_ee of a tool or T_logged_base of a wrong base. rest: the difference that remains.
    """

    verdict: PoseVerdict
    link: str
    num_poses: int
    difference: Spread
    offset: Float64
    rest: Spread

    @property
    def sentence(self) -> str:
        x, y, z = self.offset[:3, 3]
        by = f"({x:.4f}, {y:.4f}, {z:.4f}) m and {np.degrees(_angle(self.offset[:3, :3])):.1f} deg"
        words: dict[PoseVerdict, str] = {
            "agree": f"agree with {self.link}: {self.difference.words}",
            "tool": f"stand at {by} in {self.link}: a flange or tool transform; apart from that {self.rest.words}",
            "base": f"are moved by {by} in the world: is --base right? apart from that {self.rest.words}",
            "still": "cannot be judged: the robot hardly moves",
            "disagree": f"do not fit this robot, with any tool: {self.rest.words} from {self.link}; "
            "wrong URDF, joint order, or units?",
        }
        return f"{self.num_poses} logged end-effector poses {words[self.verdict]}"


def check_states(states: StateColumns, joints: Sequence[str]) -> None:
    """Raise InputError for no states, decreasing stamps, too long a pause, or non-finite positions."""
    stamps = states.stamp_ns
    refuse_if(
        not len(stamps), "joint states: expected at least one, got none", remedy="check the log's /joint_states"
    )
    steps = np.diff(stamps)
    back = np.flatnonzero(steps < 0)
    if len(back):
        before, after = stamps[back[0] : back[0] + 2]
        raise InputError(
            f"joint state {back[0] + 1}: expected a stamp not before {before} ns, got {after} ns",
            remedy="sort the states by stamp",
        )
    pause = steps.max(initial=0)
    refuse_if(
        pause > limits.STATES_PAUSE * 1e9,
        f"joint states: mixed clocks: stamps jump by {pause * 1e-9:.0f} s at state"
        f" {int(np.argmax(np.append(0, steps)))} of {len(stamps)}",
        remedy="cut the log there, or give all states the times of one clock",
    )
    for first, last in ranges(len(stamps)):
        q = states.position[first:last]
        if not np.isfinite(q).all():
            index, joint = (int(i[0]) for i in np.nonzero(~np.isfinite(q)))
            raise InputError(
                f"joint state {first + index}: joint {joints[joint]} is {q[index, joint]}, expected a finite angle"
            )


def check_angles(model: RobotModel, states: Sequence[JointState], name: str) -> None:
    """Raise InputError if positions (model order) far exceed limits, but fit as degrees."""
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    if not len(states) or not limited.any():
        return
    lower, upper, slack = model.lower[limited], model.upper[limited], limits.DEGREES_SLACK
    num_far = num_fit = 0
    worst, at_worst = np.full(len(lower), -np.inf), np.zeros(len(lower))  # of each joint
    rows = states.position if isinstance(states, StateColumns) else np.array([state.position for state in states])
    for q in blocks_of(rows):
        beyond = np.abs(q[:, limited]) - np.maximum(np.maximum(np.abs(lower), np.abs(upper)), 2 * np.pi)
        as_degrees = np.radians(q[:, limited])
        num_far += int((beyond.max(axis=1) > limits.ANGLES_FAR).sum())
        num_fit += int(((as_degrees > lower - slack) & (as_degrees < upper + slack)).all(axis=1).sum())
        for joint, row in enumerate(beyond.argmax(axis=0)):
            if beyond[row, joint] > worst[joint]:
                worst[joint], at_worst[joint] = beyond[row, joint], q[row, limited][joint]
    if num_far / len(states) < limits.STATES_SHARE or num_fit / len(states) < 1 - (1 - limits.STATES_SHARE) / 5:
        return
    joint = int(np.argmax(worst))
    names = [n for n, is_limited in zip(model.joint_names, limited, strict=True) if is_limited]
    raise InputError(
        f"{name}: joint {names[joint]}: expected radians within [{lower[joint]:.3f}, {upper[joint]:.3f}], "
        f"got {at_worst[joint]:.4g}, which would fit as degrees",
        remedy=_unit_remedy(names),
    )


def _unit_remedy(names: Sequence[str]) -> str:
    if all(name.endswith(".pos") for name in names):
        return (
            "LeRobot's numbers are -100 to 100 of a calibrated range, or degrees with use_degrees:"
            " convert them to radians with the arm's calibration file"
        )
    return 'record radians (REP 103), or give them as CSV or NPZ with unit = "deg" (splatctrl help replay, Logs)'


def pose_agreement(model: RobotModel, states: Sequence[JointState]) -> PoseAgreement | None:
    """Agreement of logged poses in `states` (model order) with the best link; None without poses.

    A constant difference in a link's frame means a tool; in the world, a wrong base. Any other means another robot.
    """
    posed = _posed(states)
    if not len(posed):
        return None
    chosen = [states[i] for i in spread(posed.tolist(), limits.POSES_COMPARED)]
    logged = np.array([_world(model, state) for state in chosen])
    links = {
        link: np.array([model.frame_pose(state.position, link) for state in chosen]) for link in model.frame_names
    }
    near = min(links, key=lambda link: _cost(_spread(links[link], logged)))
    difference = _spread(links[near], logged)
    if difference.is_small:
        return PoseAgreement("agree", near, len(chosen), difference, np.eye(4), difference)
    tools = {link: _explain(poses, logged) for link, poses in links.items()}
    bases = {link: _explain(_inverse(poses), _inverse(logged)) for link, poses in links.items()}
    tool = min(tools, key=lambda link: (round(_cost(tools[link][1]), 6), _cost(_spread(links[link], logged))))
    base = min(bases, key=lambda link: _cost(bases[link][1]))
    travel = _spread(np.broadcast_to(logged[0], logged.shape), logged)
    if max(travel.max_position, travel.max_rotation) < limits.LINK_TRAVEL:
        return PoseAgreement("still", near, len(chosen), difference, np.eye(4), difference)
    if tools[tool][1].is_small:
        return PoseAgreement("tool", tool, len(chosen), _spread(links[tool], logged), *tools[tool])
    if bases[base][1].is_small:
        offset, rest = bases[base]
        return PoseAgreement("base", base, len(chosen), _spread(links[base], logged), invert_transform(offset), rest)
    return PoseAgreement("disagree", tool, len(chosen), _spread(links[tool], logged), *tools[tool])


def _posed(states: Sequence[JointState]) -> Index:
    if isinstance(states, StateColumns) and states.T_base_ee is None and states.T_world_ee is None:
        return np.zeros(0, dtype=np.int64)
    has_pose = (s.T_base_ee is not None or s.T_world_ee is not None for s in states)
    return np.flatnonzero(np.fromiter(has_pose, dtype=np.bool_, count=len(states)))


def _world(model: RobotModel, state: JointState) -> Float64:
    if state.T_world_ee is not None:
        return state.T_world_ee
    assert state.T_base_ee is not None
    return np.asarray(model.T_world_base @ state.T_base_ee)


def _explain(poses: Float64, logged: Float64) -> tuple[Float64, Spread]:
    """X (4, 4) of logged = poses X, and the rest."""
    relative = _inverse(poses) @ logged
    U, _, Vt = np.linalg.svd(relative[:, :3, :3].sum(axis=0))
    X = pose_at(np.median(relative[:, :3, 3], axis=0), U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)
    return X, _spread(poses @ X, logged)


def _inverse(poses: Float64) -> Float64:
    return np.array([invert_transform(T) for T in poses])


def _spread(poses: Float64, logged: Float64) -> Spread:
    position = np.linalg.norm(poses[:, :3, 3] - logged[:, :3, 3], axis=1)
    rotation = np.array([_angle(R) for R in np.swapaxes(poses[:, :3, :3], 1, 2) @ logged[:, :3, :3]])
    return Spread(
        median_position=float(np.median(position)),
        max_position=float(position.max()),
        median_rotation=float(np.median(rotation)),
        max_rotation=float(rotation.max()),
    )


def _angle(R: Float64) -> float:
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(np.linalg.norm(axis), np.trace(R) - 1.0))


def _cost(spread: Spread) -> float:
    return spread.median_position + limits.POSES_LEVER * spread.median_rotation


@dataclass(frozen=True, kw_only=True)
class RobotStates:
    """Joint states (model order, if any), and findings.

    lack: why there are no states. model: with the joints that the states move.
    """

    model: RobotModel | None
    states: StateColumns | None = None
    lack: str = ""
    findings: Sequence[Finding] = ()


def log_states(
    survey: Survey, options: SourceOptions, model: RobotModel | None, frames: Mapping[str, Float64 | None]
) -> RobotStates:
    findings: list[Finding] = []
    for topic in survey.select_types(*STATE_TYPES):
        if options.joint_topic in (None, topic.topic.name):
            for stream in topic.joints.streams.values():
                findings += stream_findings(topic.topic.name, stream)
    loss = LossReport()
    joints = None if model is None else model.joint_names
    try:
        if topics := state_topics(survey, options, LossReport()):
            refuse_contradiction(topics, joints)
        names, states = joint_records(survey, options, loss, joints)
    except (InputError, NotEvaluableError) as wrong:
        findings.append(error("joints", JOINT_STATES, wrong.message, wrong.remedy))
        return RobotStates(model=model, lack=str(wrong), findings=findings)
    findings += [note("joints", JOINT_STATES, text) for text in loss.notes]
    if not len(states):
        return RobotStates(
            model=model,
            lack="no joint states; record /joint_states, or give the states apart (splatctrl help replay, Logs)",
            findings=findings,
        )
    of_robot = robot_states(model, names, states, frames)
    is_said = any(f.code == "joints-degrees" for f in findings)
    more = [f for f in of_robot.findings if not (is_said and f.code == "joints-degrees")]
    return replace(of_robot, findings=[*findings, *more])


def robot_states(
    model: RobotModel | None,
    names: Sequence[str],
    states: StateColumns,
    frames: Mapping[str, Float64 | None],
) -> RobotStates:
    """States of joints `names`, like `log_states`; frames: as in `RobotModel.moved_by`."""
    if model is None:
        return RobotStates(model=None, states=states)
    try:
        model = model.moved_by(names, frames)
        states = states.convert_joints(*model.joint_columns(names))
    except InputError as wrong:
        return RobotStates(
            model=model, lack=str(wrong), findings=[error("joints", JOINT_STATES, wrong.message, wrong.remedy)]
        )
    of_fingers = [note("joints", JOINT_STATES, model.locked_words)] if model.locked else []
    return RobotStates(model=model, states=states, findings=[*of_fingers, *robot_findings(model, states)])


def stream_findings(where: str, stream: JointStream) -> Iterator[Finding]:
    position = stream.columns().get("position")
    if position is None:
        return
    num_bad = at = 0
    first_bad, joint = None, 0
    lowest, highest = np.full(len(stream.names), np.inf), np.full(len(stream.names), -np.inf)
    for block in blocks_of(position):
        is_bad = ~np.isfinite(block)
        rows = np.flatnonzero(is_bad.any(axis=1))
        if len(rows) and not num_bad:
            first_bad, joint = int(stream.stamp_ns[at + rows[0]]), int(np.argmax(is_bad[rows[0]]))
        num_bad += len(rows)
        lowest = np.fmin(lowest, np.where(is_bad, np.inf, block).min(axis=0, initial=np.inf))
        highest = np.fmax(highest, np.where(is_bad, -np.inf, block).max(axis=0, initial=-np.inf))
        at += len(block)
    widest = np.maximum(np.abs(lowest), np.abs(highest))
    widest = np.where(np.isfinite(widest), widest, 0.0)
    worst = int(np.argmax(widest))
    yield from judge(
        WARNING if num_bad else None,
        "joints-nan",
        where,
        f"{num_bad} of {at} states hold a position that is NaN or infinite; the first: {stream.names[joint]}",
        value=num_bad,
        stamp_ns=first_bad,
    )
    yield from judge(
        ERROR if widest[worst] > DEGREES else None,
        "joints-degrees",
        where,
        f"{stream.names[worst]} reaches {widest[worst]:.4g}: degrees, not radians?",
        _unit_remedy(stream.names),
        value=widest[worst],
    )
    velocity = stream.columns().get("velocity")
    if not (highest - lowest > STATES_STILL).any():
        yield note("joints-still", where, "no joint moves")
    elif velocity is None:
        yield note("joints-velocity", where, "no velocities were recorded: the change of the positions is taken")
    elif all(not np.any(np.nan_to_num(block)) for block in blocks_of(velocity)):
        text = "all velocities are zero while joints move: the change of the positions is taken"
        yield warning("joints-velocity", where, text, "let the driver fill them in")


def robot_findings(model: RobotModel, states: Sequence[JointState]) -> list[Finding]:
    """Findings of states (model order) against limits, and of logged poses against forward kinematics."""
    try:
        check_angles(model, states, JOINT_STATES)
    except InputError as wrong:
        return [error("joints-degrees", JOINT_STATES, wrong.message, wrong.remedy)]
    agreement = pose_agreement(model, states)
    if agreement is None or agreement.verdict == "still":
        return _limits(model, states, JOINT_STATES)
    severity = NOTE if agreement.verdict in {"agree", "tool"} else ERROR
    remedy = "" if severity is NOTE else "give the URDF of this very robot, and its --base"
    value = 1e3 * agreement.difference.median_position
    findings = judge(severity, "end-effector", JOINT_STATES, agreement.sentence, remedy, value=value, unit="mm")
    return [*_limits(model, states, JOINT_STATES), *findings]


def _limits(model: RobotModel, states: Sequence[JointState], where: str) -> list[Finding]:
    worst: Float64 = np.zeros(model.num_joints)
    num, first = 0, None
    for state in states:
        beyond = np.maximum(model.lower - state.position, state.position - model.upper)
        worst = np.maximum(worst, beyond)
        if beyond.max() > limits.LIMIT_SLACK:
            num += 1
            first = state.stamp_ns if first is None else first
    joint = int(np.argmax(worst))
    text = f"{num} of {len(states)} states are beyond the URDF's limits"
    text = f"{text}, {model.joint_names[joint]} by {worst[joint]:.3g}"
    severity = None if first is None else WARNING
    return judge(severity, "joints-limits", where, text, value=worst[joint], unit="rad", stamp_ns=first)
