"""Record an arm in a random scene, with its truth: on tables, at a shelf, or near a person's arm."""

import argparse
from pathlib import Path

from experiments import shared_workspace
from experiments.drawn_task import task_of
from experiments.environments import ENVIRONMENT_S, ENVIRONMENTS
from splatctrl_cli.blocks import RecordingOptions, RobotModel, Scene, SimulateRequest, simulate


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``record``."""
    add = parser.add_argument
    add("scene", choices=(*ENVIRONMENTS, *shared_workspace.PLACES), help="kind of the scene")
    add(
        "-o", "--out", type=Path, default=Path("recorded"), help="folder for log, truth and robot (default: recorded)"
    )
    add("--force", action="store_true", help="replace the output if it exists")
    add("--seed", type=int, default=0, help="of the scene and of the noise")
    add("--duration", type=float, help="length [s] (default: 12, with a person's arm 24)")
    add("--cameras", type=int, default=4, choices=range(2, 7), help="about the arm of an environment (default: 4)")
    add("--width", type=int, default=320, help="[px]")
    add("--height", type=int, default=240, help="[px]")
    add("--noise", default="realsense", choices=("none", "realsense", "stereo"), help="of depth")


def run(args: argparse.Namespace) -> int:
    """Record it."""
    is_shared = args.scene in shared_workspace.PLACES
    usual = shared_workspace.DURATION_S if is_shared else ENVIRONMENT_S
    options = RecordingOptions(
        duration_s=usual if args.duration is None else args.duration,
        width=args.width,
        height=args.height,
        noise=args.noise,
        seed=args.seed,
    )

    def scene(model: RobotModel) -> Scene:
        if is_shared:
            return shared_workspace.scene_of(args.scene, args.seed)
        return task_of(args.scene, args.seed, model).scene(model, options, args.cameras)

    found = simulate(SimulateRequest(out=args.out, options=options, scene=scene, force=args.force))
    clearance = float(found.truth.clearance.min())
    print(f"{found.out}: {len(found.truth.stamps)} joint states, true clearance at least {100 * clearance:.1f} cm")
    return 0
