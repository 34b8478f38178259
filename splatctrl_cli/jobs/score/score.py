"""Score of scenes against held-out views of one or several scans."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.evaluate.score import (
    AVERAGING,
    NAMES,
    NAMES_WITH_CHANGES,
    PREFIX,
    PROTOCOL,
    as_json,
    changes,
    free_mass,
    read_baseline,
    report_of_scans,
    score_verdict,
    total_score,
)
from splatctrl_cli.evaluate.verdict import JudgedResult, check_gate_names
from splatctrl_cli.field.clusters import field_splats, obstacle_spheres
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_json, write_run, write_table
from splatctrl_cli.formats.scene.scene_folder import SceneFolder, open_splats, run_value
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.score.reference import (
    cameras_to_score,
    check_times,
    check_training,
    open_reference,
    recording_check,
)
from splatctrl_cli.jobs.score.views import CloudSettings, Scorer, cloud_figures
from splatctrl_cli.records import Label
from splatctrl_cli.report.pictures import comparison_picture, view_picture


@dataclass(frozen=True, kw_only=True)
class ScoreRequest:
    """Scene, or a folder of scenes named like scans, to score on views.

    recording: the cameras in its options are scored. baseline: score.json of an earlier score. newest: render the
    newest snapshot up to a view, else the final splats. images: ``all`` views, each camera's ``best-worst``, or
    ``none``. Raises UsageError for ``all`` without `out`.
    """

    scene: Path
    recording: RecordingRequest
    baseline: Path | None = None
    out: Path | None = None
    force: bool = False
    newest: bool = True
    images: str = "best-worst"
    cloud: CloudSettings | None = None
    allow_training: bool = False
    allow_other_recording: bool = False
    require: tuple[str, ...] = ()
    threads: int = 0

    def __post_init__(self) -> None:
        refuse_if(
            self.images == "all" and self.out is None,
            "--images all: expected a folder for them",
            remedy="give -o",
            error=UsageError,
        )


def score(request: ScoreRequest, progress: Progress = SILENT) -> JudgedResult:
    """Score a scene, or scenes of several scans and their mean. Raises SplatCtrlError.

    Document: ``score.json``.
    """
    if request.baseline is not None:
        read_baseline(request.baseline)  # refuse a bad baseline before the views are scored
    names = NAMES if request.baseline is None else NAMES_WITH_CHANGES
    check_gate_names(request.require, names, {"--baseline": NAMES_WITH_CHANGES})
    scenes = _scenes_of_scans(request)
    with output_path(request.out, force=request.force, is_folder=True) if request.out else nullcontext() as folder:
        return _score_scans(request, scenes, folder, progress) if scenes else _score_scene(request, folder, progress)


def _score_scene(request: ScoreRequest, folder: Path | None, progress: Progress) -> JudgedResult:
    stopwatch, surface = Stopwatch(), dict[str, float]()
    if folder:
        folder.mkdir(exist_ok=True)
    scorer = _open_scorer(request, folder, progress)
    scene, reference = scorer.scene, scorer.reference
    cloud = None if request.cloud is None else request.cloud.select_scan(reference.scan)
    digests = reference.source.digests()
    same = recording_check(request.scene, scene, reference, digests, allow_other=request.allow_other_recording)
    scorer.run(progress, stopwatch)
    if cloud is not None:
        with stopwatch.stage("cloud"):
            surface = cloud_figures(cloud, scene, scorer.training, request.threads)
    protocol = _protocol(scorer)
    definitions = PROTOCOL | ({} if cloud is None else {"cloud": cloud.words()})
    metrics = (
        total_score(scorer.figures)
        | surface
        | {
            "free_mass": _free_mass(request.scene, scene),
            "num_skipped": len(scorer.skipped),
            "num_warnings": len(scorer.doubts) + len(same["differences"]),
        }
    )
    report = _report(request, scorer, same, protocol | {"definitions": definitions}, as_json(metrics))
    result = _conclude(request, report, is_damaged=bool(reference.source.loss.damaged))
    if folder:
        write_table(folder / "views.csv", list(report["views"][0]), report["views"])
        with stopwatch.stage("pictures"):
            for (_, best), (_, worst) in scorer.extremes.values() if request.images != "none" else ():
                comparison = [best] if worst.title == best.title else [best, worst]
                comparison_picture(folder / f"{best.title.rsplit('-', 1)[0]}_best_worst.png", comparison)
        splats = request.scene if request.scene.is_file() else request.scene / "splats.ply"
        _write_result(
            folder,
            result,
            config={"cameras": report["cameras"], "snapshots": report["snapshots"], "protocol": protocol},
            inputs={**digests, f"scene/{splats.name}": sha256(splats)},
            stopwatch=stopwatch,
        )
    return result


def _open_scorer(request: ScoreRequest, folder: Path | None, progress: Progress) -> Scorer:
    scene = open_splats(request.scene)
    if scene.is_anisotropic:
        scene.gaussians()  # both raise if there is no splat to compare
    else:
        field_splats(scene.splats())
    reference = open_reference(request.recording, progress)
    refuse_if(
        request.cloud is not None and not scene.names_its_views,
        f"--cloud: the surface is looked at from the views that trained, which {request.scene} does not name",
        remedy="leave it out, or give a folder that reconstruct wrote",
        error=UsageError,
    )
    wanted = request.recording.options.cameras
    scorer = Scorer(
        scene=scene,
        reference=reference,
        cameras=cameras_to_score(wanted, reference, scene.cameras, allow_training=request.allow_training),
        newest=request.newest,
        allow_training=request.allow_training,
        threads=request.threads,
    )
    check_times(reference, scorer.cameras, scene.cameras)
    check_training(request.scene, scene, reference)
    if folder and request.images == "all":
        (folder / "views").mkdir(parents=True, exist_ok=True)
        scorer.draw = lambda row: view_picture(folder / "views" / f"{row.title}.png", row)
    return scorer


def _report(
    request: ScoreRequest,
    scorer: Scorer,
    recording: dict[str, Any],
    protocol: dict[str, Any],
    metrics: dict[str, Any],
) -> dict[str, Any]:
    other = [f"another recording: {line}" for line in recording["differences"]]
    return {
        "scene": str(request.scene),
        "reference": str(scorer.reference.where),
        "cameras": list(scorer.cameras),
        "training_cameras": list(scorer.scene.cameras),
        "has_clock": scorer.has_clock,
        "snapshots": "newest" if scorer.has_clock and request.newest else "final",
        "recording": recording,
        "protocol": protocol,
        "metrics": metrics,
        "warnings": [*other, *scorer.doubts],
        "skipped_views": scorer.skipped,
        "views": [view | as_json(figures) for view, figures in zip(scorer.views, scorer.figures, strict=True)],
    }


def _protocol(scorer: Scorer) -> dict[str, Any]:
    """Facts a figure must be published with to be comparable."""
    reference = scorer.reference
    named, split = reference.protocol, reference.split
    return {
        "name": "none" if named is None else named.name,
        "source": "none" if named is None else named.source,
        "layout": reference.layout,
        "training_views": None if split is None else list(split.training),
        "scored_views": None if split is None else list(split.scored),
        "left_out_views": None if split is None else list(split.left_out),
        "split": "by camera" if split is None else split.words(),
        "mask_rule": reference.mask_rule,
        "resolution": [f"{width}x{height}" for width, height in sorted(scorer.sizes)],
        "published_resolution": None if named is None or named.size is None else "{}x{}".format(*named.size),
        "published_scans": None if named is None or not named.scans else list(named.scans),
        "background": [round(value, 4) for value in scorer.scene.background],
        "averaging": AVERAGING,
    }


def _free_mass(path: Path, scene: SceneFolder) -> float:
    if not (path / "occupancy.npz").is_file():
        return nan
    where = str(path / "run.json")
    free_below = run_value(scene.run, ("config", "occupancy", "free_below"), float, where=where)
    spheres = obstacle_spheres(scene.splats(), scene.unrepresented_at(None), frozenset(Label))
    return free_mass(spheres.splats, scene.occupancy(), free_below)


def _conclude(request: ScoreRequest, report: dict[str, Any], *, is_damaged: bool) -> JudgedResult:
    if request.baseline is not None:
        report["metrics"] |= changes(report, request.baseline)
    return JudgedResult(
        out=request.out,
        metrics=dict(report["metrics"]),
        document=report,
        notes=tuple(report["warnings"]),
        verdict=score_verdict(report, request.require, is_damaged=is_damaged),
    )


def _write_result(
    folder: Path,
    result: JudgedResult,
    *,
    config: Mapping[str, Any],
    inputs: Mapping[str, str] | None = None,
    stopwatch: Stopwatch | None = None,
) -> None:
    write_json(folder / "score.json", result.document)
    write_run(
        folder,
        command="score",
        config=config,
        inputs=inputs or {},
        metrics=result.metrics,
        stopwatch=stopwatch or Stopwatch(),
        verdict=result.verdict.as_dict(),
    )


def _scenes_of_scans(request: ScoreRequest) -> dict[str, Path]:
    folder, recording = request.scene, request.recording
    if not recording.is_dtu or not folder.is_dir() or (folder / "splats.ply").is_file():
        return {}
    scenes = {path.name: path for path in sorted(folder.iterdir()) if (path / "splats.ply").is_file()}
    if not scenes or recording.scan is None:
        return scenes
    wanted = [name.strip() for name in recording.scan.split(",") if name.strip()]
    if unknown := [name for name in wanted if name not in scenes]:
        raise InputError(f"{folder}: no scene {unknown[0]!r}", remedy=f"scenes: {', '.join(scenes)}")
    return {name: scenes[name] for name in wanted}


def _score_scans(
    request: ScoreRequest, scenes: Mapping[str, Path], folder: Path | None, progress: Progress
) -> JudgedResult:
    results: dict[str, JudgedResult] = {}
    for scan, scene in scenes.items():
        progress.log(f"{scan}: scores {scene}")
        # gates and baseline apply only to the means
        alone = replace(
            request, scene=scene, recording=select_scan(request.recording, scan), require=(), baseline=None
        )
        results[scan] = _score_scene(alone, folder and folder / scan, progress)
    report = {
        "scenes": str(request.scene),
        "reference": str(request.recording.path),
        **report_of_scans({scan: result.document for scan, result in results.items()}),
    }
    result = _conclude(request, report, is_damaged=any(one.verdict.is_damaged for one in results.values()))
    if folder is not None:
        names = [name for name in result.metrics if name != "num_scans" and not name.startswith(PREFIX)]
        rows = ({"scan": scan, **{n: one.metrics.get(n) for n in names}} for scan, one in results.items())
        write_table(folder / "scans.csv", ["scan", *names], rows)
        _write_result(folder, result, config={"scans": report["scans"]})
    return result


def select_scan(recording: RecordingRequest, scan: str) -> RecordingRequest:
    """Recording of one scan with its masks in DIR/SCAN.

    Raises InputError without that folder: masks of one scan fit no other.
    """
    masks = None if recording.masks is None else recording.masks / scan
    refuse_if(
        masks is not None and not masks.is_dir(),
        f"{recording.masks}: expected a folder {scan} with this scan's masks, got none",
    )
    return replace(recording, scan=scan, masks=masks)
