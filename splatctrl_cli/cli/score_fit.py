"""``score --fit``: both methods on the same views, scored alike, and printed beside what the paper prints."""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli import launch
from splatctrl_cli.cli.common import Console, configured, table
from splatctrl_cli.cli.numbers import setting, whole
from splatctrl_cli.cli.score_cloud import cloud_settings
from splatctrl_cli.cli.score_fit_picture import draw_methods
from splatctrl_cli.cli.score_reference import is_folder_of_views, words
from splatctrl_cli.cli.score_report import COLUMNS, cell, protocol_lines, views_reason
from splatctrl_cli.cli.score_scans import masks_of_scan
from splatctrl_cli.config import SceneConfig
from splatctrl_cli.config.map import MOST_ITERATIONS
from splatctrl_cli.datasets.dtu import scan_folders
from splatctrl_cli.datasets.idr import idr_scans
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.gates import check_gate_names, gate_reasons
from splatctrl_cli.evaluate.perceptual import Lpips
from splatctrl_cli.evaluate.verdict import Verdict, noted, verdict_of
from splatctrl_cli.files.output import Stopwatch, output_path, write_json, write_run

if TYPE_CHECKING:
    ScoreScene = Callable[[argparse.Namespace, Console, Path | None], tuple[dict[str, Any], Verdict]]

NUM_SPLATS = 10_000  # IV-A: what both methods begin with, and the budget of ours
METHODS = {"3dgs": "3D-GS", "budget": "ours"}
PAPER = {"3dgs": ("23.27", "50,000-100,000"), "budget": ("23.33", "10,000")}  # IV-A: PSNR [dB] and Gaussians on DTU
PROTOCOL = "dtu-holdout8"  # the paper names neither scans nor views
FIRST_ITERATIONS = 300  # of ours: on the first time step, the rest refines
KEYS = {"3dgs": "3dgs", "budget": "ours"}
EACH = (
    *("psnr_seen", "psnr_all", "psnr_masked", "ssim_seen", "ssim_all", "ssim_published", "lpips", "lpips_published"),
    *("depth_median_seen", "depth_median_all", "chamfer"),
)
OWN = ("psnr", "splats", "memory", "seconds")
GATED = (
    *("psnr_gain", *(f"{what}_{key}" for key in KEYS.values() for what in (*OWN, *EACH))),
    *("num_scans", "num_warnings"),
)


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """One method on one scan: splats, peak memory [MiB], seconds of fitting, and the scores of its views."""

    scan: str
    method: str
    splats: int
    iterations: int
    memory: float
    seconds: float
    score: dict[str, Any]

    @property
    def psnr(self) -> float | None:
        """[dB] by the protocol: over the mask where there is one."""
        metrics = self.score["metrics"]
        value: float | None = metrics["psnr_masked"] if "psnr_masked" in metrics else metrics["psnr_all"]
        return value

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        values = {name: value for name, value in vars(self).items() if name != "score"}
        return {**values, "psnr": self.psnr, "metrics": self.score["metrics"]}


def add_fit(parser: argparse.ArgumentParser) -> None:
    """``--fit`` and its options."""
    group = parser.add_argument_group("fit")
    group.add_argument(
        "--fit",
        action="store_true",
        help="fit the scans of --dtu (--scan A,B; default: all), or the image folder of --reference, with both"
        f" methods, then score them (default protocol of scans: {PROTOCOL})",
    )
    group.add_argument(
        "--fit-iterations",
        type=whole(1, MOST_ITERATIONS),
        metavar="N",
        help="of each method (default: those of the configuration, 2300)",
    )
    group.add_argument(
        "--fit-splats",
        type=setting(SceneConfig, "max_splats"),
        metavar="N",
        help="the budget, and Gaussians to begin with (default: 10000)",
    )


