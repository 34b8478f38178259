"""Subcommands with examples, options, and functions by name.

A function is imported when it runs, so that help answers at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli import __version__
from splatctrl_cli.cli import run_options, scene_options
from splatctrl_cli.cli.common import (
    BASE,
    COMMON,
    GATES,
    JUNIT,
    LOCK,
    OF_FOLDERS,
    PACKAGES,
    THREADS,
    output,
    seed,
    settings,
)
from splatctrl_cli.cli.parser import Adds, Parser, add_all, either, group, option, real, whole
from splatctrl_cli.cli.scene_options import REPLAY

EXIT_CODES = """\
exit codes: 0 done; 1 a gate or check failed; 2 usage, configuration or output; 3 done, but part of the input was
damaged; 4 input missing or unusable; 5 cannot be evaluated; 6 writing failed; 70 our own bug, or a card that failed;
130 interrupted"""
SHELLS = ("bash", "zsh", "tcsh")  # shtab's, without importing it for help
LOG, ROBOT = "sample_data/tabletop/log.mcap", "--urdf arm.urdf --spheres arm.yaml"  # of examples


@dataclass(frozen=True, kw_only=True)
class Command:
    """A subcommand or action; `run` names MODULE:FUNCTION of this package.

    A command with `actions` has no options. judges: ends in a verdict.
    """

    summary: str
    examples: Sequence[str] = ()
    run: str = ""
    options: Sequence[Adds] = ()
    actions: "dict[str, Command] | None" = None
    judges: bool = False


def build_parser(command: str | None = None) -> Parser:
    """Build the parser with options of `command` alone, or of all."""
    parser = Parser(
        prog="splatctrl",
        description="What did the robot's cameras know, and would this controller have kept it safe?",
        epilog=EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"splatctrl {__version__}")
    _add_commands(parser, COMMANDS, dest="command", only=command)
    return parser


def _add_commands(parser: Parser, commands: dict[str, Command], *, dest: str, only: str | None = None) -> None:
    below = parser.add_subparsers(dest=dest, metavar=dest.upper(), required=True)
    for name, command in commands.items():
        one = below.add_parser(
            name,
            help=command.summary,
            description=command.summary[0].upper() + command.summary[1:] + ".",
            examples=command.examples,
        )
        if only not in (None, name):
            continue
        if command.actions is not None:
            _add_commands(one, command.actions, dest="action")
        if command.options:
            add_all(one, (*command.options, *COMMON, *(JUNIT if command.judges else ())))
            one.set_defaults(run=command.run, parser=one)


def judges(words: Sequence[str]) -> bool:
    command = COMMANDS.get(words[0]) if words else None
    if command is not None and command.actions is not None:
        command = command.actions.get(words[1]) if len(words) > 1 else None
    return command is not None and command.judges


_CONFIG = (
    option("FILE", "a TOML file as --config takes it; one with a wrong key or value is refused", Path, nargs="?"),
    *settings(),
    option("--template", "print a file to begin with: every default, commented out, with its meaning and range"),
    option("--schema", "print the JSON Schema of what every command prints with --json"),
)
_DEMO = (
    option("--data DIR", "what 'splatctrl simulate' wrote (default: sample_data; without it, simulated first)", Path),
    *output("folder for everything the demo makes", default="demo_output"),
    THREADS,
)


def _robot(spheres: str) -> tuple[Adds, ...]:
    return (
        *_URDF,
        option("--spheres FILE", f"YAML (also cuRobo's) or URDF with the spheres (default: {spheres})", Path),
    )


_URDF = (option("--urdf FILE", "the robot's URDF (expanded, no xacro)", Path, required=True), PACKAGES)
_ROBOT = _robot("those of the URDF itself")
_ROBOT_JUDGED = (option("--picture FILE.png", "draw the spheres over the collision shapes", Path), GATES)
_ROBOT_SPHERES = (
    *_URDF,
    *output("YAML file of the spheres", default="spheres.yaml"),
    either(
        option(
            "--max-spheres N",
            "spheres over all links, sticking out as little as that allows (default: 64)",
            whole(1, 100_000),
        ),
        option("--max-protrusion M", "or: the fewest found that stick out no more [m]", real(1e-6, 10, "m")),
    ),
    option(
        "--max-deficit M",
        "how far surface points may stay outside all spheres [m]; at 0 all are covered",
        real(0, 10, "m"),
        0.0,
    ),
    seed("the greedy covers"),
    *_ROBOT_JUDGED,
)
_ROBOT_PAIRS = (
    *_ROBOT,
    LOCK,
    option("--srdf FILE", "leave out what its disable_collisions name", Path),
    option("--postures N", "without --srdf: joint configurations sampled", whole(1, 10_000_000), 2000),
    option("--drop-never", "leave out what never comes near in the sample (a guess, no proof)"),
    seed("the sampling"),
)
_ROBOT_LEARN = (
    option("LOG", "a log or capture with joint states, in which the arm moves in view of the cameras", Path),
    *_ROBOT,
    *output("self-model, which --self-model of reconstruct and replay takes", default="self.npz"),
    option(
        "--reach M", "how far outside of a link's visual surface its parts are looked for", real(0.01, 0.5, "m"), 0.06
    ),
    group("robot", BASE, LOCK),
    *OF_FOLDERS,
)


COMMANDS = {
    "audit": Command(
        summary="check, reconstruct and replay a recording: one verdict, one page",
        examples=(f"audit {LOG} {ROBOT}", "audit run.mcap --robot panda -o out/audit"),
        run="audit:run",
        judges=True,
        options=scene_options.AUDIT,
    ),
    "simulate": Command(
        summary="write a recorded log (ROS 2 MCAP) of an arm at a table, with its truth",
        examples=("simulate -o out/log", "simulate --urdf fr3.urdf --packages franka_description -o out/fr3"),
        run="demo:run_simulate",
        options=run_options.SIMULATE,
    ),
    "ingest": Command(
        summary="turn a log or image folder into a capture folder",
        examples=(f"ingest {LOG} -o out/x.capture", "ingest run1.bag run2.bag --cameras front,wrist"),
        run="check:run_ingest",
        options=run_options.INGEST,
    ),
    "info": Command(
        summary="describe a log, capture, scene, grid, robot or other file",
        examples=(f"info {LOG}", "info out/scene --json"),
        run="check:run_info",
        options=run_options.INFO,
    ),
    "check": Command(
        summary="list the faults of a log, capture or image folder",
        examples=(f"check {LOG} {ROBOT}", "check run.bag --quick --fail-on warning"),
        run="check:run",
        judges=True,
        options=run_options.CHECK,
    ),
    "calibrate": Command(
        summary="place cameras against each other and the robot, from what they recorded",
        examples=(f"calibrate {LOG} {ROBOT}", "calibrate two_cameras.toml --hold front -o rig.toml"),
        run="calibrate:run",
        options=run_options.CALIBRATE,
    ),
    "reconstruct": Command(
        summary="fit splats to a log, a capture or a DTU scan",
        examples=(
            f"reconstruct out/x.capture --cameras cam0,cam1 {ROBOT} -o out/scene",
            "reconstruct --dtu sample_data/dtu --protocol holdout:2,5 -o out/scan",
        ),
        run="reconstruct:run",
        judges=True,
        options=scene_options.RECONSTRUCT,
    ),
    "export": Command(
        summary="write splats as a file that viewers open, and check what reads back",
        examples=(
            "export out/scene --labels object -o out/scene.spz",
            "export out/audit --mcap",
        ),
        run="export:run",
        options=scene_options.EXPORT,
    ),
    "sdf-bake": Command(
        summary="bake a scene's splats into a distance grid with gradient",
        examples=(
            f"sdf-bake out/scene {ROBOT} -o out/field",
            "sdf-bake out/scene --box=-1,-1,0,1,1,1 --voxel 0.02 --formats npz,nrrd -o out/grid",
        ),
        run="sdf_bake:run",
        judges=True,
        options=scene_options.SDF_BAKE,
    ),
    "query": Command(
        summary="answer a table of points: distance, gradient, bound, what is nearest",
        examples=(
            "query out/scene points.csv -o out/near.csv",
            "query out/field points.csv --scene out/scene",
        ),
        run="query:run",
        options=scene_options.QUERY,
    ),
    "score": Command(
        summary="compare renders with recorded views: PSNR, SSIM, depth",
        examples=(
            "score out/scene --reference out/x.capture --cameras cam3 -o out/score",
            "score out/scan --dtu sample_data/dtu --protocol holdout:2,5 --require 'psnr_all>=20'",
        ),
        run="reconstruct:run_score",
        judges=True,
        options=scene_options.SCORE,
    ),
    "render": Command(
        summary="render pictures or a video of a scene, from a recorded camera or along a path",
        examples=("render out/scene -o view.png", "render out/scene --path path.csv --size 1280x720 -o view.mp4"),
        run="report:run_render",
        options=scene_options.RENDER,
    ),
    "replay": Command(
        summary="judge the logged motion, compute commands along it, or simulate the arm in closed loop",
        examples=(
            f"replay out/x.capture --scene out/scene {ROBOT} -o out/audit",
            f"replay out/x.capture --scene out/scene {ROBOT} --mode closed-loop --start-time 1.6",
        ),
        run="replay:run",
        judges=True,
        options=REPLAY,
    ),
    "batch": Command(
        summary="run many recordings through many commands, with one verdict",
        examples=("batch nightly.toml --shard 2/4", "batch nightly.toml --failed"),
        run="batch:run",
        options=run_options.BATCH,
        judges=True,
    ),
    "sweep": Command(
        summary="say how far a replay is from the other verdict",
        examples=(
            "sweep out/audit --over margin=0.02:0.08 -o out/margin",
            "sweep out/audit --over latency=0:1 --over depth-noise=0:0.02 -o out/both",
        ),
        run="sweep:run",
        options=run_options.SWEEP,
    ),
    "compare": Command(
        summary="say what got worse between two runs, two batches, or since a stored baseline",
        examples=("compare out/old out/new", "compare out/new --against baseline.toml"),
        run="compare:run",
        judges=True,
        options=run_options.COMPARE,
    ),
    "report": Command(
        summary="write one HTML file on a run or a batch, with scenes in 3-D",
        examples=("report out/audit", "report out/batch --against baseline.toml -o report.html"),
        run="report:run",
        options=run_options.REPORT,
    ),
    "view": Command(
        summary="show a replay, scene, field or splats in 3-D in a browser",
        examples=("view out/audit", "view out/scene --no-open -o scene.html"),
        run="report:run_view",
        options=run_options.VIEW,
    ),
    "robot": Command(
        summary="fit and measure a robot's spheres, list its pairs, learn its own surface",
        examples=("robot spheres --urdf arm.urdf --max-spheres 80 -o spheres.yaml", f"robot check {ROBOT}"),
        actions={
            "spheres": Command(
                summary="fit spheres that cover all of each link's collision geometry",
                run="robot:run_spheres",
                judges=True,
                options=_ROBOT_SPHERES,
            ),
            "check": Command(
                summary="measure how much of the collision surface a set of spheres covers",
                run="robot:run_check",
                judges=True,
                options=(*_ROBOT, *_ROBOT_JUDGED),
            ),
            "pairs": Command(
                summary="list which links may collide with each other, and why others may not",
                run="robot:run_pairs",
                options=_ROBOT_PAIRS,
            ),
            "learn": Command(
                summary="learn from a recording the parts that the URDF lacks",
                run="robot:run_learn",
                options=_ROBOT_LEARN,
            ),
            "info": Command(
                summary="show joints with limits, links, shapes and spheres",
                run="robot:run_info",
                options=(*_robot("none, or those of the URDF"), LOCK),
            ),
        },
    ),
    "config": Command(
        summary="print every setting and where it comes from, or check a file",
        examples=("config my.toml --set scene.max_splats=3000", "config --template"),
        run="config:run",
        options=_CONFIG,
    ),
    "completion": Command(
        summary="print a script by which a shell completes commands, options and files",
        examples=("completion bash", "completion zsh"),
        run="config:run_completion",
        options=(option("SHELL", "whose script", SHELLS),),
    ),
    "help": Command(
        summary="print a page of the documentation, their list, or all options of a command",
        examples=("help replay", "help simulate"),
        run="config:run_help",
        options=(option("TOPIC", "a page, such as ci, or a command (default: the list of pages)", nargs="?"),),
    ),
    "demo": Command(
        summary="run the main job on a sample recording, with pictures",
        examples=("demo", "demo --data out/log -o out/demo"),
        run="demo:run",
        judges=True,
        options=_DEMO,
    ),
}
