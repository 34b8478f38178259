"""The options of ``splatctrl replay``."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.options import (
    BOX,
    POSE,
    add_config,
    add_declare,
    add_device,
    add_disagreement,
    add_gates,
    add_lock,
    add_output,
    add_packages,
    add_self_model,
    add_source,
    numbers,
    pose,
)
from splatctrl_cli.cli.parser import MAX_SECONDS, Options, Parser, real, whole
from splatctrl_cli.config.fixed import GOLDEN_TOLERANCE

MODES = ("audit", "open-loop", "closed-loop")
BASELINES = ("standstill", "birrt", "birrt-ik", "qp-ik")
STEP_LIMIT = 10.0  # [s]


def replay_options(add: Options, parser: Parser) -> None:
    """What people use, and in groups the rest."""
    add("LOG", "a log or capture with joint states", Path)
    scene = add.either(required=True)
    scene("--field FIELD", "a baked field (folder or field.npz)", Path)
    scene("--scene SCENE", "a reconstruction: its splats, as known at each time", Path)
    lockstep = "reconstruct the scene from LOG's own cameras, in step with the replay"
    scene("--lockstep", lockstep)
    add("--urdf FILE", "the robot's URDF (default: the log's own robot_description)", Path)
    add("--spheres FILE.yaml", "its spheres (default: the URDF's own)", Path)
    add("--mode", "what to replay", MODES, "audit")
    add("--start-time S", "start at this time of the log [s], or first-map: where the scene is first known", _start)
    add("--truth FILE", "truth.json of a simulated log", Path)
    add_output(add, "folder to write", default="replay")
    add_config(add, parser)
    add_device(parser)
    add_gates(add)
    add_source(add)
    _add_robot(add.group("robot"))
    _add_goal(add.group("goal"))
    _add_controller(add.group("controller"))
    _add_evidence(add.group("evidence"))
    _add_comparison(add.group("comparison"))
    _add_reported(add.group("report"))


def _add_robot(add: Options) -> None:
    add(f"--base {POSE}", "pose of the URDF's root in world (default: identity)", pose)
    add_lock(add)
    add_packages(add)
    add_self_model(add)
    add("--srdf FILE", "leave the pairs of its disable_collisions out of the self-collision rows", Path)
    add_declare(add)


def _add_goal(add: Options) -> None:
    """The goal in one of five forms, and how an arm is driven there."""
    add("--frame LINK", "the link to drive (default: the last of the URDF)")
    goal = add.either()
    goal(f"--goal {POSE}", "goal pose in world (default: the logged pose at the end)", pose)
    goal("--goal-joints Q1,Q2,...", "goal configuration [rad]; a gripper's fingers may be left out", numbers)
    goal("--waypoints FILE", "goals in order, poses or configurations (.toml or .csv)", Path)
    goal("--follow", "the logged pose of each time is the goal (the default of --mode open-loop)")
    twists = "track the twists of this topic of LOG (Twist, TwistStamped), or of a .toml's table: twists"
    goal("--twist-topic NAME", twists)
    add("--twist-frame LINK", "axes of the twists: world or those of a link (default: as the log says)")
    back = "put the arm back into the logged configuration every S seconds"
    add("--re-anchor S", back, real(1e-3, MAX_SECONDS, "s"))


def _add_controller(add: Options) -> None:
    """A controller of the user's own in place of ours (docs/controllers.md)."""
    own = add.either()
    own("--controller MODULE:CLASS", "ask this Python class, found from the current folder on, instead of ours")
    own("--controller-command 'PROGRAM ARGS'", "ask this program, by lines of JSON on its stdin and stdout")
    limit = "a controller that takes longer for a step has failed"
    add("--controller-step-limit S", limit, real(1e-3, MAX_SECONDS, "s"), STEP_LIMIT)
    add("--controller-twice", "ask two of it the same: a difference is a failure")


def _add_evidence(add: Options) -> None:
    add("--max-unknown SHARE", "never-seen share allowed", real(0, 1), 0.05)
    add("--max-map-age S", "a scene older than this is no evidence", real(1e-3, MAX_SECONDS, "s"), 1.0)
    late = "a map is known this long after its frames' stamp (--scene, --lockstep)"
    add("--latency S", late, real(0, MAX_SECONDS, "s"), 0.0)
    add(
        "--evidence CAMERA|K",
        "bound the map's error by depth kept out of the map: of a camera that did not train it, or (--lockstep) of"
        " every K-th frame set",
    )
    add("--require-evidence", "not evaluable (exit 5) without a bound on the map's error")
    add_disagreement(add)


def _add_comparison(add: Options) -> None:
    """``--golden``, and what is driven beside the closed loop."""
    add(
        "--golden FILE",
        "fail (exit 1) where a command differs from an earlier replay (its folder, run.json or steps.csv)",
        Path,
    )
    add("--golden-tolerance RAD/S", "by more than this, per joint", real(0, 100, "rad/s"), GOLDEN_TOLERANCE)
    add(
        "--baseline NAME,...",
        "beside the closed loop (repeatable): standstill, the logged path held while a person is in the zone; birrt,"
        " a path planned in the scene known at the start, followed by the joints; birrt-ik, by the controller;"
        " qp-ik, our controller beside one of --controller",
        _baselines,
        action="extend",
        default=[],
    )
    add("--zone STOP,RESUME", "distances [m] of that zone", str, "0.5,0.6")
    add(
        f"--zone-box {BOX}",
        "a box [m] instead: stop while a person is in it, resume when nobody is within RESUME - STOP of it",
    )
    person = "a primitive of --truth that counts as a person; default: human*, person*"
    add("--human NAME ...", person)


def _add_reported(add: Options) -> None:
    worst = "write worst_1.png ...: camera images of the N events of least clearance"
    add("--worst-frames N", worst, whole(0, 1000), 3)
    add("--report-only", "exit 0 whatever the verdict; a --require or --golden still counts")
    add("--steps", "print a row per step as well")


def _baselines(text: str) -> list[str]:
    """Names joined by commas, for argparse."""
    names = text.split(",")
    for name in names:
        if name not in BASELINES:
            raise argparse.ArgumentTypeError(f"expected {', '.join(BASELINES)}, got {name!r}")
    return names


def _start(text: str) -> float | str:
    """Seconds not below zero, or the time of the first map, for argparse."""
    return text if text == "first-map" else real(0, MAX_SECONDS, "s or first-map")(text)
