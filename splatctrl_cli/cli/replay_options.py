"""The options of ``splatctrl replay``."""

from pathlib import Path

from splatctrl_cli.cli.options import (
    CONFIG,
    DECLARE,
    DEVICE,
    DISAGREEMENT,
    GATES,
    HOLDOUT,
    LOCK,
    PACKAGES,
    POSE,
    SELF_MODEL,
    SOURCE,
    numbers,
    output,
    pose,
)
from splatctrl_cli.cli.parser import MAX_SECONDS, either, group, option, real, whole

MODES = ("audit", "open-loop", "closed-loop")
UNSEEN_IS = ("judge", "occupied")
STEP_LIMIT = 10.0  # [s]


def _start(text: str) -> float | str:
    """Seconds not below zero, or the time of the first map, for argparse."""
    return text if text == "first-map" else real(0, MAX_SECONDS, "s or first-map")(text)


REPLAY = (  # what people use, and in groups the rest
    option("LOG", "a log or capture with joint states", Path),
    either(
        option("--field FIELD", "a baked field (folder or field.npz)", Path),
        option("--scene SCENE", "a reconstruction: its splats, as known at each time", Path),
        option("--lockstep", "reconstruct the scene from LOG's own cameras, in step with the replay"),
        required=True,
    ),
    option("--urdf FILE", "the robot's URDF (default: the log's own robot_description)", Path),
    option("--spheres FILE.yaml", "its spheres (default: the URDF's own)", Path),
    option("--mode", "what to replay", MODES, "audit"),
    option("--start-time S", "start at this time of the log [s], or first-map: at the first map", _start),
    option("--truth FILE", "truth.json of a simulated log", Path),
    option(
        "--evidence CAMERA|K",
        "bound the map's error by depth kept out of it: of this camera, or (--lockstep) of every K-th frame set",
    ),
    either(
        option("--controller MODULE:CLASS", "judge a controller of your own: this Python class"),
        option("--controller-command 'PROGRAM ARGS'", "or this program, by JSON on its stdin and stdout"),
    ),
    *output("folder to write", default="replay"),
    *CONFIG,
    DEVICE,
    GATES,
    *SOURCE,
    group(
        "robot",
        option(f"--base {POSE}", "pose of the URDF's root in world (default: identity)", pose),
        LOCK,
        PACKAGES,
        SELF_MODEL,
        option("--srdf FILE", "leave the pairs of its disable_collisions out of the self-collision rows", Path),
        DECLARE,
    ),
    group(  # the goal in one of five forms, and how an arm is driven there
        "goal",
        option("--frame LINK", "the link to drive (default: the last of the URDF)"),
        either(
            option(f"--goal {POSE}", "goal pose in world (default: the logged pose at the end)", pose),
            option(
                "--goal-joints Q1,Q2,...", "goal configuration [rad]; a gripper's fingers may be left out", numbers
            ),
            option("--waypoints FILE", "goals in order, poses or configurations (.toml or .csv)", Path),
            option("--follow", "the logged pose of each time is the goal (the default of --mode open-loop)"),
            option(
                "--twist-topic NAME",
                "track the twists of this topic of LOG (Twist, TwistStamped), or of a .toml's table: twists",
            ),
        ),
        option("--twist-frame LINK", "axes of the twists: world or those of a link (default: as the log says)"),
        option(
            "--re-anchor S",
            "put the arm back into the logged configuration every S seconds",
            real(1e-3, MAX_SECONDS, "s"),
        ),
    ),
    group(  # a controller of the user's own in place of ours (docs/controllers.md)
        "controller",
        option(
            "--controller-step-limit S",
            "a controller that takes longer for a step has failed",
            real(1e-3, MAX_SECONDS, "s"),
            STEP_LIMIT,
        ),
        option("--controller-twice", "ask two of it the same: a difference is a failure"),
    ),
    group(
        "evidence",
        HOLDOUT,
        option("--max-unknown SHARE", "never-seen share allowed", real(0, 1), 0.05),
        option("--max-map-age S", "a scene older than this is no evidence", real(1e-3, MAX_SECONDS, "s"), 1.0),
        option(
            "--latency S",
            "a map is known this long after its frames' stamp (--scene, --lockstep)",
            real(0, MAX_SECONDS, "s"),
            0.0,
        ),
        option("--require-evidence", "not evaluable (exit 5) without a bound on the map's error"),
        option(
            "--unseen",
            "space beside the arm that no camera saw free: judge by a table (splatctrl help verdict), or obstacle",
            UNSEEN_IS,
            "judge",
        ),
        option("--require-proof", "not evaluable (exit 5) where space beside the arm was assumed to be free"),
        *DISAGREEMENT,
    ),
    group(
        "report",
        option(
            "--worst-frames N",
            "write worst_1.png ...: camera images of the N events of least clearance",
            whole(0, 1000),
            3,
        ),
        option("--report-only", "exit 0 whatever the verdict; a --require still counts"),
        option("--steps", "print a row per step as well"),
    ),
)
