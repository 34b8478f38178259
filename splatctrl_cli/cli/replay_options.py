"""The options of ``splatctrl replay``, and the request that they make."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.common import configured
from splatctrl_cli.cli.numbers import MAX_SECONDS, real, several, whole
from splatctrl_cli.cli.reconstruct import add_disagreement
from splatctrl_cli.cli.robot_options import locked_joints
from splatctrl_cli.cli.source_options import source_options
from splatctrl_cli.config.declared import shown
from splatctrl_cli.control.presets import with_preset
from splatctrl_cli.jobs.replays.goal import checked_pose
from splatctrl_cli.jobs.replays.request import ReplayRequest

MODES = ("audit", "open-loop", "closed-loop")
BASELINES = ("standstill", "birrt", "birrt-ik")
POSE = "x,y,z,qx,qy,qz,qw"
GOLDEN_TOLERANCE = 1e-6  # [rad/s]: steps.csv keeps nine digits; another machine or solver needs more


def replay_request(args: argparse.Namespace) -> "ReplayRequest":
    """The request that parsed options make. Raises UsageError for values of the wrong form."""
    same = (
        *("log", "urdf", "scene", "field", "lockstep", "latency", "allow_disagreement", "max_pose_jump", "spheres"),
        *(
            "base",
            "srdf",
            "mode",
            "frame",
            "goal",
            "goal_joints",
            "waypoints",
            "follow",
            "twist_topic",
            "twist_frame",
        ),
        *("start_time", "re_anchor", "truth", "max_unknown", "max_map_age", "golden", "golden_tolerance", "zone"),
        *("evidence", "require_evidence"),
        *("zone_box", "worst_frames", "declare", "force", "seed", "threads"),
    )
    return ReplayRequest(
        out=args.out or Path("replay"),
        config=with_preset(configured(args)),
        options=source_options(args),
        locked=locked_joints(args.lock),
        packages=tuple(args.packages),
        baseline=tuple(args.baseline),
        human=tuple(args.human),
        require=tuple(args.require),
        **{name: getattr(args, name) for name in same},
    )


def add_lockstep(parser: argparse.ArgumentParser, scene: argparse._ActionsContainer) -> None:
    """``--lockstep`` among the choices of a scene, ``--latency``, and by how much a log may contradict itself."""
    scene.add_argument(
        "--lockstep",
        action="store_true",
        help="reconstruct the scene from LOG's own cameras, in step with the replay; --set scene.max_splats=N",
    )
    parser.add_argument(
        "--latency",
        type=real(0, MAX_SECONDS, "s"),
        default=0.0,
        metavar="S",
        help="a map is known this long after its frames' stamp (--scene, --lockstep; default: 0)",
    )
    add_disagreement(parser.add_argument_group("with --lockstep"))


def add_evidence(parser: argparse.ArgumentParser) -> None:
    """``--evidence`` and ``--require-evidence``."""
    parser.add_argument(
        "--evidence",
        metavar="CAMERA|K",
        help="bound the map's error by the depth of a camera of LOG that did not train it, or (--lockstep) of every "
        "K-th frame set, which then does not",
    )
    parser.add_argument(
        "--require-evidence",
        action="store_true",
        help="a replay whose map error nothing bounds cannot be evaluated (exit 5)",
    )


def add_baseline(parser: argparse.ArgumentParser) -> None:
    """``--baseline``, ``--zone``, ``--zone-box``, ``--human``."""
    parser.add_argument(
        "--baseline",
        type=_baselines,
        action="extend",
        default=[],
        metavar="NAME,...",
        help="beside the closed loop (repeatable): standstill, the logged path held while a person is in the zone; "
        "birrt, a path planned in the scene known at the start, followed by the joints; birrt-ik, by the controller",
    )
    parser.add_argument(
        "--zone", default="0.5,0.6", metavar="STOP,RESUME", help="distances [m] of that zone (default: 0.5,0.6)"
    )
    parser.add_argument(
        "--zone-box",
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="a box [m] instead: stop while a person is in it, until nobody is within RESUME - STOP of it",
    )
    parser.add_argument(
        "--human",
        action="append",
        default=[],
        metavar="NAME",
        help="a primitive of --truth that counts as a person (repeatable; default: human*, person*)",
    )


def _baselines(text: str) -> list[str]:
    """Names joined by commas, for argparse."""
    names = text.split(",")
    for name in names:
        if name not in BASELINES:
            raise argparse.ArgumentTypeError(f"expected {', '.join(BASELINES)}, got {name!r}")
    return names


def add_goal(parser: argparse.ArgumentParser) -> None:
    """``--frame``, the goal (one of four forms), ``--start-time``, ``--re-anchor``."""
    parser.add_argument("--frame", metavar="LINK", help="the link to drive (default: the last of the URDF)")
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument(
        "--goal", type=pose, metavar=POSE, help="goal pose in world (default: the logged pose at the end)"
    )
    goal.add_argument("--goal-joints", type=numbers, metavar="Q1,Q2,...", help="goal configuration [rad]")
    goal.add_argument(
        "--waypoints", type=Path, metavar="FILE", help="goals in order, poses or configurations (.toml or .csv)"
    )
    goal.add_argument(
        "--follow",
        action="store_true",
        help="the logged pose of each time is the goal (the default of --mode open-loop)",
    )
    add_twists(parser, goal)
    parser.add_argument(
        "--start-time",
        type=_start,
        metavar="S",
        help="start at this time of the log [s], or first-map: where the scene is first known",
    )
    parser.add_argument(
        "--re-anchor",
        type=real(1e-3, MAX_SECONDS, "s"),
        metavar="S",
        help="put the arm back into the logged configuration every S seconds",
    )


def add_golden(parser: argparse.ArgumentParser) -> None:
    """``--golden`` and ``--golden-tolerance``."""
    parser.add_argument(
        "--golden",
        type=Path,
        metavar="FILE",
        help="fail (exit 1) where a command differs from an earlier replay's (its folder, run.json or steps.csv)",
    )
    parser.add_argument(
        "--golden-tolerance",
        type=real(0, 100, "rad/s"),
        default=GOLDEN_TOLERANCE,
        metavar="RAD/S",
        help=f"by more than this, per joint (default: {GOLDEN_TOLERANCE:g})",
    )


def add_twists(parser: argparse.ArgumentParser, goal: argparse._ActionsContainer) -> None:
    """``--twist-topic`` among the goals, and ``--twist-frame``."""
    goal.add_argument(
        "--twist-topic",
        metavar="NAME",
        help="reach for the twists of this topic of LOG (Twist, TwistStamped), or of a .toml's table: twists",
    )
    parser.add_argument(
        "--twist-frame", metavar="LINK", help="whose axes they are in: world or a link (default: as the log says)"
    )


def add_worst_frames(parser: argparse.ArgumentParser) -> None:
    """``--worst-frames``."""
    parser.add_argument(
        "--worst-frames",
        type=whole(0, 1000),
        default=3,
        metavar="N",
        help="write worst_1.png ...: camera images of the N events of least clearance (default: 3)",
    )


def add_robot_geometry(parser: argparse.ArgumentParser) -> None:
    """``--packages`` and ``--srdf``."""
    parser.add_argument(
        "--packages",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="folder in which package:// paths of the URDF's meshes are found (repeatable; default: those above it)",
    )
    parser.add_argument(
        "--srdf", type=Path, metavar="FILE", help="self-collision rows leave out what its disable_collisions name"
    )


def numbers(text: str) -> tuple[float, ...]:
    """Finite numbers joined by commas, for argparse."""
    values = several(text)
    if not values:
        raise argparse.ArgumentTypeError(f"expected finite numbers joined by commas, up to 1e6, got {shown(text)}")
    return values


def _start(text: str) -> float | str:
    """Seconds not below zero, or the time of the first map, for argparse."""
    return text if text == "first-map" else real(0, MAX_SECONDS, "s or first-map")(text)


def pose(text: str) -> tuple[float, ...]:
    """A pose as `POSE`, for argparse."""
    try:
        return checked_pose(numbers(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
