"""``splatctrl ingest``: any recorded input into a capture folder."""

import argparse
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.captures.capture import CaptureSource, write_capture
from splatctrl_cli.captures.capture_journal import JOURNAL, read_identity
from splatctrl_cli.captures.capture_writer import CaptureSummary
from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_output, table
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.datasets.image_folder import HOLDOUT
from splatctrl_cli.errors import UsageError
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_run
from splatctrl_cli.jobs.resume import check_same_run
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.logs.ros_log import RosLogSource
from splatctrl_cli.sources.source import open_session


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "ingest", run)
    parser.add_argument(
        "source",
        type=Path,
        nargs="+",
        help=".mcap, .bag, .db3, ROS 2 bag folder, folder of a dataset, or .toml of an image folder;"
        " several logs of one session are read as one",
    )
    add_output(parser, default="NAME.capture in this folder, NAME that of SOURCE", what="capture folder")
    parser.add_argument(
        "--resume", action="store_true", help="continue an interrupted run, if there is one, to the same bytes"
    )
    add_source(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    console, stopwatch = Console(args), Stopwatch()
    options = source_options(args)
    out = args.out or Path(args.source[0].stem + ".capture")
    with stopwatch.stage("survey"):
        source = open_session(args.source, options)
        topics = source.joint_topics if isinstance(source, RosLogSource | CaptureSource) else None
    if set(source.cameras) == {HOLDOUT}:
        raise UsageError(
            f"--cameras {args.cameras}: leaves no camera to train with", remedy="name another, or leave it out"
        )
    console.log(f"{source.name}: cameras {', '.join(source.cameras)}; {len(source.joint_names)} joints")

    def progress(num_frames: int) -> None:
        if num_frames % 100 == 0:
            console.log(f"{num_frames} frames")

    identity = _identity(options, source.digests())
    with (
        _told_how_to_go_on(out),
        output_path(out, force=args.force, is_folder=True, checkpoint=JOURNAL, resume=args.resume) as partial,
    ):
        before = read_identity(partial)
        if before is not None:
            check_same_run(partial, before, identity)
        with stopwatch.stage("write"):
            summary = write_capture(partial, source, topics=topics, progress=progress, identity=identity)
        if summary.num_resumed:
            console.log(f"{summary.num_resumed} frames were there already")
        metrics = {
            "frames": summary.num_frames,
            "joint_states": summary.num_joint_states,
            "loss": asdict(summary.loss),
        }
        write_run(
            partial,
            command="ingest",
            config=asdict(options),
            inputs=source.digests(),
            metrics=metrics,
            stopwatch=stopwatch,
        )
    console.result({"capture": str(out), **metrics}, [*_lines(summary), f"wrote {out}"])
    return 3 if summary.loss.damaged else 0


def _lines(summary: "CaptureSummary") -> list[str]:
    lines = table(["camera", "frames"], sorted(summary.num_frames.items()))
    lost = asdict(summary.loss).items()
    lines += [f"{key.replace('_', ' ')}: {value}" for key, value in lost if value and key != "notes"]
    lines += [f"note: {note}" for note in summary.loss.notes]
    return [*lines, f"joint states: {summary.num_joint_states}"]


def _identity(options: "SourceOptions", inputs: Mapping[str, str]) -> dict[str, Any]:
    """Everything that decides the bytes of a capture, as plain values; inputs: sha256 by name."""
    versions = {name: metadata.version(name) for name in ("numpy", "opencv-python-headless")}
    values = {"splatctrl": __version__, **versions, "options": asdict(options), "sha256": dict(inputs)}
    plain: dict[str, Any] = json.loads(json.dumps(values, default=str))
    return plain


@contextmanager
def _told_how_to_go_on(out: Path) -> Iterator[None]:
    """Says after Ctrl-C what was kept."""
    try:
        yield
    except KeyboardInterrupt:
        partial = partial_path(out)
        if not (partial / JOURNAL).is_file():
            raise
        raise KeyboardInterrupt(f"interrupted: {partial} is kept; go on with the same command and --resume") from None
