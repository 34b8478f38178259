"""One recording reconstructed in several ways, scored on the same held-out views: ablations, and quality over time.

    python -m benchmarks.variants "docs/examples/tabletop_views.toml --root VIEWS --max-splats 10000" \
        "all of it=" "no depth loss=scene.lambda_depth=0" "clones=scene.when_idle=clone"

The first argument is what `reconstruct` is told of the recording, each other one a name, `=`, and what is different:
words with `=` in them are settings, others are options. Prints a markdown table.
"""

import argparse
import json
import shlex
import subprocess
import tempfile
from pathlib import Path

from benchmarks.cli import SPLATCTRL
from benchmarks.measure import ROOT

HEADER = (
    *("variant", "splats", "fit [s]", "training dB", "held-out dB seen / all", "SSIM seen / all"),
    *("median depth error seen / all [mm]", "in front seen [%]", "at corrected poses: dB, SSIM, mm, all"),
)
NOT_OF_SCORE = ("--max-splats", "--points")  # options of reconstruct, with one value, that score does not know


def main() -> None:
    """Run every variant."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.variants", description=__doc__)
    parser.add_argument("recording", help="arguments of reconstruct, as one word")
    parser.add_argument("variants", nargs="+", metavar="NAME=WORDS")
    args = parser.parse_args()
    print(f"| {' | '.join(HEADER)} |\n|{' --- |' * len(HEADER)}")
    for variant in args.variants:
        name, _, words = variant.partition("=")
        print(f"| {' | '.join(row(shlex.split(args.recording), name, shlex.split(words)))} |", flush=True)


def row(recording: list[str], name: str, words: list[str]) -> list[str]:
    """One line of the table."""
    given = [part for word in words for part in (("--set", word) if "=" in word else (word,))]
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        command = [SPLATCTRL, "reconstruct", *recording, *given, "-o", str(scene), "-q"]
        subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
        run = json.loads((scene / "run.json").read_text(encoding="utf-8"))
        score = [SPLATCTRL, "score", str(scene), *reference(_known_to_score(recording)), "-q", "--json"]
        scores = json.loads(subprocess.run(score, check=True, capture_output=True, cwd=ROOT).stdout)["metrics"]
    fitted = run["metrics"]
    return [
        name,
        str(fitted["splats"]),
        f"{run['seconds']['fit']:.1f}",
        figure(fitted["psnr"], 2),
        pair(scores, "psnr", 2),
        pair(scores, "ssim", 3),
        pair(scores, "depth_median", 1, 1e3),
        figure(scores["in_front_seen"], 1, 100.0),
        ", ".join(
            figure(scores.get(f"{name}_all_corrected"), digits, factor)
            for name, digits, factor in (("psnr", 2, 1.0), ("ssim", 2, 1.0), ("depth_median", 1, 1e3))
        ),
    ]


def pair(scores: dict[str, float | None], name: str, digits: int, factor: float = 1.0) -> str:
    """Over the pixels that a training view saw, and over all."""
    return " / ".join(figure(scores[f"{name}_{region}"], digits, factor) for region in ("seen", "all"))


def figure(value: float | None, digits: int, factor: float = 1.0) -> str:
    """A number as the table shows it."""
    return "-" if value is None else f"{factor * value:.{digits}f}"


def reference(recording: list[str]) -> list[str]:
    """The same recording as `score` wants it named."""
    return recording if recording[0].startswith("-") else ["--reference", *recording]


def _known_to_score(recording: list[str]) -> list[str]:
    places = {place + k for place, word in enumerate(recording) if word in NOT_OF_SCORE for k in (0, 1)}
    return [word for place, word in enumerate(recording) if place not in places]


if __name__ == "__main__":
    main()
