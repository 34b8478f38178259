"""Controller of a replay and its goal."""

import csv
import re
import shlex
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.config.ranges import POSE, checked_pose
from splatctrl_cli.control.goals import TwistTrack
from splatctrl_cli.control.outside import (
    STEP_LIMIT,
    Connect,
    OutsideController,
    Program,
    RecordedCommands,
    class_command,
)
from splatctrl_cli.control.policy import PolicyClient, RecordedImages, is_policy_server, parse_address
from splatctrl_cli.control.preconditions import checked_posture
from splatctrl_cli.control.replay import Waypoint
from splatctrl_cli.control.step import OURS, Commander
from splatctrl_cli.errors import InputError, UsageError, refuse_faults, refuse_if, require
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, Better, Scale
from splatctrl_cli.evaluate.views import frames_of
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.replay.request import ReplayInputs, ReplayRequest, Trace
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.recording.state.state_source import read_twists
from splatctrl_cli.records import Float64, Stamps
from splatctrl_cli.robot.model import RobotModel

WORLD = "world"
RECORDED = "recorded"  # name of the controller that repeats the log's commands
TWIST_FIGURES = {
    "twist_share": DESCRIBES,
    "twist_share_capped": BAD_SHARE,
    **dict.fromkeys(
        ("mean_twist_error_linear", "max_twist_error_linear"),
        Scale(unit="m/s", better=Better.LOWER, absolute=1e-3, relative=0.02),
    ),
    **dict.fromkeys(
        ("mean_twist_error_angular", "max_twist_error_angular"),
        Scale(unit="rad/s", better=Better.LOWER, absolute=1e-3, relative=0.02),
    ),
}
POSE_COLUMNS = tuple(POSE.split(","))


def check_goal(request: ReplayRequest) -> None:
    """Raise UsageError for an option the mode does not use."""
    controlled, driven = ("open-loop", "closed-loop"), ("closed-loop",)
    modes = {"re_anchor": driven, **dict.fromkeys(("goal", "goal_joints", "waypoints", "follow"), controlled)}
    for option, wanted in modes.items():
        value = getattr(request, option)
        if value is not None and value is not False and request.mode not in wanted:
            name = "--" + option.replace("_", "-")
            raise UsageError(
                f"{name}: expected --mode {' or '.join(wanted)}, got {request.mode}",
                remedy=f"give --mode {wanted[-1]}, or leave out {name}",
            )


def goal_waypoints(
    request: ReplayRequest, model: RobotModel, frame: str, logged_end: Float64
) -> tuple[Waypoint, ...]:
    """Requested goals, at least one; by default the logged end pose."""
    if request.goal is not None:
        return (Waypoint(T_world_goal=transform_from(request.goal[:3], request.goal[3:])),)
    if request.goal_joints is not None:
        posture = _posture(model, np.array(request.goal_joints), logged_end)
        return (Waypoint(T_world_goal=model.frame_pose(posture, frame), posture=posture),)
    if request.waypoints is not None:
        return read_waypoints(request.waypoints, model, frame)
    return (Waypoint(T_world_goal=model.frame_pose(logged_end, frame)),)


def _posture(model: RobotModel, values: Float64, logged_end: Float64) -> Float64:
    """Configuration (J,) from --goal-joints; omitted fingers keep their last logged values."""
    is_arm = [name not in model.urdf.grippers for name in model.joint_names]
    if len(values) == sum(is_arm):
        posture = logged_end.copy()
        posture[is_arm] = values
        values = posture
    return checked_posture(model, values, what="--goal-joints")


def read_waypoints(path: Path, model: RobotModel, frame: str) -> tuple[Waypoint, ...]:
    """Read poses or postures from a file.

    A row has x, y, z, qx, qy, qz, qw, or a value per joint. Rows are those of a CSV with a header, or TOML tables
    ``[[waypoint]]`` with ``pose = [...]`` or ``joints = [...]``. Raises InputError.
    """
    remedy = "give --waypoints a .toml or .csv file"
    with refuse_faults(f"{path}: cannot be read", OSError, UnicodeDecodeError, remedy=remedy):
        text = path.read_text(encoding="utf-8")
    rows = list(_csv_rows(path, text, model.joint_names) if path.suffix == ".csv" else _toml_rows(path, text))
    refuse_if(not rows, f"{path}: expected at least one waypoint, got none")
    waypoints = []
    for number, (kind, row) in enumerate(rows):
        what = f"{path}: waypoint {number}"
        if kind == "joints":
            posture = checked_posture(model, np.array(row), what=what)
            waypoints.append(Waypoint(T_world_goal=model.frame_pose(posture, frame), posture=posture))
            continue
        with refuse_faults(what, ValueError):
            values = checked_pose(row)
        waypoints.append(Waypoint(T_world_goal=transform_from(values[:3], values[3:])))
    return tuple(waypoints)


