"""Report and verdict of a baked field, and its errors against references."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import COMPARED_CELLS, FAR_GRID
from splatctrl_cli.errors import NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.evaluate.field_accuracy import (
    compare_with_mesh,
    compare_with_truth,
    figures_of,
    median_radius,
)
from splatctrl_cli.evaluate.held_out_depth import compare_with_held_out_depth, counted_pixels
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, FAULTS, LENGTH
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, gate_reasons, note, verdict_of
from splatctrl_cli.field.baker import Changes
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import KERNEL_OF, probabilities
from splatctrl_cli.field.grid_cells import LOSS, exact_channel
from splatctrl_cli.jobs.bake.request import BakeRequest, BakeSource
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import DistanceGrid, JointState, RecordSource, RgbdFrame
from splatctrl_cli.report.field_pictures import Reliability
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.truth import load_truth

SUMMARY_METRICS = {
    **dict.fromkeys(("num_splats", "num_splats_left_out", "num_cells"), DESCRIBES),
    **dict.fromkeys(("voxel", "length_scale", "median_radius", "median_spacing"), LENGTH),
    **dict.fromkeys(("never_seen_share", "over_estimating_share"), BAD_SHARE),
    "num_warnings": FAULTS,
}  # comparison scales of the summary's figures


def accuracy_of(
    grid: DistanceGrid, spheres: Spheres, source: BakeSource, request: BakeRequest
) -> tuple[dict[str, dict[str, Any]], dict[str, Reliability]]:
    """Errors of a field by requested reference, as in ``field.json``, and reliability against the truth.

    Raises NotEvaluableError if field and reference do not overlap.
    """
    compared, curves = dict[str, dict[str, Any]](), dict[str, Reliability]()
    if request.truth is not None:
        compared["truth"], curves = _compare_with_truth(grid, spheres, source, request)
    if request.reference_mesh is not None:
        compared["reference_mesh"] = compare_with_mesh(grid, request.reference_mesh, seed=request.seed)
    if request.held_out is not None:
        compared["held_out_depth"] = _compare_with_held_out(grid, source, request.held_out, request)
    return compared, curves


def check_references(request: BakeRequest, source: BakeSource) -> None:
    """Raise for unusable references before a long bake."""
    for path in (request.truth, request.seen_by, request.reference_mesh):
        refuse_if(path is not None and not path.exists(), f"{path}: no such file or folder", remedy="check the path")
    if request.held_out is not None:
        _held_out_cameras(open_source(request.held_out), request, source.cameras)


def _compare_with_truth(
    grid: DistanceGrid, spheres: Spheres, source: BakeSource, request: BakeRequest
) -> tuple[dict[str, Any], dict[str, Reliability]]:
    assert request.truth is not None and request.seen_by is not None
    truth = load_truth(request.truth)
    stamp_ns = int(truth.stamps[-1]) if source.stamp_ns is None else source.stamp_ns
    shape = grid.channels["sdf"].shape
    num_cells = int(np.prod(shape))
    drawn = np.sort(
        np.random.default_rng(request.seed).choice(num_cells, min(num_cells, COMPARED_CELLS), replace=False)
    )
    points = grid.origin + grid.voxel * np.stack(np.unravel_index(drawn, shape), axis=1)
    chunks = np.array_split(points, -(-len(points) // 50_000))  # else large (points x primitives) arrays
    distances, surfaces = zip(*(truth.closest(chunk, stamp_ns) for chunk in chunks), strict=True)
    channels: dict[str, NDArray[np.generic]] = {
        name: grid.channels[name].reshape(-1)[drawn].astype(np.float32)
        for name in ("sdf", "hard", "bound")
        if name in grid.channels
    }
    exact = exact_channel(DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=channels, header=grid.header))
    forms = probabilities(spheres, request.config.field, threads=request.threads)
    return compare_with_truth(
        points,
        {"hard": exact.astype(np.float64), "sdf": channels["sdf"].astype(np.float64)},
        np.concatenate(distances),
        np.concatenate(surfaces),
        _frames(request.seen_by, source.cameras, stamp_ns),
        name=str(request.truth),
        workspace=source.workspace,
        median_radius=median_radius(grid),
        probabilities={name: form.at for name, form in forms.items()},
    )


def _frames(log: Path, cameras: Sequence[str] | None, until_ns: int) -> Iterator[RgbdFrame]:
    for record in open_source(log).records():
        if record.stamp_ns > until_ns:
            return
        if isinstance(record, RgbdFrame) and (cameras is None or record.camera in cameras):
            yield record


def _compare_with_held_out(grid: DistanceGrid, source: BakeSource, log: Path, request: BakeRequest) -> dict[str, Any]:
    recording = open_source(log)
    cameras = _held_out_cameras(recording, request, source.cameras)
    newest: dict[str, tuple[RgbdFrame, JointState | None]] = {}
    state: JointState | None = None
    for record in recording.records():
        if source.stamp_ns is not None and record.stamp_ns > source.stamp_ns:
            break
        if isinstance(record, JointState):
            state = record
        elif record.camera in cameras:
            newest[record.camera] = record, state
    refuse_if(
        not newest, f"{log}: no frame of {', '.join(cameras)} up to the time of the scene", error=NotEvaluableError
    )
    urdf, names = request.urdf, recording.joint_names
    robot = None if urdf is None else RobotModel.from_urdf(urdf, request.spheres).moved_by(names, recording.tf_frames)
    spheres = [
        None
        if robot is None or at is None
        else (robot.sphere_centers(robot.positions_of(names, at.position)), robot.sphere_set.radii)
        for _, at in newest.values()
    ]
    counted = [
        counted_pixels(frame, source.workspace, its) for (frame, _), its in zip(newest.values(), spheres, strict=True)
    ]
    return compare_with_held_out_depth(
        grid, [frame for frame, _ in newest.values()], seed=request.seed, counted=counted
    )


def _held_out_cameras(
    recording: RecordSource, request: BakeRequest, trained: Sequence[str] | None
) -> tuple[str, ...]:
    log, names, known = request.held_out, request.held_out_cameras, recording.cameras
    if wrong := [name for name in names if name not in known]:
        raise UsageError(f"--held-out: {log} has no camera {wrong[0]}", remedy=f"it has: {', '.join(known)}")
    if also := [name for name in names if trained is not None and name in trained]:
        raise UsageError(f"--held-out: camera {also[0]} trained the scene", remedy="name one that did not")
    chosen = names or tuple(name for name in known if trained is None or name not in trained)
    refuse_if(
        not chosen,
        f"--held-out: every camera of {log} trained the scene",
        remedy="give another log",
        error=UsageError,
    )
    return chosen


def field_document(grid: DistanceGrid, statistics: Mapping[str, Any], changes: Changes | None) -> dict[str, Any]:
    """Content of ``field.json`` without accuracy: header and place first, an update's changes last."""
    header: Mapping[str, Any] = grid.header
    warnings, lowest, update = tuple(header["health"]["warnings"]), statistics["lowest"], {}
    if lowest is not None and lowest > FAR_GRID:
        far = f"the box holds no splat: the nearest is {lowest:.3g} m from every cell; check --box"
        warnings = (*warnings, far)
    if changes is not None:
        why = {"why_all": changes.reason} if changes.reason else {}
        update = {"update": {"blocks_baked": changes.num_baked, "blocks": changes.num_blocks, **why}}
    return {
        **header,
        "shape": grid.channels["sdf"].shape,
        "first_cell": grid.origin,
        "voxel": grid.voxel,
        "channels": list(grid.channels),
        "statistics": statistics,
        "warnings": warnings,
        **update,
    }


