"""Both methods of `splatctrl reconstruct` on the same views, scored on the same held-out views.

    python -m benchmarks.methods "docs/examples/apc_shelf.toml --root SCENE" "--dtu sample_data/dtu --holdout 2,5"

Each argument is what `reconstruct` is told of one recording. Prints a markdown table. Losses, seeds and iterations
are the same; what differs is the method: a fixed budget of isotropic splats, or 3D Gaussian splatting, which grows.
"""

import argparse
import json
import shlex
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks.cli import SPLATCTRL, process
from benchmarks.measure import ROOT

METHODS = ("budget", "3dgs")
HEADER = (
    *("recording", "method", "splats", "iterations", "fit [s]", "memory [MiB]", "training dB"),
    *("held-out dB seen / all", "SSIM seen / all", "median depth error seen / all [mm]"),
)


@dataclass(frozen=True, kw_only=True)
class Options:
    """iterations: of either method; budget: largest number of isotropic splats, and of first Gaussians."""

    iterations: int
    budget: int
    settings: tuple[str, ...]
    threads: int


def main() -> None:
    """Run every method on every recording."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.methods", description=__doc__)
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="arguments of reconstruct, as one word")
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--max-splats", type=int, default=5000, help="budget, and Gaussians to start from")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="for both methods")
    parser.add_argument("--threads", type=int, default=0)
    args = parser.parse_args()
    options = Options(
        iterations=args.iterations, budget=args.max_splats, settings=tuple(args.set), threads=args.threads
    )
    print(f"| {' | '.join(HEADER)} |\n|{' --- |' * len(HEADER)}")
    for recording in args.recordings:
        for method in METHODS:
            print(f"| {' | '.join(row(shlex.split(recording), method, options))} |", flush=True)


def row(recording: list[str], method: str, options: Options) -> list[str]:
    """One line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        _, peak = process([SPLATCTRL, "reconstruct", *recording, "-o", str(scene), "-q", *_settings(method, options)])
        run = json.loads((scene / "run.json").read_text(encoding="utf-8"))
        score = [SPLATCTRL, "score", str(scene), *reference(recording), "-q", "--json"]
        scores = json.loads(subprocess.run(score, check=True, capture_output=True, cwd=ROOT).stdout)["metrics"]
    fitted = run["metrics"]
    return [
        _name(recording),
        method,
        str(fitted["splats"]),
        str(fitted["iterations"]),
        f"{run['seconds']['fit']:.0f}",
        f"{peak:.0f}",
        figure(fitted["psnr"], 2),
        pair(scores, "psnr", 2),
        pair(scores, "ssim", 3),
        pair(scores, "depth_median", 1, 1e3),
    ]


def pair(scores: dict[str, float | None], name: str, digits: int, factor: float = 1.0) -> str:
    """Over the pixels that a training view saw, and over all."""
    return " / ".join(figure(scores[f"{name}_{region}"], digits, factor) for region in ("seen", "all"))


def figure(value: float | None, digits: int, factor: float = 1.0) -> str:
    """A number as the table shows it."""
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _settings(method: str, options: Options) -> list[str]:
    first = min(300, options.iterations)  # of the fixed budget's: a first time step, then refining
    settings = [
        f"gaussians.iterations={options.iterations}",
        f"scene.first_iterations={first}",
        f"scene.refine_iterations={options.iterations - first}",
        *options.settings,
    ]
    given = [word for setting in settings for word in ("--set", setting)]
    return [
        *given,
        "--method",
        method,
        "--max-splats",
        str(options.budget),
        "--threads",
        str(options.threads),
    ]


def reference(recording: list[str]) -> list[str]:
    """The same recording as `score` wants it named."""
    return recording if recording[0].startswith("-") else ["--reference", *recording]


def _name(recording: list[str]) -> str:
    first = next(word for word in recording if not word.startswith("--"))
    return f"`{Path(first).stem}`"


if __name__ == "__main__":
    main()