def _csv_rows(path: Path, text: str, joints: tuple[str, ...]) -> Iterator[tuple[str, list[float]]]:
    reader = csv.DictReader(text.splitlines())
    header = tuple(reader.fieldnames or ())
    wanted = require(
        next((names for names in (POSE_COLUMNS, joints) if set(names) <= set(header)), None),
        f"{path}: expected the columns {POSE} or {','.join(joints)}, got {','.join(header) or 'none'}",
    )
    for number, row in enumerate(reader):
        try:
            yield "pose" if wanted is POSE_COLUMNS else "joints", [float(row[name]) for name in wanted]
        except (TypeError, ValueError):
            raise InputError(f"{path}: waypoint {number}: expected numbers, got {list(row.values())}") from None


def _toml_rows(path: Path, text: str) -> Iterator[tuple[str, list[float]]]:
    with refuse_faults(f"{path}: not valid TOML", tomllib.TOMLDecodeError):
        document: dict[str, Any] = tomllib.loads(text)
    entries = document.get("waypoint", [])
    for number, entry in enumerate(entries if isinstance(entries, list) else [entries]):
        refuse_if(
            not isinstance(entry, dict) or len(entry) != 1 or not set(entry) <= {"pose", "joints"},
            f"{path}: waypoint {number}: expected pose = [...] or joints = [...], got {entry}",
        )
        ((kind, values),) = entry.items()
        refuse_if(
            not isinstance(values, list) or not all(type(value) in (int, float) for value in values),
            f"{path}: waypoint {number}: {kind}: expected an array of numbers, got {values}",
        )
        yield kind, [float(value) for value in values]


def check_twists(request: ReplayRequest) -> None:
    """Raise UsageError for twists without a controller, or a frame without twists."""
    refuse_if(
        request.twist_topic is not None and request.mode == "audit",
        "--twist-topic: expected --mode open-loop or closed-loop",
        remedy="an audit uses no controller",
        error=UsageError,
    )
    refuse_if(
        request.twist_frame is not None and request.twist_topic is None,
        "--twist-frame: expected --twist-topic",
        remedy="leave it out",
        error=UsageError,
    )


def twist_track(request: ReplayRequest, model: RobotModel, states_ns: Stamps, console: Progress) -> TwistTrack | None:
    """Read the twists of --twist-topic, None without the option; states_ns: joint states' stamps (T,).

    Raises InputError for an unknown frame, or no overlap in time.
    """
    if request.twist_topic is None:
        return None
    logged = read_twists(request.log, request.twist_topic)
    frame = logged.frame if request.twist_frame is None else request.twist_frame
    refuse_if(
        frame != WORLD and frame not in model.frame_names,
        f"{logged.where}: expected twists in world or a link of the robot, got frame {frame!r}",
        remedy=f"give --twist-frame, one of: world, {', '.join(model.frame_names)}",
    )
    first, last = int(logged.stamp_ns[0]), int(logged.stamp_ns[-1])
    refuse_if(
        last < states_ns[0] or first > states_ns[-1],
        f"{logged.where}: mixed clocks: expected twists between the joint states' stamps {states_ns[0]} and "
        f"{states_ns[-1]} ns, got {first} to {last} ns",
        remedy="record both by one clock",
    )
    from_s, to_s = ((stamp - states_ns[0]) * 1e-9 for stamp in (first, last))
    console.log(f"replay: {len(logged.stamp_ns)} twists in {frame}, {from_s:.2f} to {to_s:.2f} s of the log")
    for note in logged.notes:
        console.log(f"replay: {request.twist_topic}: {note}")
    return TwistTrack(stamp_ns=logged.stamp_ns, twist=logged.twist, axes=None if frame == WORLD else frame)


