"""``splatctrl ingest``: recordings written as captures."""

import argparse
from dataclasses import asdict

from splatctrl_cli.cli.common import Console, table
from splatctrl_cli.cli.options import request_of, source_options
from splatctrl_cli.jobs.ingest import IngestRequest, IngestResult, ingest


def run_ingest(args: argparse.Namespace) -> int:
    console = Console(args)
    request = request_of(IngestRequest, args, paths=tuple(args.source), options=source_options(args))
    return show_ingested(console, ingest(request, console))


def show_ingested(console: Console, result: IngestResult) -> int:
    """Frames by camera, and what was lost."""
    lost = asdict(result.summary.loss)
    lines = table(["camera", "frames"], sorted(result.summary.num_frames.items()))
    lines += [f"{name.replace('_', ' ')}: {value}" for name, value in lost.items() if value and name != "notes"]
    lines += [f"note: {note}" for note in lost["notes"]]
    lines += [f"joint states: {result.summary.num_joint_states}", f"wrote {result.capture}"]
    return console.result({"capture": str(result.capture), **result.metrics}, lines, code=result.exit_code)
