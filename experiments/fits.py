"""IV-A: fit scans by 3D Gaussian splatting and by a fixed budget, and score both on the same held-out views.

    python -m experiments fits DTU --scan scan24,scan37 -o out/fits

The paper names no scans, views, sizes or iterations.
"""

import argparse
import gc
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from experiments.densify import GaussianSettings
from experiments.gaussians import reconstruct_gaussians
from experiments.tables import aligned, shown
from splatctrl_cli import (
    Config,
    InputError,
    JudgedResult,
    ReconstructRequest,
    RecordingRequest,
    ScoreRequest,
    SourceOptions,
    SplatCtrlError,
    UsageError,
    load_config,
    open_to_train,
    reconstruct,
    score,
)
from splatctrl_cli.blocks import idr_scans, output_path, scan_folders, write_json

PROTOCOL = "dtu-holdout8"  # the paper names neither scans nor views
SPLATS = 10_000  # what both methods begin with, and the budget of ours
FIRST = 300  # iterations of ours on the first time step, the rest refines
GAUSSIANS, BUDGET = "3dgs", "budget"
OWN = ("psnr", "splats", "memory", "seconds")


@dataclass(frozen=True, kw_only=True)
class Method:
    """A method: name, suffix of its metrics, and the paper's figures on DTU, PSNR [dB] and Gaussians."""

    name: str
    key: str
    psnr: float
    splats: str


METHODS = {
    GAUSSIANS: Method(name="3D-GS", key="3dgs", psnr=23.27, splats="50,000-100,000"),
    BUDGET: Method(name="ours", key="ours", psnr=23.33, splats="10,000"),
}


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of the table: its title, the factor to its unit, and the format."""

    title: str
    form: str
    factor: float = 1.0


COLUMNS = {
    **{f"psnr_{region}": Column(title=f"dB {region}", form=".2f") for region in ("seen", "all", "masked")},
    **{f"ssim_{region}": Column(title=f"SSIM {region}", form=".4f") for region in ("seen", "all", "published")},
    **{
        f"depth_median_{region}": Column(title=f"depth mm {region}", form=".1f", factor=1e3)
        for region in ("seen", "all")
    },
}


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """One method on one scan: its scene, this process's peak memory [MiB] during the fit (None if unknown), and the
    score of its views.
    """

    scan: str
    method: str
    scene: JudgedResult
    memory: float | None
    score: JudgedResult

    def as_dict(self) -> dict[str, Any]:
        """Plain values; psnr [dB] by the protocol, over the mask if there is one."""
        metrics = self.score.metrics
        return {
            "scan": self.scan,
            "method": self.method,
            "splats": int(self.scene.metrics["splats"]),
            "memory": self.memory,
            "seconds": round(self.scene.seconds["fit"], 4),
            "psnr": metrics["psnr_masked"] if "psnr_masked" in metrics else metrics["psnr_all"],
            "metrics": metrics,
        }


@dataclass(frozen=True, kw_only=True)
class FitRequest:
    """Fit the scans of a DTU tree (`recording.scan`: names joined by commas; None: all), or an image folder.

    config: of both methods; iterations: of each. out: folder for scenes and scores.
    """

    recording: RecordingRequest
    config: Config
    iterations: int
    out: Path | None = None
    force: bool = False
    seed: int = 0
    threads: int = 0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``fits``."""
    add = parser.add_argument
    add("recording", type=Path, help="a DTU tree in MVSNet's layout or in IDR's, or an image folder's .toml")
    add("-o", "--out", type=Path, help="folder for SCAN/METHOD/scene and score, and fits.json (default: none)")
    add("--force", action="store_true", help="replace the output if it exists")
    add("--scan", help="only these scans of the tree: A,B")
    add("--protocol", help=f"which views are held out, as of splatctrl score (default: {PROTOCOL} of a tree)")
    add("--masks", type=Path, help="object masks of MVSNet's layout, or a folder of them for each scan")
    add("--root", type=Path, help="folder of the image folder's files")
    add("--iterations", type=int, help="of each method (default: those of the configuration, 2300)")
    add("--splats", type=int, default=SPLATS, help="the budget, and Gaussians to begin with (default: 10000)")
    add("--set", action="append", default=[], help="a setting of both methods: SECTION.KEY=VALUE (repeatable)")
    add("--seed", type=int, default=0, help="of both methods")
    add("--threads", type=int, default=0, help="(default: one per core)")


def run(args: argparse.Namespace) -> int:
    """Fit, score, print and write."""
    report = fit_scans(_request(args))
    print(*lines_of(report), sep="\n")
    return 0