def run_fit(args: argparse.Namespace, score_scene: "ScoreScene") -> int:
    """Fit, score, print the table, and return the exit code."""
    _refuse(args)
    if args.lpips is not None:
        Lpips(args.lpips)  # better refused now than after the fits
    cloud = cloud_settings(args)
    config = configured(args)
    iterations, splats = args.fit_iterations, NUM_SPLATS if args.fit_splats is None else args.fit_splats
    if iterations is None:
        iterations = config.scene.first_iterations + config.scene.refine_iterations
    for name, value in (("iterations", iterations), ("splats", splats)):
        if value < 1:
            raise UsageError(f"--fit-{name}: expected at least 1, got {value}")
    check_gate_names(args.require, GATED)
    console, scans = Console(args), _scans(args)
    if cloud is not None:
        for scan in scans:
            cloud.of_scan(scan)
    if args.dtu is not None:
        args.protocol = args.protocol or PROTOCOL
    fits: list[Fitted] = []
    with _folder(args) as folder:
        for scan in scans:
            for method, name in METHODS.items():
                console.log(f"{scan}: fits {name}, {iterations} iterations")
                place = folder / scan / method
                scene, memory = _reconstruct(args, place / "scene", scan, _settings(method, iterations, splats))
                fits.append(_scored(args, console, place, scan, method, scene, memory, score_scene))
            if args.out is not None and args.images != "none":
                scenes = {name: folder / scan / method / "scene" for method, name in METHODS.items()}
                draw_methods(_scoring(args, scan), console, scenes, folder / scan / "methods.png")
        result = _result(args, fits, iterations, splats)
        verdict = _verdict(result, fits, args.require)
        if args.out is not None:
            _write(folder, args, result, config.as_dict(), verdict)
    console.concluded(verdict, result, _lines(result, fits), verdict.exit_code)
    return verdict.exit_code


def _verdict(result: dict[str, Any], fits: Sequence[Fitted], require: Sequence[str]) -> Verdict:
    num_views = min(fit.score["metrics"]["num_views"] for fit in fits)
    counts = dict.fromkeys(GATED, int(num_views))
    return verdict_of(
        "score",
        [
            views_reason(num_views),
            *(noted("score", line) for line in result["warnings"]),
            *gate_reasons(require, dict.fromkeys(GATED, None) | result["metrics"], counts),
        ],
        scope=f"{len(fits)} fits of {', '.join(result['scans'])}",
        counts=counts,
    )


def _refuse(args: argparse.Namespace) -> None:
    if args.scene is not None:
        raise UsageError(f"--fit: makes the scenes itself, got {args.scene}", remedy="leave SCENE or --fit out")
    if args.baseline is not None:
        raise UsageError("--baseline: not with --fit", remedy="score the scenes that --fit -o leaves")
    if args.dtu is not None and args.holdout:
        raise UsageError("--fit: goes by a protocol", remedy=f"give --protocol holdout:{args.holdout}")
    if args.reference is not None and not is_folder_of_views(args.reference):
        raise UsageError(
            f"--fit: expected scans (--dtu) or an image folder, got {args.reference}",
            remedy="the baseline fits views of a scene that stands still",
        )


def _scored(
    args: argparse.Namespace,
    console: Console,
    place: Path,
    scan: str,
    method: str,
    scene: Path,
    memory: float,
    score_scene: "ScoreScene",
) -> Fitted:
    run = json.loads((scene / "run.json").read_text(encoding="utf-8"))
    scoring = argparse.Namespace(**{**vars(_scoring(args, scan)), "scene": scene})
    folder = place / "score" if args.out is not None else None
    if folder is not None:
        folder.mkdir()
    result, _ = score_scene(scoring, console, folder)
    return Fitted(
        scan=scan,
        method=method,
        splats=int(run["metrics"]["splats"]),
        iterations=int(run["metrics"]["iterations"]),
        memory=memory,
        seconds=float(run["seconds"]["fit"]),
        score=result,
    )


