"""``splatctrl demo``: the whole main job on the sample recording, one command after the other, with pictures."""

import argparse
import contextlib
import io
import json
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_output, add_threads
from splatctrl_cli.cli.main import build_parser
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.images import psnr
from splatctrl_cli.evaluate.verdict import Outcome, Reason, verdict_of
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_run
from splatctrl_cli.grid_files.grid import read_npz
from splatctrl_cli.records import JointState, RgbdFrame, SplatSet
from splatctrl_cli.report.pictures import ComparisonRow, comparison_picture, field_slice_picture
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.render import render
from splatctrl_cli.scene_files.scene_folder import open_scene
from splatctrl_cli.sources.source import open_source

TRAINING, SCORING = "cam0,cam1,cam2", "cam3"
CLOSED_LOOP_START = "1.6"  # [s]: the visitor appears ahead of the driven arm; started earlier, right where it is
INPUTS = ("log.mcap", "truth.json", "robot.urdf", "robot_spheres.yaml")
EXPECTED = {
    "reconstruct": "passed",
    "sdf-bake": "passed",
    "score": "passed",
    "replay": "safe",
    "replay --mode closed-loop": "margin broken",  # the map errs by millimetres, and the truth shows it
}  # the label of each step's verdict
SAMPLE = Path(__file__).parents[2] / "sample_data" / "tabletop"


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "demo", run)
    parser.add_argument(
        "--data",
        type=Path,
        default=SAMPLE,
        metavar="DIR",
        help="what 'splatctrl simulate' wrote (default: sample_data)",
    )
    add_threads(parser)
    add_output(parser, default="demo_output", what="folder for everything the demo makes")


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    console, stopwatch, start = Console(args), Stopwatch(), time.perf_counter()
    out = args.out or Path("demo_output")
    missing = [name for name in INPUTS if not (args.data / name).is_file()]
    if missing:
        raise InputError(
            f"{args.data}: has no {', '.join(missing)}", remedy="make a recording with 'splatctrl simulate -o DIR'"
        )
    if out.resolve() == args.data.resolve():
        raise UsageError(f"{out}: is the input folder", remedy="give another --out")
    reasons: list[Reason] = []
    with output_path(out, force=args.force, is_folder=True) as folder:
        with stopwatch.stage("commands"):
            for command in _commands(args.data, folder, args.threads):
                reasons.append(_run(command, console, folder, out))
        with stopwatch.stage("pictures"):
            pictures = _pictures(args.data, folder, args.threads)
        verdict = verdict_of("demo", reasons, scope=f"{len(reasons)} steps")
        write_run(
            folder,
            command="demo",
            config={"threads": args.threads},
            inputs={name: sha256(args.data / name) for name in INPUTS},
            metrics={},
            stopwatch=stopwatch,
            verdict=verdict.as_dict(),
        )
    seconds = time.perf_counter() - start
    shown = [f"{description}: {out / name}" for name, description in pictures.items()]
    console.concluded(
        verdict,
        {"out": str(out), "seconds": round(seconds, 1), "pictures": [str(out / name) for name in pictures]},
        [f"done in {seconds:.0f} s; look at", *shown, f"everything else is in {out}/"],
        verdict.exit_code,
    )
    return verdict.exit_code


def _commands(data: Path, out: Path, threads: int) -> list[list[str]]:
    log, truth = str(data / "log.mcap"), str(data / "truth.json")
    capture, scene, field = (str(out / name) for name in ("tabletop.capture", "scene", "field"))
    robot = ["--urdf", str(data / "robot.urdf"), "--spheres", str(data / "robot_spheres.yaml")]
    using = ["--threads", str(threads)]
    return [
        ["info", log],
        ["ingest", log, "-o", capture],
        ["reconstruct", capture, "--cameras", TRAINING, *robot, "-o", scene, *using],
        ["export", scene, "-o", str(out / "tabletop.ply")],
        ["sdf-bake", scene, *robot, "--truth", truth, "--seen-by", capture, "-o", field, *using],
        ["score", scene, "--reference", capture, "--cameras", SCORING, "-o", str(out / "score"), *using],
        ["replay", capture, "--scene", scene, *robot, "--truth", truth, "-o", str(out / "audit"), *using],
        ["replay", capture, "--scene", scene, *robot, "--truth", truth, "--mode", "closed-loop",
         "--start-time", CLOSED_LOOP_START, "-o", str(out / "closed_loop"), *using],
    ]  # fmt: skip


