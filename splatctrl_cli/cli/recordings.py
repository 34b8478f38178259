"""``splatctrl simulate``, ``ingest``, ``info`` and ``capture``: recordings made, taken in, described and packed."""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

from splatctrl_cli.cli.common import Console, table
from splatctrl_cli.cli.options import request_of, source_options
from splatctrl_cli.evaluate.verdict import DAMAGED
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.jobs.ingest import IngestRequest, IngestResult, PackRequest, ingest, pack, unpack
from splatctrl_cli.jobs.simulate import SimulateRequest, SimulateResult, simulate
from splatctrl_cli.simulate.recording import RecordingOptions
from splatctrl_cli.simulate.shared_workspace import DURATION_S
from splatctrl_cli.sources.describe import describe


def run_simulate(args: argparse.Namespace) -> int:
    """Record a log, and return the exit code."""
    console, given = Console(args), {"duration_s": args.duration, "with_person": args.person}
    if args.duration is None and args.human_arm is not None:
        given["duration_s"] = DURATION_S
    options = request_of(RecordingOptions, args, **{name: v for name, v in given.items() if v is not None})
    result = simulate(
        SimulateRequest(out=args.out or Path("simulated"), options=options, dtu=args.dtu, force=args.force), console
    )
    console.result({"out": str(result.out), "bytes": result.sizes, **result.metrics}, _simulated(result))
    return 0


def _simulated(result: SimulateResult) -> list[str]:
    truth = result.truth
    cameras = [
        (
            camera.name,
            "training" if camera.is_training else "scoring",
            result.num_frames[camera.name],
            f"{camera.intrinsics.width}x{camera.intrinsics.height}",
            f"{truth.luminance_std[camera.name]:.3f}",
        )
        for camera in truth.cameras
    ]
    lines = [f"{result.out}", "", *table(("file", "bytes"), list(result.sizes.items())), ""]
    lines += table(("camera", "role", "frames", "size", "luminance std"), cameras)
    lines += ["", f"joint states {len(truth.stamps)}, true clearance at least {truth.clearance.min() * 100:.1f} cm"]
    return lines


def run_ingest(args: argparse.Namespace) -> int:
    """Write a capture, and return the exit code."""
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
    console.result({"capture": str(result.capture), **result.metrics}, lines, code=result.exit_code)
    return result.exit_code


def run_info(args: argparse.Namespace) -> int:
    """Describe what the path leads to, and return the exit code."""
    return show_described(Console(args), describe(args.path, source_options(args)))


def show_described(console: Console, summary: Summary) -> int:
    """Facts and tables, and what a reconstruction lacks."""
    code = DAMAGED if summary.damaged else 0
    console.result(summary.as_dict(), _described(summary), code=code)
    return code


def _described(summary: Summary) -> Iterator[str]:
    yield f"{summary.path}: {summary.kind}"
    yield from _facts(summary.facts, "  ")
    for grid in summary.grids:
        yield ""
        yield from table(grid.header, grid.rows) if grid.rows else [f"no {grid.name}"]
    if summary.missing:
        yield ""
        yield from (f"missing for a reconstruction: {item}" for item in summary.missing)
    yield from (f"note: {note}" for note in summary.notes)


def _facts(facts: Mapping[str, object], indent: str) -> Iterator[str]:
    for key, value in facts.items():
        if isinstance(value, dict):
            yield f"{indent}{key}:"
            yield from _facts(value, indent + "  ")
        elif isinstance(value, list):
            yield f"{indent}{key}: {', '.join(map(_shown, value)) or '-'}"
        else:
            yield f"{indent}{key}: {_shown(value)}"


def _shown(value: object) -> str:
    """A float with up to six decimals, more digits where it is small; a dash for nothing."""
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    return f"{value:.6f}".rstrip("0").rstrip(".") if value == 0 or abs(value) >= 1e-3 else f"{value:.6g}"


def run_pack(args: argparse.Namespace) -> int:
    """Write a capture as one MCAP, and return the exit code."""
    console = Console(args)
    result = pack(request_of(PackRequest, args, source=args.capture), console)
    found = {"mcap": str(result.out), "frames": result.num_frames, "bytes": result.bytes}
    console.result(found, [f"frames: {result.num_frames}", f"wrote {result.out}"])
    return 0


def run_unpack(args: argparse.Namespace) -> int:
    """Write the capture that an MCAP was made of, and return the exit code."""
    result = unpack(request_of(PackRequest, args, source=args.packed))
    found = {"capture": str(result.out), "frames": result.num_frames}
    Console(args).result(found, [f"frames: {result.num_frames}", f"wrote {result.out}"])
    return 0