def _scoring(args: argparse.Namespace, scan: str) -> argparse.Namespace:
    """What `score` would be told of one scan."""
    args = argparse.Namespace(**{**vars(args), "require": []})  # the gates are on both fits together
    if args.dtu is None:
        return argparse.Namespace(**{**vars(args), "scan": None})
    masks = args.masks
    if masks is not None and (masks / scan).is_dir():
        masks = masks_of_scan(masks, scan)
    return argparse.Namespace(**{**vars(args), "scan": scan, "masks": masks})


def _settings(method: str, iterations: int, splats: int) -> list[str]:
    first = min(FIRST_ITERATIONS, iterations)
    settings = (
        *(f"gaussians.iterations={iterations}", f"scene.first_iterations={first}"),
        f"scene.refine_iterations={iterations - first}",
    )
    given = [word for setting in settings for word in ("--set", setting)]
    return [*given, "--method", method, "--max-splats", str(splats)]


def _reconstruct(args: argparse.Namespace, scene: Path, scan: str, settings: list[str]) -> tuple[Path, float]:
    """`reconstruct` in a process of its own; returns the scene and the process's peak memory [MiB].

    Raises InputError with what it says where it does not end well.
    """
    scene.parent.mkdir(parents=True)
    source = [str(args.reference)] if args.dtu is None else ["--dtu", str(args.dtu), "--scan", scan]
    command = [sys.executable, "-m", "splatctrl_cli", "reconstruct", *source, "-q", "-o", str(scene), *settings]
    command += ["--seed", str(args.seed), "--threads", str(args.threads)]
    command += [word for setting in args.set for word in ("--set", setting)]
    for name in ("config", "depths", "downscale", "protocol", "root", "holdout", "depth_scale"):
        if getattr(args, name) is not None:
            command += [f"--{name.replace('_', '-')}", str(getattr(args, name))]
    launcher = [sys.executable, "-S", str(Path(launch.__file__))]
    done = subprocess.run([*launcher, *command], check=False, capture_output=True, text=True)
    said = done.stderr.strip().splitlines()
    _, peak, code = done.stdout.split() if done.stdout else ("", "0", "-1")
    if code != "0":
        line = said[-1].removeprefix("splatctrl: ") if said else "it said nothing"
        raise InputError(f"{scan}: reconstruct ended with {code}: {line}")
    return scene, float(peak) / 1024


def _scans(args: argparse.Namespace) -> list[str]:
    if args.dtu is None:
        return [args.reference.stem]
    found = idr_scans(args.dtu) if not (args.dtu / "Rectified").is_dir() else {}
    known = list(found or scan_folders(args.dtu))
    wanted = known if args.scan is None else words(args.scan)
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        got = f"no scan {unknown[0]!r}" if unknown else "no scan"
        raise InputError(f"{args.dtu}: {got}", remedy=f"scans: {', '.join(known) or 'none is there'}")
    return list(dict.fromkeys(wanted))


@contextmanager
def _folder(args: argparse.Namespace) -> Iterator[Path]:
    """Where the scenes go: the output, or a place for the time of the run."""
    if args.out is None:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)
        return
    with output_path(args.out, force=args.force, is_folder=True) as partial:
        yield partial


