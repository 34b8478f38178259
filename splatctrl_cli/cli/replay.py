"""``splatctrl replay``: the clearance of logged motion, what a controller says of it, or what it does instead."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_config, add_gates, add_output
from splatctrl_cli.cli.numbers import MAX_SECONDS, real
from splatctrl_cli.cli.reconstruct import add_declare
from splatctrl_cli.cli.replay_options import (
    MODES,
    POSE,
    add_baseline,
    add_evidence,
    add_goal,
    add_golden,
    add_lockstep,
    add_robot_geometry,
    add_worst_frames,
    pose,
    replay_request,
)
from splatctrl_cli.cli.replay_report import lines_of
from splatctrl_cli.cli.source_options import add_source
from splatctrl_cli.jobs.replay import replay


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "replay", run)
    parser.add_argument("log", type=Path, metavar="LOG", help="a log or capture with joint states")
    scene = parser.add_mutually_exclusive_group(required=True)
    scene.add_argument("--field", type=Path, metavar="FIELD", help="a baked field (folder or field.npz)")
    scene.add_argument(
        "--scene", type=Path, metavar="SCENE", help="a reconstruction: its splats, as known at each time"
    )
    add_lockstep(parser, scene)
    parser.add_argument("--urdf", type=Path, required=True, metavar="FILE", help="the robot's URDF")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its spheres (default: the URDF's own)")
    parser.add_argument(
        "--base", type=pose, metavar=POSE, help="pose of the URDF's root in world (default: identity)"
    )
    parser.add_argument(
        "--lock",
        action="append",
        default=[],
        metavar="JOINT=VALUE",
        help="hold a joint that no log moves (repeatable)",
    )
    add_robot_geometry(parser)
    parser.add_argument("--mode", choices=MODES, default="audit", help="what to replay (default: audit)")
    add_goal(parser)
    parser.add_argument("--truth", type=Path, metavar="FILE", help="truth.json of a simulated log")
    parser.add_argument(
        "--max-unknown",
        type=real(0, 1),
        default=0.05,
        metavar="SHARE",
        help="never-seen share allowed (default: 0.05)",
    )
    parser.add_argument(
        "--max-map-age",
        type=real(1e-3, MAX_SECONDS, "s"),
        default=1.0,
        metavar="S",
        help="a scene older than this is no evidence (default: 1)",
    )
    add_evidence(parser)
    add_golden(parser)
    add_baseline(parser)
    add_worst_frames(parser)
    add_declare(parser)
    parser.add_argument(
        "--report-only", action="store_true", help="exit 0 whatever the verdict; a --require or --golden still counts"
    )
    parser.add_argument("--steps", action="store_true", help="print a row per step as well")
    add_source(parser)
    add_output(parser, default="replay", what="folder to write")
    add_config(parser)
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    console, request = Console(args), replay_request(args)
    result = replay(request, console)
    code = result.exit_code(report_only=args.report_only)
    lines = lines_of(result, is_long=args.verbose > 0, with_steps=args.steps)
    console.concluded(result.verdict, {"out": str(result.out), **result.metrics}, lines, code)
    return code