def _request(args: argparse.Namespace) -> FitRequest:
    """The request with its defaults. Values of --set override --iterations, but not --splats."""
    is_dtu = args.recording.is_dir()
    if not is_dtu and args.protocol is None:
        raise UsageError(f"fits {args.recording}: needs a protocol", remedy="give --protocol holdout:2,5")
    scene = load_config(None, args.set).scene
    iterations = scene.first_iterations + scene.refine_iterations if args.iterations is None else args.iterations
    first = min(FIRST, iterations)
    both = (f"scene.first_iterations={first}", f"scene.refine_iterations={iterations - first}")
    recording = RecordingRequest(
        path=args.recording,
        is_dtu=is_dtu,
        options=SourceOptions(root=args.root),
        scan=args.scan,
        protocol=args.protocol or PROTOCOL,
        masks=args.masks,
    )
    return FitRequest(
        recording=recording,
        config=load_config(None, [*both, *args.set, f"scene.max_splats={args.splats}"]),
        iterations=iterations,
        out=args.out,
        force=args.force,
        seed=args.seed,
        threads=args.threads,
    )


def known_scans(root: Path) -> list[str]:
    """The names of the scans in a DTU tree, in MVSNet's layout or in IDR's."""
    found = idr_scans(root) if not (root / "Rectified").is_dir() else {}
    return list(found or scan_folders(root))


def fit_scans(request: FitRequest) -> dict[str, Any]:
    """Fit both methods to each scan, score them alike, and write outputs to `out`, if given; return plain values.

    Raises InputError if a reconstruction fails, other SplatCtrlError if scoring is impossible.
    """
    scans, out = _scans(request.recording), request.out
    fits: list[Fitted] = []
    with ExitStack() as stack:
        if out is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        else:
            folder = stack.enter_context(output_path(out, force=request.force, is_folder=True))
        for scan in scans:
            recording = _with_scan(request.recording, scan)
            scenes = {name: _fit(request, recording, name, folder / scan / name / "scene") for name in METHODS}
            # scored after both were fitted: what scoring leaves in memory then counts for neither
            for name, (scene, memory) in scenes.items():
                made, kept = folder / scan / name / "scene", None if out is None else folder / scan / name / "score"
                scored = score(ScoreRequest(scene=made, recording=recording, out=kept, threads=request.threads))
                fits.append(Fitted(scan=scan, method=name, scene=scene, memory=memory, score=scored))
        report = _report(request, fits)
        if out is not None:
            write_json(folder / "fits.json", report)
    return report


def _scans(recording: RecordingRequest) -> list[str]:
    root = recording.path
    if not recording.is_dtu:
        return [root.stem]
    known = known_scans(root)
    wanted = known if recording.scan is None else list(dict.fromkeys(recording.scan.split(",")))
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        what = f"no scan {unknown[0]!r}" if unknown else "no scan"
        raise InputError(f"{root}: {what}", remedy=f"scans: {', '.join(known) or 'none is there'}")
    return wanted


def _with_scan(recording: RecordingRequest, scan: str) -> RecordingRequest:
    if not recording.is_dtu:
        return recording
    masks = recording.masks
    if masks is not None and (masks / scan).is_dir():
        masks = masks / scan
    return replace(recording, scan=scan, masks=masks)


def _fit(
    request: FitRequest, recording: RecordingRequest, method: str, out: Path
) -> tuple[JudgedResult, float | None]:
    """The scene of one method, and this process's peak memory [MiB] during the fit, None if unknown. Raises
    InputError with the verdict's sentence if the fit fails.
    """
    out.parent.mkdir(parents=True)
    has_peak = _forget_peak_memory()
    where = f"{out.parent.parent.name}, {METHODS[method].name}"
    try:
        source = open_to_train(replace(recording, masks=None))
        asked = ReconstructRequest(
            source=source, out=out, config=request.config, seed=request.seed, threads=request.threads
        )
        if method == GAUSSIANS:
            made = reconstruct_gaussians(asked, GaussianSettings(iterations=request.iterations))
        else:
            made = reconstruct(asked)
    except SplatCtrlError as error:
        raise InputError(f"{where}: {error}", remedy=error.remedy) from error
    if made.verdict.exit_code:
        raise InputError(f"{where}: {made.verdict.sentence}")
    return made, _peak_memory() if has_peak else None


