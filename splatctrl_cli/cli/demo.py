"""``splatctrl simulate`` and ``demo``: simulated recordings, and the main jobs on one."""

import argparse
import contextlib
import io
import time
from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name

from splatctrl_cli.cli.commands import build_parser
from splatctrl_cli.cli.common import Console, request_of, table
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.jobs.demo import PICTURES, DemoRequest, demo
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, simulate


def run(args: argparse.Namespace, console: Console) -> int:
    request = request_of(DemoRequest, args)

    def perform(words: Sequence[str], folder: Path) -> str:
        """Run a command line, print its output with the final folder, and return its label."""
        step, text = build_parser(words[0]).parse_args(words), io.StringIO()
        vars(step).pop("junit", None)  # CI is told of the demo alone
        step.quiet = args.quiet
        with contextlib.redirect_stdout(text):
            code = resolve_name(f"splatctrl_cli.cli.{step.run}")(step, Console(step))
        if not (console.is_quiet or console.is_json):
            print(text.getvalue().replace(str(folder), str(request.out)), end="", flush=True)
        return getattr(step, "label", f"exit code {code}" if code else "done")

    verdict, out, seconds = demo(request, perform, console), request.out, time.perf_counter() - args.began
    shown = [f"{description}: {out / name}" for name, description in PICTURES.items()]
    document = {"out": out, "seconds": round(seconds, 1), "pictures": [out / name for name in PICTURES]}
    return console.show(
        JudgedResult(document=document, verdict=verdict),
        [f"done in {seconds:.0f} s; look at", *shown, f"everything else is in {out}/"],
    )


def run_simulate(args: argparse.Namespace, console: Console) -> int:
    result = simulate(request_of(SimulateRequest, args), console)
    truth = result.truth
    cells = [
        (
            camera.name,
            "training" if camera.is_training else "scoring",
            result.metrics["frames"][camera.name],
            f"{camera.intrinsics.width}x{camera.intrinsics.height}",
            f"{truth.luminance_std[camera.name]:.3f}",
        )
        for camera in truth.cameras
    ]
    lines = [
        f"{result.out}",
        "",
        *table(("file", "bytes"), list(result.document["bytes"].items())),
        "",
        *table(("camera", "role", "frames", "size", "luminance std"), cells),
        "",
        f"joint states {len(truth.stamps)}, true clearance at least {truth.clearance.min() * 100:.1f} cm",
    ]
    return console.show(result, lines)