def twist_figures(
    model: RobotModel,
    config: ControlConfig,
    frame: str,
    track: TwistTrack | None,
    trace: Trace,
) -> Mapping[str, float | None]:
    """Values of `TWIST_FIGURES` over a controller's T steps; empty without twists.

    Shares of states with a valid twist, and of capped ones among them; errors [m/s, rad/s] by columns `q` and `v`.
    """
    if track is None:
        return {}
    stamp_ns, states = trace.stamp_ns, zip(trace.stamp_ns, trace.rows("q"), trace.rows("v"), strict=True)
    is_known = track.is_known(stamp_ns, config.twist_timeout)
    num_known = num_capped = 0
    linear, angular = np.empty(len(stamp_ns)), np.empty(len(stamp_ns))
    for i, (stamp, q, v) in enumerate(states):
        reference = track.reference(model, config, q, int(stamp))
        if is_known[i]:
            num_known += 1
            num_capped += not np.array_equal(
                reference, track.find_world_twist(model, q, int(stamp), config.twist_timeout)
            )
        missed = model.frame_jacobian(q, frame) @ v - reference
        linear[i], angular[i] = np.linalg.norm(missed[:3]), np.linalg.norm(missed[3:])
    values = [float(is_known.mean()), num_capped / num_known if num_known else None]
    for errors in (linear[~np.isnan(linear)], angular[~np.isnan(angular)]):
        values += [float(np.mean(errors)), float(np.max(errors))] if len(errors) else [None, None]
    return dict(zip(TWIST_FIGURES, values, strict=True))


def check_controller(request: ReplayRequest) -> None:
    """Raise UsageError for a controller in an audit, an invalid controller, or options without one."""
    if request.controller is None and request.controller_command is None:
        refuse_if(
            request.controller_twice or request.controller_step_limit != STEP_LIMIT,
            "--controller-twice, --controller-step-limit: expected a controller",
            remedy="give --controller or --controller-command, or leave them out",
            error=UsageError,
        )
        return
    refuse_if(
        request.controller is not None and request.controller_command is not None,
        "--controller, --controller-command: expected one of them, got both",
        error=UsageError,
    )
    refuse_if(
        request.mode == "audit",
        "--controller, --controller-command: expected --mode open-loop or closed-loop",
        remedy="an audit uses no controller",
        error=UsageError,
    )
    if is_policy_server(request.controller or ""):
        parse_address(request.controller or "")
    elif request.controller != RECORDED:
        _read_command(request)


@contextmanager
def commander_of(
    request: ReplayRequest, inputs: ReplayInputs, console: Progress, *, frame: str, home: Float64 | None
) -> Iterator[Commander]:
    """Start our controller or the user's, which ends with the block.

    Raises InputError if the controller does not start.
    """
    if request.controller is None and request.controller_command is None:
        yield OURS
        return
    name, connect = _connector(request, inputs)
    console.log(f"replay: starting the controller {name}")
    control, is_twice = request.config.control, request.controller_twice
    with OutsideController(
        name, connect, inputs.model, control, frame=frame, home=home, is_twice=is_twice
    ) as outside:
        yield outside
        if outside.num_answers:
            mean, slowest = outside.seconds / outside.num_answers, outside.slowest
            console.log(
                f"replay: {outside.num_answers} answers, {1e3 * mean:.2g} ms each, at most {1e3 * slowest:.2g}"
            )


def _connector(request: ReplayRequest, inputs: ReplayInputs) -> tuple[str, Connect]:
    """Name and factory of the user's controller. Raises InputError for a log without commands."""
    limit, source, states = request.controller_step_limit, inputs.source, inputs.states
    if request.controller == RECORDED:
        commands = require(
            states.commanded_velocity,
            f"{source.name}: --controller {RECORDED}: the log has no commanded velocities",
            remedy="name their columns in [states] of a .toml, or choose their topic with --joint-topic",
        )
        return RECORDED, lambda start: RecordedCommands(states.stamp_ns, np.asarray(commands, np.float64))
    if is_policy_server(request.controller or ""):
        address = parse_address(request.controller or "")
        images = RecordedImages(source.cameras, frames_of(source) if source.cameras else ())
        return address.url, lambda start: PolicyClient(address, start, limit, images)
    name, command = _read_command(request)
    return name, lambda start: Program(name, command, start, limit)


def _read_command(request: ReplayRequest) -> tuple[str, tuple[str, ...]]:
    if request.controller is not None:
        refuse_if(
            not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*", request.controller),
            f"--controller: expected module:Class, got {request.controller!r}",
            error=UsageError,
        )
        return request.controller, class_command(request.controller)
    text = request.controller_command or ""
    with refuse_faults(f"--controller-command {text!r}", ValueError, remedy="close the quotes", error=UsageError):
        words = shlex.split(text)
    refuse_if(not words, "--controller-command: expected a program and its arguments, got nothing", error=UsageError)
    return text, tuple(words)
