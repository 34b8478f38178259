"""``splatctrl ingest`` and ``capture``: recordings taken in, packed and unpacked."""

import argparse
from dataclasses import asdict

from splatctrl_cli.cli.common import Console, table
from splatctrl_cli.cli.options import request_of, source_options
from splatctrl_cli.jobs.ingest import IngestRequest, IngestResult, PackRequest, ingest, pack, unpack


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


def run_pack(args: argparse.Namespace) -> int:
    console = Console(args)
    result = pack(request_of(PackRequest, args, source=args.capture), console)
    found = {"mcap": str(result.out), "frames": result.num_frames, "bytes": result.bytes}
    return console.result(found, [f"frames: {result.num_frames}", f"wrote {result.out}"])


def run_unpack(args: argparse.Namespace) -> int:
    """Write the capture that an MCAP was made of, and return the exit code."""
    result = unpack(request_of(PackRequest, args, source=args.packed))
    found = {"capture": str(result.out), "frames": result.num_frames}
    return Console(args).result(found, [f"frames: {result.num_frames}", f"wrote {result.out}"])