def _forget_peak_memory() -> bool:
    """Reset this process's peak memory; return False if the system cannot."""
    gc.collect()
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _peak_memory() -> float:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def _mean(values: Sequence[float | None]) -> float | None:
    """None where any is missing."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def _report(request: FitRequest, fits: Sequence[Fitted]) -> dict[str, Any]:
    metrics: dict[str, float | None] = {}
    for name, method in METHODS.items():
        rows = [fit.as_dict() for fit in fits if fit.method == name]
        means = {what: _mean([row[what] for row in rows]) for what in OWN}
        means["memory"] = None if means["memory"] is None else max(row["memory"] for row in rows)
        each = [row["metrics"] for row in rows]
        means |= {what: _mean([one[what] for one in each]) for what in COLUMNS if what in each[0]}
        metrics |= {f"{what}_{method.key}": value for what, value in means.items()}
    ours, theirs = metrics["psnr_ours"], metrics["psnr_3dgs"]
    metrics["psnr_gain"] = None if ours is None or theirs is None else ours - theirs
    protocol = fits[0].score.document["protocol"]
    return {
        "source": str(request.recording.path),
        "scans": list(dict.fromkeys(fit.scan for fit in fits)),
        "protocol": protocol,
        "psnr": "over every pixel" if protocol["mask_rule"] == "none" else "over the mask",
        "settings": {
            "splats": request.config.scene.max_splats,
            "iterations": request.iterations,
            "seed": request.seed,
            "losses": "identical: scene.lambda_* of the configuration",
        },
        "paper": {method.name: {"psnr": method.psnr, "splats": method.splats} for method in METHODS.values()},
        "metrics": metrics,
        "warnings": [f"{fit.scan}, {METHODS[fit.method].name}: {line}" for fit in fits for line in fit.score.notes],
        "fits": [fit.as_dict() for fit in fits],
    }


def lines_of(report: Mapping[str, Any]) -> Iterator[str]:
    """Lines of the methods and the paper's figures, each fit, and notes on the figures."""
    settings, protocol, fits = report["settings"], report["protocol"], report["fits"]
    yield from _lines_of_methods(report)
    yield "paper's: its section IV-A, on scans, views, sizes and iterations that it does not name; the rest: here"
    yield ""
    names = [name for name in COLUMNS if name in fits[0]["metrics"]]
    rows = []
    for fit in fits:
        cells = [shown(fit["metrics"][name], COLUMNS[name].form, COLUMNS[name].factor) for name in names]
        last = shown(fit["memory"], ".0f"), shown(fit["seconds"], ".0f")
        rows.append([fit["scan"], METHODS[fit["method"]].name, fit["splats"], *cells, *last])
    titles = [COLUMNS[name].title for name in names]
    yield from aligned(("scan", "method", "splats", *titles, "memory MiB", "fit s"), rows)
    yield ""
    yield f"protocol: {protocol['name']} ({protocol['source']}); split: {protocol['split']}"
    yield f"mask rule: {protocol['mask_rule']}; resolution: {', '.join(protocol['resolution'])}"
    yield (
        f"PSNR {report['psnr']}; {settings['splats']:,} splats to begin with, {settings['iterations']} iterations,"
        f" seed {settings['seed']}, the same losses; memory: the largest of the scans"
    )
    yield from (f"warning: {line}" for line in report["warnings"])


def _lines_of_methods(report: Mapping[str, Any]) -> list[str]:
    metrics, fits = report["metrics"], report["fits"]
    rows, psnr = [], {name: [fit["psnr"] for fit in fits if fit["method"] == name] for name in METHODS}
    for name, method in METHODS.items():
        rest = [shown(metrics[f"{what}_{method.key}"], ".0f") for what in ("splats", "memory", "seconds")]
        scans = [shown(value, ".2f") for value in (*psnr[name], metrics[f"psnr_{method.key}"])]
        rows.append([method.name, f"{method.psnr:.2f}", method.splats, *scans, *rest])
    pairs = zip(psnr[BUDGET], psnr[GAUSSIANS], strict=True)
    gains: list[float | None] = [METHODS[BUDGET].psnr - METHODS[GAUSSIANS].psnr]
    gains += [None if None in pair else pair[0] - pair[1] for pair in pairs]
    first, *others = [shown(value, "+.2f") for value in (*gains, metrics["psnr_gain"])]
    rows.append(["ours - 3D-GS", first, "-", *others, "-", "-", "-"])
    header = ("method", "paper's dB", "paper's splats", *(f"{scan} dB" for scan in report["scans"]))
    return aligned((*header, "mean dB", "splats", "memory MiB", "fit s"), rows)
