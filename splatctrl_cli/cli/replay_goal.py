"""What a replay is asked to reach: its options, and a file of waypoints."""

import argparse
import csv
import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.numbers import MAX_SECONDS, real, several
from splatctrl_cli.cli.replay_twists import add_twists
from splatctrl_cli.config.declared import shown
from splatctrl_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splatctrl_cli.control.replay import Waypoint
    from splatctrl_cli.records import Float64
    from splatctrl_cli.robot.model import RobotModel

POSE = "x,y,z,qx,qy,qz,qw"
POSE_COLUMNS = tuple(POSE.split(","))


def add_goal(parser: argparse.ArgumentParser) -> None:
    """``--frame``, the goal (one of four forms), ``--start-time``, ``--re-anchor``."""
    parser.add_argument("--frame", metavar="LINK", help="the link to drive (default: the last of the URDF)")
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument(
        "--goal", type=pose, metavar=POSE, help="goal pose in world (default: the logged pose at the end)"
    )
    goal.add_argument("--goal-joints", type=numbers, metavar="Q1,Q2,...", help="goal posture [rad]")
    goal.add_argument(
        "--waypoints", type=Path, metavar="FILE", help="goals one after the other, poses or postures (.toml or .csv)"
    )
    goal.add_argument(
        "--follow",
        action="store_true",
        help="the logged pose of each time is the goal (the default of --mode open-loop)",
    )
    add_twists(parser, goal)
    parser.add_argument(
        "--start-time",
        type=real(-MAX_SECONDS, MAX_SECONDS, "s"),
        metavar="S",
        help="start at this time of the log [s]",
    )
    parser.add_argument(
        "--re-anchor",
        type=real(1e-3, MAX_SECONDS, "s"),
        metavar="S",
        help="put the arm back into the logged posture every S seconds",
    )


def check_goal(args: argparse.Namespace) -> None:
    """Raise UsageError where a mode has no use for an option that is given."""
    asked, driven = ("open-loop", "closed-loop"), ("closed-loop",)
    modes: dict[str, tuple[str, ...]] = {"start_time": driven, "re_anchor": driven}
    modes |= dict.fromkeys(("goal", "goal_joints", "waypoints", "follow"), asked)
    for option, wanted in modes.items():
        given = getattr(args, option)
        if given is not None and given is not False and args.mode not in wanted:
            name = "--" + option.replace("_", "-")
            raise UsageError(
                f"{name}: expected --mode {' or '.join(wanted)}, got {args.mode}", remedy=f"leave out {name}"
            )


def goal_waypoints(
    args: argparse.Namespace, model: "RobotModel", frame: str, logged_end: "Float64"
) -> "tuple[Waypoint, ...]":
    """The goals that the options give, at least one; else the logged pose at the end."""
    import numpy as np

    from splatctrl_cli.control.checks import checked_posture
    from splatctrl_cli.control.replay import Waypoint
    from splatctrl_cli.geometry import transform_from

    if args.goal is not None:
        return (Waypoint(T_world_goal=transform_from(args.goal[:3], args.goal[3:])),)
    if args.goal_joints is not None:
        posture = checked_posture(model, np.array(args.goal_joints), what="--goal-joints")
        return (Waypoint(T_world_goal=model.frame_pose(posture, frame), posture=posture),)
    if args.waypoints is not None:
        return read_waypoints(args.waypoints, model, frame)
    return (Waypoint(T_world_goal=model.frame_pose(logged_end, frame)),)


def read_waypoints(path: Path, model: "RobotModel", frame: str) -> "tuple[Waypoint, ...]":
    """The waypoints of a file: poses (columns or keys x, y, z, qx, qy, qz, qw) or postures (one per joint name).

    CSV has a header; TOML an array of tables ``[[waypoint]]`` with ``pose = [...]`` or ``joints = [...]``.
    Raises InputError, naming the waypoint.
    """
    import numpy as np

    from splatctrl_cli.control.checks import checked_posture
    from splatctrl_cli.control.replay import Waypoint
    from splatctrl_cli.geometry import transform_from

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}", remedy="give --waypoints a .toml or .csv file") from None
    rows = _csv_rows(path, text, model.joint_names) if path.suffix == ".csv" else _toml_rows(path, text)
    if not rows:
        raise InputError(f"{path}: expected at least one waypoint, got none")
    waypoints = []
    for number, (kind, row) in enumerate(rows):
        what = f"{path}: waypoint {number}"
        if kind == "joints":
            posture = checked_posture(model, np.array(row), what=what)
            waypoints.append(Waypoint(T_world_goal=model.frame_pose(posture, frame), posture=posture))
            continue
        try:
            values = pose(",".join(str(value) for value in row))
        except argparse.ArgumentTypeError as error:
            raise InputError(f"{what}: {error}") from None
        waypoints.append(Waypoint(T_world_goal=transform_from(values[:3], values[3:])))
    return tuple(waypoints)


def _csv_rows(path: Path, text: str, joints: tuple[str, ...]) -> list[tuple[str, list[float]]]:
    reader = csv.DictReader(text.splitlines())
    header = tuple(reader.fieldnames or ())
    wanted = next((names for names in (POSE_COLUMNS, joints) if set(names) <= set(header)), None)
    if wanted is None:
        raise InputError(
            f"{path}: expected the columns {POSE} or {','.join(joints)}, got {','.join(header) or 'none'}"
        )
    rows = []
    for number, row in enumerate(reader):
        try:
            rows.append(("pose" if wanted is POSE_COLUMNS else "joints", [float(row[name]) for name in wanted]))
        except (TypeError, ValueError):
            raise InputError(f"{path}: waypoint {number}: expected numbers, got {list(row.values())}") from None
    return rows


def _toml_rows(path: Path, text: str) -> list[tuple[str, list[float]]]:
    try:
        document: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    entries = document.get("waypoint", [])
    rows = []
    for number, entry in enumerate(entries if isinstance(entries, list) else [entries]):
        if not isinstance(entry, dict) or len(entry) != 1 or not set(entry) <= {"pose", "joints"}:
            raise InputError(f"{path}: waypoint {number}: expected pose = [...] or joints = [...], got {entry}")
        ((kind, values),) = entry.items()
        if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
            raise InputError(f"{path}: waypoint {number}: {kind}: expected an array of numbers, got {values}")
        rows.append((kind, [float(value) for value in values]))
    return rows


def numbers(text: str) -> tuple[float, ...]:
    """Finite numbers joined by commas, for argparse."""
    values = several(text)
    if not values:
        raise argparse.ArgumentTypeError(f"expected finite numbers joined by commas, up to 1e6, got {shown(text)}")
    return values


def pose(text: str) -> tuple[float, ...]:
    """A pose as `POSE`, for argparse."""
    values = numbers(text)
    if len(values) != 7:
        raise argparse.ArgumentTypeError(f"expected 7 numbers {POSE}, got {len(values)}")
    length = math.hypot(*values[3:])
    if abs(length - 1.0) > 0.01:
        raise argparse.ArgumentTypeError(f"expected a unit quaternion qx,qy,qz,qw, got one of length {length:.3f}")
    return values