def _result(args: argparse.Namespace, fits: Sequence[Fitted], iterations: int, splats: int) -> dict[str, Any]:
    metrics: dict[str, float | None] = {}
    for method, key in KEYS.items():
        rows = [fit for fit in fits if fit.method == method]
        metrics[f"psnr_{key}"] = _mean([fit.psnr for fit in rows])
        metrics[f"splats_{key}"] = _mean([fit.splats for fit in rows])
        metrics[f"memory_{key}"] = max(fit.memory for fit in rows)
        metrics[f"seconds_{key}"] = _mean([fit.seconds for fit in rows])
        each = [fit.score["metrics"] for fit in rows]
        metrics |= {f"{name}_{key}": _mean([one[name] for one in each]) for name in EACH if name in each[0]}
    ours, theirs = metrics["psnr_ours"], metrics["psnr_3dgs"]
    metrics["psnr_gain"] = None if ours is None or theirs is None else ours - theirs
    first = fits[0].score["protocol"]
    scans = list(dict.fromkeys(fit.scan for fit in fits))
    warnings = [f"{fit.scan}, {METHODS[fit.method]}: {line}" for fit in fits for line in fit.score["warnings"]]
    metrics |= {"num_scans": len(scans), "num_warnings": len(warnings)}
    averaging = "mean over the views" + (" of a scan, then over the scans" if len(scans) > 1 else "")
    return {
        "source": str(args.dtu or args.reference),
        "scans": scans,
        "protocol": first | {"averaging": averaging},
        "psnr": "over every pixel" if first["mask_rule"] == "none" else "over the mask",
        "settings": {
            "splats": splats,
            "iterations": iterations,
            "seed": args.seed,
            "losses": "identical: scene.lambda_* of the configuration",
        },
        "paper": {METHODS[name]: {"psnr": float(psnr), "splats": number} for name, (psnr, number) in PAPER.items()},
        "metrics": metrics,
        "warnings": warnings,
        "fits": [fit.as_dict() for fit in fits],
    }


def _mean(values: Sequence[float | None]) -> float | None:
    """None where any is missing."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def _lines(result: dict[str, Any], fits: Sequence[Fitted]) -> list[str]:
    metrics, settings = result["metrics"], result["settings"]
    rows, psnr = [], {method: [fit.psnr for fit in fits if fit.method == method] for method in METHODS}
    for method, name in METHODS.items():
        rest = [_whole(metrics[f"{what}_{KEYS[method]}"]) for what in ("splats", "memory", "seconds")]
        scans = [cell("psnr", value) for value in psnr[method]]
        rows.append([name, *PAPER[method], *scans, cell("psnr", metrics[f"psnr_{KEYS[method]}"]), *rest])
    gains = [None if None in pair else pair[0] - pair[1] for pair in zip(psnr["budget"], psnr["3dgs"], strict=True)]  # type: ignore[operator]
    paper = float(PAPER["budget"][0]) - float(PAPER["3dgs"][0])
    rows.append(["ours - 3D-GS", _gain(paper), "-", *map(_gain, gains), _gain(metrics["psnr_gain"]), "-", "-", "-"])
    header = ("method", "paper's dB", "paper's splats", *(f"{scan} dB" for scan in result["scans"]))
    return [
        *table((*header, "mean dB", "splats", "memory MiB", "fit s"), rows),
        "paper's: its section IV-A, on scans, views, sizes and iterations that it does not name; the rest: here",
        "",
        *_each(fits),
        "",
        *protocol_lines(result["protocol"]),
        f"PSNR {result['psnr']}; {settings['splats']:,} splats to begin with, {settings['iterations']} iterations,"
        f" seed {settings['seed']}, the same losses; memory: the largest of the scans",
    ]


def _gain(value: float | None) -> str:
    return "-" if value is None else f"{value:+.2f}"


def _each(fits: Sequence[Fitted]) -> list[str]:
    """What else was scored, a row for each fit."""
    names = [name for name in EACH if name in fits[0].score["metrics"]]
    rows = []
    for fit in fits:
        figures = [cell(name, fit.score["metrics"][name]) for name in names]
        rows.append([fit.scan, METHODS[fit.method], fit.splats, *figures, f"{fit.memory:.0f}", f"{fit.seconds:.0f}"])
    return table(("scan", "method", "splats", *(COLUMNS[name] for name in names), "memory MiB", "fit s"), rows)


def _whole(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _write(
    folder: Path, args: argparse.Namespace, result: dict[str, Any], config: dict[str, Any], verdict: Verdict
) -> None:
    write_json(folder / "score.json", result)
    write_run(
        folder,
        command="score",
        config=config,
        inputs={},
        metrics=result["metrics"],
        stopwatch=Stopwatch(),
        seed=args.seed,
        verdict=verdict.as_dict(),
    )
