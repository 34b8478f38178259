"""Both methods fitted to the same views and scored alike, beside what the paper prints (section IV-A)."""

import gc
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import Config, load_config
from splatctrl_cli.config.fixed import COMPARED_FIRST, COMPARED_SPLATS
from splatctrl_cli.datasets.dtu import scan_folders
from splatctrl_cli.datasets.idr import idr_scans
from splatctrl_cli.errors import InputError, SplatCtrlError, UsageError
from splatctrl_cli.evaluate.gates import check_gate_names
from splatctrl_cli.evaluate.images import psnr
from splatctrl_cli.evaluate.metrics import DECIBELS, DESCRIBES, TIME, Scale
from splatctrl_cli.evaluate.score_report import AVERAGING, SCALES, judged, mean_of
from splatctrl_cli.jobs.device import CPU, Device, demanded
from splatctrl_cli.jobs.open_recording import RecordingRequest, is_folder_of_views, open_to_train
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.reconstructions.gaussians import reconstruct_gaussians
from splatctrl_cli.jobs.reconstructions.reconstruct import ReconstructResult, reconstruct
from splatctrl_cli.jobs.reconstructions.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.scores.score import (
    ScoreRequest,
    ScoreResult,
    Scoring,
    chosen,
    folder_of,
    score_scene,
    write_result,
)
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.report.pictures import renders_picture

PROTOCOL = "dtu-holdout8"  # the paper names neither scans nor views


@dataclass(frozen=True, kw_only=True)
class Method:
    """Its name, the ending of its metrics, and the paper's figures on DTU: PSNR [dB] and Gaussians."""

    name: str
    key: str
    psnr: float
    splats: str


METHODS = {
    "3dgs": Method(name="3D-GS", key="3dgs", psnr=23.27, splats="50,000-100,000"),
    "budget": Method(name="ours", key="ours", psnr=23.33, splats="10,000"),
}
EACH = {
    name: SCALES[name]
    for name in (
        *("psnr_seen", "psnr_all", "psnr_masked", "ssim_seen", "ssim_all", "ssim_published"),
        *("depth_median_seen", "depth_median_all", "chamfer"),
    )
}
OWN = {"psnr": DECIBELS, "splats": DESCRIBES, "memory": Scale(unit="MiB"), "seconds": TIME}
GATED = {
    "psnr_gain": DECIBELS,
    **{f"{what}_{method.key}": scale for method in METHODS.values() for what, scale in (OWN | EACH).items()},
    **{name: SCALES[name] for name in ("num_scans", "num_warnings")},
}


@dataclass(frozen=True, kw_only=True)
class FitRequest(Scoring):
    """Fit the scans of a data set (`recording.scan`: names joined by commas; None: all), or an image folder.

    config: a TOML file; settings: ``SECTION.KEY=VALUE``. iterations: of each method (None: those of the
    configuration); num_splats: the budget, and Gaussians to begin with. device: of our method, as of --device; the
    baseline computes on the processor. require: gates on the metrics of both.
    """

    config: Path | None = None
    settings: tuple[str, ...] = ()
    seed: int = 0
    device: str = CPU
    iterations: int | None = None
    num_splats: int = COMPARED_SPLATS


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """One method on one scan: its scene, the peak memory [MiB] of this process during the fit (None where the system
    does not tell), and the score of its views.
    """

    scan: str
    method: str
    scene: ReconstructResult
    memory: float | None
    score: ScoreResult

    def as_dict(self) -> dict[str, Any]:
        """Plain values; psnr [dB] by the protocol: over the mask where there is one."""
        metrics = self.score.report["metrics"]
        return {
            "scan": self.scan,
            "method": self.method,
            "splats": int(self.scene.metrics["splats"]),
            "iterations": int(self.scene.metrics["iterations"]),
            "devices": self.scene.metrics.get("devices", [Device().as_dict()]),
            "memory": self.memory,
            "seconds": round(self.scene.seconds["fit"], 4),
            "psnr": metrics["psnr_masked"] if "psnr_masked" in metrics else metrics["psnr_all"],
            "metrics": metrics,
        }


