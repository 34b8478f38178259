"""``splatctrl simulate`` and ``demo``: simulated recordings, and the main jobs on one."""

import argparse
import contextlib
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.check import show_described, show_ingested
from splatctrl_cli.cli.common import Console, names_of, request_of, table
from splatctrl_cli.cli.export import show_exported
from splatctrl_cli.cli.reconstruct import show_reconstructed
from splatctrl_cli.cli.replay import show_replayed
from splatctrl_cli.cli.score import show_scored
from splatctrl_cli.cli.sdf_bake import show_baked
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.jobs.bake.bake import BakeResult
from splatctrl_cli.jobs.demo import DemoRequest, StepResult, demo
from splatctrl_cli.jobs.export.export import ExportResult
from splatctrl_cli.jobs.ingest import IngestResult
from splatctrl_cli.jobs.reconstruct.reconstruct import ReconstructResult
from splatctrl_cli.jobs.replay.replay import ReplayResult
from splatctrl_cli.jobs.score.score import ScoreResult
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, SimulateResult, simulate
from splatctrl_cli.simulate.arm import UNMODELLED
from splatctrl_cli.simulate.recording import RecordingOptions


def run(args: argparse.Namespace) -> int:
    console, request = Console(args), request_of(DemoRequest, args)
    step_console = Console(args, is_step=True)

    def told(result: StepResult, folder: Path) -> None:
        """Print a step's output, with the final folder name."""
        text = io.StringIO()
        with contextlib.redirect_stdout(text):
            SHOWN[type(result)](step_console, result)
        print(text.getvalue().replace(str(folder), str(request.out)), end="", flush=True)

    is_silent = console.is_quiet or console.is_json
    result = demo(request, console, (lambda result, folder: None) if is_silent else told)
    shown = [f"{description}: {path}" for path, description in result.pictures.items()]
    return console.concluded(
        result.verdict,
        {"out": str(result.out), "seconds": round(result.seconds, 1), "pictures": list(map(str, result.pictures))},
        [f"done in {result.seconds:.0f} s; look at", *shown, f"everything else is in {result.out}/"],
    )


def run_simulate(args: argparse.Namespace) -> int:
    console = Console(args)
    given = {"duration_s": args.duration, "with_person": args.person, "is_free": args.free}
    options = request_of(RecordingOptions, args, **{name: v for name, v in given.items() if v is not None})
    parts = () if args.unmodelled is None else names_of(args.unmodelled, tuple(UNMODELLED), "--unmodelled")
    request = request_of(
        SimulateRequest,
        args,
        out=args.out or Path("simulated"),
        options=options,
        is_slim=args.slim,
        unmodelled=parts,
    )
    return show_simulated(console, simulate(request, console))


def show_simulated(console: Console, result: SimulateResult) -> int:
    return console.result({"out": str(result.out), "bytes": result.sizes, **result.metrics}, _simulated(result))


def _simulated(result: SimulateResult) -> list[str]:
    truth = result.truth
    return [
        f"{result.out}",
        "",
        *table(("file", "bytes"), list(result.sizes.items())),
        "",
        *table(
            ("camera", "role", "frames", "size", "luminance std"),
            [
                (
                    camera.name,
                    "training" if camera.is_training else "scoring",
                    result.num_frames[camera.name],
                    f"{camera.intrinsics.width}x{camera.intrinsics.height}",
                    f"{truth.luminance_std[camera.name]:.3f}",
                )
                for camera in truth.cameras
            ],
        ),
        "",
        f"joint states {len(truth.stamps)}, true clearance at least {truth.clearance.min() * 100:.1f} cm",
    ]


SHOWN: Mapping[type, Callable[[Console, Any], int]] = {
    SimulateResult: show_simulated,
    Summary: show_described,
    IngestResult: show_ingested,
    ReconstructResult: show_reconstructed,
    ExportResult: show_exported,
    BakeResult: show_baked,
    ScoreResult: show_scored,
    ReplayResult: lambda console, result: show_replayed(console, result, code=result.exit_code()),
}
