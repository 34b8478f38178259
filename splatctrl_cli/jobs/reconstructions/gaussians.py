"""3D Gaussian splatting on views of a scene that stands still: the baseline beside `reconstruct`."""

import functools
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.gates import check_gate_names, gate_reasons
from splatctrl_cli.evaluate.metrics import DESCRIBES
from splatctrl_cli.evaluate.same_recording import first_frame
from splatctrl_cli.evaluate.verdict import verdict_of
from splatctrl_cli.files.output import Stopwatch, output_path
from splatctrl_cli.jobs.device import CUDA
from splatctrl_cli.jobs.progress import SILENT, Progress, Wait
from splatctrl_cli.jobs.reconstructions.reconstruct import ReconstructResult, written_run
from splatctrl_cli.jobs.reconstructions.reconstruction import ReconstructRequest, no_frame, training_cameras
from splatctrl_cli.jobs.reconstructions.verdict import GATED as SPLATS_GATED
from splatctrl_cli.jobs.reconstructions.verdict import loss_notes, map_reason
from splatctrl_cli.records import RecordSource, RgbdFrame
from splatctrl_cli.scene.gaussian_fitter import GaussianAuditRow, GaussianFitter
from splatctrl_cli.scene.scale import RecordedDepth, fitted_to
from splatctrl_cli.scene.time_steps import depth_box
from splatctrl_cli.scene_files.scene_folder import FORMAT
from splatctrl_cli.splat_files.gaussian_ply import write_gaussian_ply

GATED = {  # what --require can name, and how two runs are compared by it
    **dict.fromkeys(("iterations", "splats", "cloned", "split", "pruned"), DESCRIBES),
    **{name: SPLATS_GATED[name] for name in ("unmet", "loss", "psnr")},
}
ROUTES = "leave out --method, or give a folder of views (a TOML file or --dtu)"


def reconstruct_gaussians(request: ReconstructRequest, progress: Progress = SILENT) -> ReconstructResult:
    """Fit, and write the scene folder; nothing is `removed`.

    Raises UsageError for a recording with a clock, and for a request with a robot, points, or a run to go on with.
    """
    if request.device.startswith(CUDA):
        raise UsageError(
            f"--device {request.device}: --method 3dgs computes on the processor", remedy="give --device cpu"
        )
    source, config = request.source, request.config
    check_gate_names(request.require, GATED)
    _refuse_what_needs_time(request)
    stopwatch = Stopwatch()
    with output_path(request.out, force=request.force, is_folder=True) as partial:
        rows: list[GaussianAuditRow] = []
        with stopwatch.stage("read"):
            frames = _frames(source)
            recorded = frames
            frames, told = request.corrections.of(frames, source.name, progress)
            depth = RecordedDepth.of(frames)
            config = config if depth is None else fitted_to(config, depth)
            limit, scale = config.occupancy.max_range, config.scene.scale or 1.0
            workspace = depth_box(frames, limit, scale) if request.box is None else request.box
        with stopwatch.stage("fit"):
            fitter = GaussianFitter(config, workspace, frames, seed=request.seed, threads=request.threads)
            progress.log(f"{len(fitter.arrays)} Gaussians seeded, extent of the scene {fitter.extent:.3f} m")
            wait = Wait(progress, f"fits {len(frames)} views", "iterations", config.gaussians.iterations).announce()
            fitter.fit(functools.partial(_audit, partial / "audit.jsonl", rows, wait))
            if len(rows) == 1:
                progress.log(
                    f"warning: no Gaussian was added or removed: gaussians.iterations = {config.gaussians.iterations}"
                    f" end before a round of gaussians.densify_every = {config.gaussians.densify_every}"
                )
        with stopwatch.stage("write"):
            comments = {"format": FORMAT, "source": source.name}
            write_gaussian_ply(partial / "splats.ply", fitter.gaussians(), comments)
        figures = _figures(rows)
        metrics = (
            _views(recorded)
            | told
            | figures
            | {
                "background": list(fitter.background),
                "workspace": [*workspace.lower.tolist(), *workspace.upper.tolist()],
            }
        )
        counts = dict.fromkeys(GATED, len(frames))
        values = {name: None if figures[name] is None else float(figures[name]) for name in GATED}
        verdict = verdict_of(
            "reconstruct",
            [
                map_reason(rows[-1].gaussians),
                *loss_notes(source.loss),
                *gate_reasons(request.require, values, counts),
            ],
            scope=f"{len(frames)} views, {rows[-1].gaussians} Gaussians",
            is_damaged=bool(source.loss.damaged),
            counts=counts,
        )
        return written_run(partial, replace(request, config=config), source.digests(), metrics, verdict, stopwatch)


def _refuse_what_needs_time(request: ReconstructRequest) -> None:
    training_cameras(request.source)
    if request.source.has_clock:
        raise UsageError(
            f"--method 3dgs: {request.source.name} has a clock; this method takes scenes that do not change",
            remedy=ROUTES,
        )
    for name in ("urdf", "spheres", "points", "resume"):
        if getattr(request, name):
            raise UsageError(f"--{name}: does not apply to --method 3dgs", remedy="leave out one of them")


def _frames(source: RecordSource) -> list[RgbdFrame]:
    cameras = training_cameras(source)
    frames = [r for r in source.records() if isinstance(r, RgbdFrame) and r.camera in cameras]
    if not frames:
        raise no_frame(source, cameras)
    return frames


def _audit(path: Path, rows: list[GaussianAuditRow], wait: Wait, row: GaussianAuditRow) -> None:
    """Keep the row, write it to `path`, and say how far it is."""
    rows.append(row)
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(asdict(row)) + "\n")
    quality = "nothing of the workspace in view" if row.psnr is None else f"{row.psnr:.1f} dB"
    full = f", {row.unmet} more had no room (gaussians.max_gaussians)" if row.unmet else ""
    wait.at(row.iteration, f", {row.gaussians} Gaussians, {quality}{full}", is_told=True)


def _views(frames: list[RgbdFrame]) -> dict[str, object]:
    """What ``run.json`` says of the views."""
    first = {frame.camera: frame for frame in reversed(frames)}
    return {
        "method": "3dgs",
        "cameras": list(dict.fromkeys(frame.camera for frame in frames)),
        "has_clock": False,
        "stamp_ns": max(frame.stamp_ns for frame in frames),
        "training_stamps_ns": [frame.stamp_ns for frame in frames],
        "first_frames": [first_frame(frame).as_dict() for frame in first.values()],
    }


def _figures(rows: list[GaussianAuditRow]) -> dict[str, Any]:
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