def score_fits(request: FitRequest, progress: Progress = SILENT) -> ScoreResult:
    """Fit both methods to each scan, and score them alike.

    Raises InputError where a reconstruction does not end well, other SplatCtrlError for what cannot be scored.
    """
    request = _checked(request)
    scans = _scans(request.recording)
    if request.cloud is not None:
        for scan in scans:
            request.cloud.of_scan(scan)
    fits: list[Fitted] = []
    with folder_of(request) or tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for scan in scans:
            scoring = _scoring(request, scan)
            made = {}
            for method, about in METHODS.items():
                progress.log(f"{scan}: fits {about.name}, {request.iterations} iterations")
                made[method] = _reconstruct(request, scoring, method, folder / scan / method / "scene", progress)
            # scored after both were fitted: what scoring leaves in memory then counts for neither
            for method, (scene, memory) in made.items():
                kept = None if request.out is None else folder / scan / method / "score"
                score = score_scene(replace(scoring, scene=scene.out), kept, progress)
                fits.append(Fitted(scan=scan, method=method, scene=scene, memory=memory, score=score))
            if request.out is not None and request.images != "none":
                _draw(folder / scan / "methods.png", fits[-len(METHODS) :])
        report = _report(request, fits)
        num_views = min(fit.score.report["metrics"]["num_views"] for fit in fits)
        verdict = judged(
            dict.fromkeys(GATED, None) | report["metrics"],
            report["warnings"],
            request.require,
            num_views=num_views,
            counts=dict.fromkeys(GATED, int(num_views)),
            scope=f"{len(fits)} fits of {', '.join(report['scans'])}",
        )
        result = ScoreResult(report=report, verdict=verdict, out=request.out)
        if request.out is not None:
            config = load_config(request.config, request.settings).as_dict()
            write_result(folder, result, config=config, seed=request.seed)
    return result


def _checked(request: FitRequest) -> FitRequest:
    """The request with its defaults. Raises for what is better refused now than after the fits."""
    recording, holdout = request.recording, request.recording.options.holdout
    if recording.is_dtu and holdout:
        raise UsageError("--fit: needs a protocol", remedy=f"give --protocol holdout:{','.join(holdout)}")
    if not recording.is_dtu and not is_folder_of_views(recording.path):
        raise UsageError(
            f"--fit: expected scans (--dtu) or an image folder, got {recording.path}",
            remedy="the baseline fits views of a scene that stands still",
        )
    scene = load_config(request.config, request.settings).scene
    check_gate_names(request.require, GATED)
    demanded(request.device)
    if recording.is_dtu:
        recording = replace(recording, protocol=recording.protocol or PROTOCOL)
    iterations = request.iterations
    if iterations is None:
        iterations = scene.first_iterations + scene.refine_iterations
    if iterations < 1:
        raise UsageError(f"--fit-iterations: expected at least 1, got {iterations}")
    return replace(request, recording=recording, iterations=iterations)


def known_scans(root: Path) -> list[str]:
    """The names of the scans in a DTU tree, in MVSNet's layout or in IDR's."""
    found = idr_scans(root) if not (root / "Rectified").is_dir() else {}
    return list(found or scan_folders(root))


def _scans(recording: RecordingRequest) -> list[str]:
    root = recording.path
    if not recording.is_dtu:
        return [root.stem]
    known = known_scans(root)
    wanted = chosen(known, recording.scan, root, "scan")
    if not wanted:
        raise InputError(f"{root}: no scan", remedy=f"scans: {', '.join(known) or 'none is there'}")
    return wanted


def _scoring(request: FitRequest, scan: str) -> ScoreRequest:
    """How the scenes of one scan are scored; the gates are on both fits together."""
    recording = request.recording
    if recording.is_dtu:
        masks = recording.masks
        if masks is not None and (masks / scan).is_dir():
            masks = masks / scan
        recording = replace(recording, scan=scan, masks=masks)
    same = {field.name: getattr(request, field.name) for field in fields(Scoring)}
    return ScoreRequest(scene=Path(), **{**same, "recording": recording, "require": ()})