def _run(command: Sequence[str], console: Console, folder: Path, out: Path) -> "Reason":
    """One subcommand as a person would type it; whether it ends as expected."""
    shown = [part.replace(str(folder), str(out)) for part in command]
    console.log(f"\n$ splatctrl {shlex.join(shown)}")
    is_silent = console.is_quiet or console.is_json
    args = build_parser().parse_args([*command, *(["-q"] if is_silent else [])])
    text, arguments = io.StringIO(), sys.argv
    sys.argv = [arguments[0], *shown]  # what run.json records
    try:
        with contextlib.redirect_stdout(text):
            code = args.run(args)
    finally:
        sys.argv = arguments
    if not is_silent:
        print(text.getvalue().replace(str(folder), str(out)), end="", flush=True)
    step = "replay --mode closed-loop" if "closed-loop" in command else command[0]
    expected, label = EXPECTED.get(step, "done"), f"exit code {code}" if code else "done"
    if step in EXPECTED:
        run = json.loads((Path(command[list(command).index("-o") + 1]) / "run.json").read_text(encoding="utf-8"))
        label = run["verdict"]["label"]
    reason = Reason(
        criterion=step,
        outcome=Outcome.PASSED if label == expected else Outcome.FAILED,
        sentence=f"expected '{expected}', got '{label}'",
        label="not as expected",
    )
    console.log(f"demo: {reason}")
    return reason


def _pictures(data: Path, out: Path, threads: int) -> dict[str, str]:
    """Draw what the demo shows; file names under `out`, with a description each."""
    newest: dict[str, RgbdFrame] = {}
    joints: JointState | None = None
    source = open_source(out / "tabletop.capture")
    for record in source.records():
        if isinstance(record, JointState):
            joints = record
        else:
            newest[record.camera] = record
    splats = open_scene(out / "scene").splats()
    rows = [_comparison(frame, splats, threads) for frame in newest.values()]
    comparison_picture(out / "renders.png", rows)
    model = RobotModel.from_urdf(data / "robot.urdf", data / "robot_spheres.yaml")
    assert joints is not None
    centers = model.sphere_centers(joints.position[model.joint_order(source.joint_names)])
    height = float(np.median(centers[model.moving_spheres][-4:, 2]))
    field_slice_picture(
        out / "field_slice.png",
        read_npz(out / "field" / "field.npz"),
        2,
        height,
        (centers, model.sphere_set.radii),
        "distance to the map, with the arm's spheres",
    )
    return {
        "renders.png": "photo, render and depth error of each camera",
        "field_slice.png": "a slice of the distance field with the arm's spheres",
        "audit/clearance.png": "clearance of the logged motion over time",
        "closed_loop/clearance.png": "clearance of the controller's motion over time",
    }


def _comparison(frame: "RgbdFrame", splats: "SplatSet", threads: int) -> "ComparisonRow":
    view = render(splats, frame.intrinsics, frame.T_world_camera, threads=threads)
    is_mapped = view.opacity >= 0.5
    figure = psnr(view.color, frame.color / 255.0, is_mapped)
    role = "scoring only" if frame.camera in SCORING.split(",") else "training"
    return ComparisonRow(
        title=f"{frame.camera} ({role})",
        figures=f"{figure:.1f} dB on mapped pixels",
        photo=frame.color,
        render=view.color,
        photo_depth=frame.depth,
        render_depth=view.normalised_depth(),
    )
