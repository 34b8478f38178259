"""``splatctrl ingest``: any recorded input into a capture folder."""

import argparse
from dataclasses import asdict
from pathlib import Path

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_output, table
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.errors import UsageError


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "ingest", run, summary="turn a log or image folder into a capture folder")
    parser.add_argument(
        "source",
        type=Path,
        nargs="+",
        help=".mcap, .bag, .db3, ROS 2 bag folder, folder of a dataset, or .toml of an image folder;"
        " several logs of one session are read as one",
    )
    add_output(parser, default="SOURCE.capture", what="capture folder")
    add_source(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.io.capture import CaptureSource, write_capture
    from splatctrl_cli.io.image_folder import HOLDOUT
    from splatctrl_cli.io.output import Stopwatch, output_path, write_run
    from splatctrl_cli.io.ros_log import RosLogSource
    from splatctrl_cli.io.source import open_session
    from splatctrl_cli.io.state_watch import WatchedSource

    console, stopwatch = Console(args), Stopwatch()
    options = source_options(args)
    out = args.out or Path(args.source[0].stem + ".capture")
    with stopwatch.stage("survey"):
        opened = open_session(args.source, options)
        source = WatchedSource(opened)
        topics = opened.joint_topics if isinstance(opened, RosLogSource | CaptureSource) else None
    if set(source.cameras) == {HOLDOUT}:
        raise UsageError(
            f"--cameras {args.cameras}: leaves no camera to train with", remedy="name another, or leave it out"
        )
    console.log(f"{source.name}: cameras {', '.join(source.cameras)}; {len(source.joint_names)} joints")

    def progress(num_frames: int) -> None:
        if num_frames % 100 == 0:
            console.log(f"{num_frames} frames")

    with output_path(out, force=args.force, is_folder=True) as partial:
        with stopwatch.stage("write"):
            summary = write_capture(partial, source, topics=topics, progress=progress)
        metrics = {
            "frames": summary.num_frames,
            "joint_states": summary.num_joint_states,
            "loss": asdict(summary.loss),
            "clock_offset": None if (offset := source.clock_offset()) is None else asdict(offset),
        }
        write_run(
            partial,
            command="ingest",
            config=asdict(options),
            inputs=source.digests(),
            metrics=metrics,
            stopwatch=stopwatch,
        )
    lines = table(["camera", "frames"], sorted(summary.num_frames.items()))
    lines += [
        f"{key.replace('_', ' ')}: {value}" for key, value in asdict(summary.loss).items() if value and key != "notes"
    ]
    lines += [f"note: {note}" for note in summary.loss.notes]
    lines += [] if offset is None else [f"note: {offset.sentence}"]
    console.result(
        {"capture": str(out), **metrics}, [*lines, f"joint states: {summary.num_joint_states}", f"wrote {out}"]
    )
    return 3 if summary.loss.damaged else 0