def _reconstruct(
    request: FitRequest, scoring: ScoreRequest, method: str, out: Path, progress: Progress
) -> tuple[ReconstructResult, float | None]:
    """The scene of one method, and the peak memory [MiB] of this process during the fit, None where the system does
    not tell. Raises InputError with what it says where it does not end well.
    """
    options = scoring.recording.options
    options = SourceOptions(root=options.root, holdout=options.holdout, depth_scale=options.depth_scale)
    scan, run = out.parent.parent.name, reconstruct_gaussians if method == "3dgs" else reconstruct
    out.parent.mkdir(parents=True)
    has_peak = _forget_peak_memory()
    try:
        source = open_to_train(replace(scoring.recording, options=options, masks=None))
        config, seed, threads = _config(request), request.seed, request.threads
        device = CPU if method == "3dgs" else request.device
        made = run(
            ReconstructRequest(source=source, out=out, config=config, seed=seed, threads=threads, device=device),
            progress,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt from None  # its message would name --resume, which score does not have
    except SplatCtrlError as error:
        raise InputError(f"{scan}: reconstruct ended with {error.exit_code}: {error}") from error
    if made.verdict.exit_code:
        raise InputError(f"{scan}: reconstruct ended with {made.verdict.exit_code}: {made.verdict.sentence}")
    return made, _peak_memory() if has_peak else None


def _forget_peak_memory() -> bool:
    """Let the peak memory of this process begin anew; False where the system does not do that."""
    gc.collect()
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _peak_memory() -> float:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def _config(request: FitRequest) -> Config:
    """That of both methods: what the request sets outranks its iterations, but not its splats."""
    iterations = request.iterations or 0
    first = min(COMPARED_FIRST, iterations)
    settings = (
        *(f"gaussians.iterations={iterations}", f"scene.first_iterations={first}"),
        f"scene.refine_iterations={iterations - first}",
    )
    config = load_config(request.config, [*settings, *request.settings])
    return replace(config, scene=replace(config.scene, max_splats=request.num_splats))


def _draw(path: Path, fits: Sequence[Fitted]) -> None:
    """The first view that was scored, as photographed and as rendered from the scene of each of `fits`."""
    views = [fit.score.first_view for fit in fits if fit.score.first_view is not None]
    renders = {}
    for fit, view in zip(fits, views, strict=True):
        color = np.clip(view.render, 0.0, 1.0)
        figures = f"{psnr(color, view.photo / 255.0):.1f} dB all, {fit.scene.metrics['splats']:,} splats"
        renders[f"{METHODS[fit.method].name}   {figures}"] = color
    renders_picture(path, views[0].title, views[0].photo, renders)


def _report(request: FitRequest, fits: Sequence[Fitted]) -> dict[str, Any]:
    metrics: dict[str, float | None] = {}
    for name, method in METHODS.items():
        rows = [fit.as_dict() for fit in fits if fit.method == name]
        means = {what: mean_of([row[what] for row in rows]) for what in OWN}
        means["memory"] = None if means["memory"] is None else max(row["memory"] for row in rows)
        each = [row["metrics"] for row in rows]
        means |= {what: mean_of([one[what] for one in each]) for what in EACH if what in each[0]}
        metrics |= {f"{what}_{method.key}": value for what, value in means.items()}
    ours, theirs = metrics["psnr_ours"], metrics["psnr_3dgs"]
    metrics["psnr_gain"] = None if ours is None or theirs is None else ours - theirs
    first = fits[0].score.report["protocol"]
    scans = list(dict.fromkeys(fit.scan for fit in fits))
    warnings = [
        f"{fit.scan}, {METHODS[fit.method].name}: {line}" for fit in fits for line in fit.score.report["warnings"]
    ]
    metrics |= {"num_scans": len(scans), "num_warnings": len(warnings)}
    return {
        "source": str(request.recording.path),
        "scans": scans,
        "protocol": first | {"averaging": AVERAGING + (" of a scan, then over the scans" if len(scans) > 1 else "")},
        "psnr": "over every pixel" if first["mask_rule"] == "none" else "over the mask",
        "settings": {
            "splats": request.num_splats,
            "iterations": request.iterations,
            "seed": request.seed,
            "losses": "identical: scene.lambda_* of the configuration",
        },
        "paper": {method.name: {"psnr": method.psnr, "splats": method.splats} for method in METHODS.values()},
        "metrics": metrics,
        "warnings": warnings,
        "fits": [fit.as_dict() for fit in fits],
    }
