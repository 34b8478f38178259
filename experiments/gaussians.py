"""3D Gaussian splatting on views of a scene that stands still, into a folder that ``splatctrl score`` reads."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments.densify import GaussianSettings
from experiments.gaussian_fitter import GaussianAuditRow, GaussianFitter
from splatctrl_cli import (
    InputError,
    JudgedResult,
    Outcome,
    Progress,
    Reason,
    ReconstructRequest,
    UsageError,
)
from splatctrl_cli.blocks import (
    SILENT,
    RecordedDepth,
    RgbdFrame,
    Stopwatch,
    depth_box,
    fitted_to,
    output_path,
    verdict_of,
    write_gaussian_ply,
    write_run,
)


def reconstruct_gaussians(
    request: ReconstructRequest, settings: GaussianSettings | None = None, progress: Progress = SILENT
) -> JudgedResult:
    """Fit, and write the scene folder. Uses source, out, force, config, box, seed and threads of the request.

    Raises UsageError for a recording with a clock.
    """
    settings = settings or GaussianSettings()
    source, stopwatch = request.source, Stopwatch()
    if source.has_clock:
        raise UsageError(f"{source.name}: has a clock; 3D Gaussian splatting takes scenes that do not change")
    with output_path(request.out, force=request.force, is_folder=True) as partial:
        with stopwatch.stage("read"):
            frames = [r for r in source.records() if isinstance(r, RgbdFrame) and r.camera != "holdout"]
            depth = RecordedDepth.of(frames)
            if depth is None:
                raise InputError(f"{source.name}: no frame to train on has depth")
            config = fitted_to(request.config, depth)
            limit, scale = config.occupancy.max_range, config.scene.scale or 1.0
            workspace = request.box or depth_box(frames, limit, scale)
        with stopwatch.stage("fit"):
            fitter = GaussianFitter(
                config, workspace, frames, settings=settings, seed=request.seed, threads=request.threads
            )
            progress.log(f"{len(fitter.arrays)} Gaussians seeded, extent of the scene {fitter.extent:.3f} m")
            rows: list[GaussianAuditRow] = []
            fitter.fit(_auditor(partial / "audit.jsonl", rows, progress))
        with stopwatch.stage("write"):
            write_gaussian_ply(partial / "splats.ply", fitter.gaussians(), {"source": source.name})
        metrics = {
            **_views(frames),
            **_figures(rows),
            "background": list(fitter.background),
            "workspace": [*workspace.lower.tolist(), *workspace.upper.tolist()],
        }
        num = rows[-1].gaussians
        fitted = Reason(
            criterion="map",
            outcome=Outcome.PASSED if num else Outcome.NOT_EVALUABLE,
            sentence=f"{num} Gaussians",
        )
        scope, is_damaged = f"{len(frames)} views, {num} Gaussians", bool(source.loss.damaged)
        verdict = verdict_of("reconstruct", [fitted], scope=scope, is_damaged=is_damaged)
        write_run(
            partial,
            command="reconstruct",
            config={**config.as_dict(), "gaussians": asdict(settings)},
            inputs=source.digests(),
            metrics=metrics,
            stopwatch=stopwatch,
            seed=request.seed,
            verdict=verdict.as_dict(),
        )
    return JudgedResult(out=request.out, metrics=metrics, verdict=verdict, seconds=stopwatch.seconds)


def _auditor(path: Path, rows: list[GaussianAuditRow], progress: Progress) -> Callable[[GaussianAuditRow], None]:
    """Keeps each row in `rows` and `path`, and says how far it is."""

    def audit(row: GaussianAuditRow) -> None:
        rows.append(row)
        with path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(asdict(row)) + "\n")
        quality = "nothing of the workspace in view" if row.psnr is None else f"{row.psnr:.1f} dB"
        full = f", {row.unmet} more had no room" if row.unmet else ""
        progress.log(f"{row.iteration} iterations, {row.gaussians} Gaussians, {quality}{full}")

    return audit


def _views(frames: Sequence[RgbdFrame]) -> dict[str, object]:
    """Return the views' entry of ``run.json``."""
    return {
        "method": "3dgs",
        "cameras": list(dict.fromkeys(frame.camera for frame in frames)),
        "has_clock": False,
        "stamp_ns": max(frame.stamp_ns for frame in frames),
        "training_stamps_ns": [frame.stamp_ns for frame in frames],
    }


def _figures(rows: Sequence[GaussianAuditRow]) -> dict[str, Any]:
    last = rows[-1]
    return {
        "iterations": last.iteration,
        "splats": last.gaussians,
        "degree": last.degree,
        "cloned": sum(row.cloned for row in rows),
        "split": sum(row.split for row in rows),
        "pruned": sum(sum(row.pruned.values()) for row in rows),
        "unmet": sum(row.unmet for row in rows),
        "loss": last.loss,
        "psnr": last.psnr,
    }