def summary_of(document: Mapping[str, Any]) -> dict[str, Any]:
    """Printed figures of ``field.json``, without accuracy."""
    num_used, statistics = sum(document["splats_used"].values()), document["statistics"]
    # cells where the kernel field of sdf, alone, exceeds the exact distance
    over = document["kernel_counts"].get(f"{KERNEL_OF[document['distance']]}_over_estimates")
    summary = {
        "num_splats": num_used,
        "num_splats_left_out": sum(document["splats_given"].values()) - num_used,
        "shape": list(document["shape"]),
        "num_cells": statistics["num_cells"],
        "voxel": document["voxel"],
        "distance": document["distance"],
        "length_scale": document["length_scale"],
        "median_radius": document["health"]["radius"],
        "median_spacing": document["health"]["spacing"],
        "never_seen_share": statistics["never_seen_share"],
        "over_estimating_share": None if over is None else over / statistics["num_cells"],
        "num_warnings": len(document["warnings"]),
    }
    if "update" in document:
        summary["blocks_baked"] = "{blocks_baked} of {blocks}".format(**document["update"])
    return summary


def metrics_of(summary: Mapping[str, Any], accuracy: Mapping[str, Mapping[str, Any]]) -> dict[str, float | None]:
    """Figures a gate can name: the summary's, and the truth's, like ``seen.hard.0_2cm.rmse``, ``over_estimate.*``."""
    of_truth = figures_of(accuracy["truth"]) if "truth" in accuracy else {}
    return {name: summary[name] for name in SUMMARY_METRICS} | of_truth


def counts_of(metrics: Mapping[str, float | None]) -> dict[str, int]:
    of_bands = {name: f"{name.rpartition('.')[0]}.count" for name in metrics if not name.endswith(".count")}
    counted = {name: of_bands[name] if of_bands.get(name) in metrics else "num_cells" for name in metrics}
    return {name: int(metrics[count] or 0) for name, count in counted.items()}


def bake_verdict(
    request: BakeRequest, document: Mapping[str, Any], metrics: Mapping[str, float | None], *, has_occupancy: bool
) -> Verdict:
    """Judge the channels' loss of distance [m], unobserved boxes, and each ``--require``."""
    statistics, voxel = document["statistics"], document["voxel"]
    num_cells, loss = statistics["num_cells"], LOSS * voxel
    of_loss = Reason(
        criterion="loss",
        outcome=Outcome.PASSED,
        sentence=f"cells read at most {1e3 * loss:.1f} mm too little of the distance to the splats",
        value=loss,
        threshold=request.config.field.max_loss,
        unit="m",
        count=num_cells,
    )
    never_seen = Reason(
        criterion="known space",
        outcome=Outcome.NOT_EVALUABLE,
        sentence="no cell of the grid was ever seen by a camera",
        value=1.0,
        threshold=1.0,
        remedy="give a --box that the cameras saw",
        count=num_cells,
    )
    counts = counts_of(metrics)
    return verdict_of(
        "sdf-bake",
        [
            of_loss,
            *([never_seen] if has_occupancy and statistics["never_seen_share"] == 1 else []),
            *(note(criterion="field", sentence=text) for text in document["warnings"]),
            *gate_reasons(request.require, metrics, counts),
        ],
        scope=f"{' x '.join(map(str, document['shape']))} cells of {voxel:g} m, {metrics['num_splats']} splats",
        counts=counts,
    )
