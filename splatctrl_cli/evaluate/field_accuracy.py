"""A baked field against the true distance, by distance band."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import BANDS, MAP_ALLOWANCE, PROBABILITY_NEAR
from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_if
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, ERROR, FAULTS, LENGTH, Scale
from splatctrl_cli.evaluate.views import seen_by
from splatctrl_cli.formats.mesh import load_mesh
from splatctrl_cli.records import Bool, Box, DistanceGrid, Float64, Index, RgbdFrame
from splatctrl_cli.report.field_pictures import Reliability, reliability
from splatctrl_cli.robot.link_meshes import MeshDistance


@dataclass(frozen=True, kw_only=True)
class BandAccuracy:
    """Errors, field less truth [m], in a distance band; positive is unsafe. None if empty."""

    lower: float
    upper: float
    count: int
    mean: float | None
    rmse: float | None
    median: float | None
    over_95: float | None
    over_max: float | None


MEDIAN = LENGTH  # errors have a sign: a mean or a median may move either way
BAND_SCALES = {
    "count": DESCRIBES,
    "mean": MEDIAN,
    "rmse": ERROR,
    "median": MEDIAN,
    "over_95": ERROR,
    "over_max": ERROR,
}
OVER_SCALES = {
    "allowance": LENGTH,
    "count": DESCRIBES,
    "count_beyond": FAULTS,
    "share_beyond": BAD_SHARE,
    "median_beyond": ERROR,
    "max_error": ERROR,
}


def figures_of(document: Mapping[str, Any]) -> dict[str, float | None]:
    """Numbers of a ``field.json`` document, by the names of `metric_scales`."""
    figures = {
        f"{where}.{name}.{band_name(band['lower'], band['upper'])}.{figure}": value
        for where in ("everywhere", "seen")
        for name, bands in document[where].items()
        for band in bands
        for figure, value in band.items()
        if figure not in {"lower", "upper"}
    }
    return figures | {f"over_estimate.{name}": value for name, value in document["over_estimate"].items()}


def metric_scales(field_names: Sequence[str]) -> dict[str, Scale]:
    """Scales of the numbers for comparing runs, by flat name: ``seen.hard.0_2cm.rmse``, ``over_estimate.count``."""
    bands = [band_name(lower, upper) for lower, upper in BANDS]
    places = [f"{where}.{name}.{band}" for where in ("everywhere", "seen") for name in field_names for band in bands]
    over = {f"over_estimate.{name}": scale for name, scale in OVER_SCALES.items()}
    return {f"{place}.{figure}": scale for place in places for figure, scale in BAND_SCALES.items()} | over


def band_name(lower: float, upper: float) -> str:
    """``0_2cm`` for a band of true distance [m]."""
    return f"{lower * 100:g}_{upper * 100:g}cm"


def field_accuracy(
    distances: Mapping[str, NDArray[np.floating]], truth: Float64, seen: Bool | None, *, median_radius: float
) -> dict[str, Any]:
    """Compare fields with the truth at points outside the objects, as in ``field.json``.

    everywhere, seen: each field's bands, at all and at seen points; seen is empty if unknown. over_estimate: share of
    seen points (all, if unknown) up to 20 cm where `hard` exceeds the truth by more than `allowance`, and the excess.
    allowance [m]: 1 cm + `median_radius`. holds: there are such points, and no excess.

    distances: name -> (Q,) [m], including `hard`. truth (Q,) [m]: >= 0 counts. seen (Q,): a training camera saw the
    nearest true surface point; None if unknown. Raises InputError for unequal lengths, or without `hard`.
    """
    refuse_if("hard" not in distances, f"distances: expected one named hard, got {', '.join(distances) or 'none'}")
    for name, values in {**distances, **({} if seen is None else {"seen": seen})}.items():
        refuse_if(
            values.shape != truth.shape,
            f"{name}: expected {truth.shape} values, as the truth has, got {values.shape}",
        )
    errors = {name: values.astype(np.float64) - truth for name, values in distances.items()}
    is_near = (truth >= BANDS[0][0]) & (truth < BANDS[-1][1])
    everyone = np.ones(truth.shape, dtype=np.bool_)
    counted = everyone if seen is None else seen
    over = _over_estimate(errors["hard"][is_near & counted], MAP_ALLOWANCE + median_radius)
    return {
        "everywhere": {name: _bands(error, truth, everyone) for name, error in errors.items()},
        "seen": {} if seen is None else {name: _bands(error, truth, seen) for name, error in errors.items()},
        "over_estimate": over,
        "holds": over["count"] > 0 and over["count_beyond"] == 0,
    }


GridDistance = tuple[NDArray[np.generic], float]
"""A distance channel (X, Y, Z) [m], and an offset [m] to add."""


def distance_at(distance: GridDistance, cells: NDArray[np.int64]) -> Float64:
    """Distances [m] by flat index, without copying a channel on disk."""
    values, added = distance
    return np.asarray(values.reshape(-1)[cells].astype(np.float64) + added)


def grid_distances(grid: DistanceGrid) -> dict[str, GridDistance]:
    """A grid's distances by field name: sdf, hard, se, gpdf.

    Without its channel, hard is ``bound`` plus the header's margin, within a micrometre. Raises InputError without
    hard and bound.
    """
    distances: dict[str, GridDistance] = {
        name: (grid.channels[name], 0.0) for name in ("sdf", "hard", "se", "gpdf") if name in grid.channels
    }
    if "hard" not in distances:
        margin = grid.header.get("bound_margin")
        if "bound" not in grid.channels or not isinstance(margin, int | float):
            raise InputError(
                f"distance grid: expected a channel hard or bound, got {', '.join(grid.channels)}",
                remedy="bake with the channel bound, which is there by default",
            )
        distances["hard"] = grid.channels["bound"], float(margin)
    return distances


def median_radius(grid: DistanceGrid) -> float:
    """The median splat radius [m] in the header. Raises InputError without one."""
    health = grid.header.get("health")
    if not isinstance(health, dict) or not isinstance(health.get("radius"), int | float):
        raise InputError("distance grid: expected health.radius in its header, got none", remedy="bake it again")
    return float(health["radius"])


def _bands(error: Float64, truth: Float64, chosen: Bool) -> list[dict[str, Any]]:
    its = ((error[chosen & (truth >= lower) & (truth < upper)], lower, upper) for lower, upper in BANDS)
    return [asdict(band_accuracy(*each)) for each in its]


def band_accuracy(error: Float64, lower: float, upper: float) -> BandAccuracy:
    """Statistics of errors (Q,) [m] in a distance band."""
    is_empty = not len(error)
    return BandAccuracy(
        lower=lower,
        upper=upper,
        count=len(error),
        mean=None if is_empty else float(error.mean()),
        rmse=None if is_empty else float(np.sqrt(np.mean(error**2))),
        median=None if is_empty else float(np.median(error)),
        over_95=None if is_empty else float(np.percentile(error, 95)),
        over_max=None if is_empty else float(error.max()),
    )


def _over_estimate(error: Float64, allowance: float) -> dict[str, Any]:
    beyond = error[error > allowance] - allowance
    return {
        "allowance": allowance,
        "count": len(error),
        "count_beyond": len(beyond),
        "share_beyond": len(beyond) / len(error) if len(error) else None,
        "median_beyond": float(np.median(beyond)) if len(beyond) else None,
        "max_error": float(error.max()) if len(error) else None,
    }


FIELDS = ("hard", "sdf")  # the exact distance, and what a controller uses
_CURVES = ("edges", "predicted", "observed")
REACH = BANDS[-1][1]  # [m] of true distance that is compared


def compare_with_truth(
    points: Float64,
    fields: Mapping[str, Float64],
    distance: Float64,
    surface: Float64,
    frames: Iterable[RgbdFrame],
    *,
    name: str,
    workspace: Box | None,
    median_radius: float,
    probabilities: Mapping[str, Callable[[Float64, Float64], Float64]],
) -> tuple[dict[str, Any], dict[str, Reliability]]:
    """Accuracy of `FIELDS` where `frames` saw the surface (``field.json``), and reliability by probability form.

    Of sampled cells, world [m]: points (Q, 3), their centres; surface (Q, 3), nearest true surface points; fields,
    `FIELDS` (Q,); distance (Q,), the truth. name: of the truth. workspace: where the scene has splats. probabilities:
    functions of points (Q, 3) and sdf (Q,) [m].

    num_blank cells have no distance; num_near others lie outside objects, within 20 cm. A training camera saw the
    nearest surface point of num_seen of these in the workspace, and of num_outside_workspace outside it. reliability:
    at seen cells within 20 cm of a surface. error_mean, error_sigma [m]: of sdf at seen cells within
    `PROBABILITY_NEAR`, or None. Raises NotEvaluableError with no cell near an object.
    """
    sdf = fields["sdf"]
    is_blank = ~np.isfinite(sdf)
    is_around = (np.abs(distance) < BANDS[-1][1]) & ~is_blank
    is_near = (distance >= BANDS[0][0]) & is_around
    refuse_if(
        not is_near.any(),
        f"{name}: no cell of the grid lies within {BANDS[-1][1]} m outside an object",
        error=NotEvaluableError,
    )
    seen, in_workspace = np.zeros_like(is_near), np.ones_like(is_near)
    seen[is_around] = seen_by(surface[is_around], frames)
    if workspace is not None:
        in_workspace[is_around] = workspace.contains(surface[is_around])
    is_counted = seen & in_workspace
    error = (sdf - distance)[is_counted & (np.abs(distance) < PROBABILITY_NEAR)]
    accuracy = field_accuracy(
        {name: fields[name][is_near] for name in FIELDS},
        distance[is_near],
        is_counted[is_near],
        median_radius=median_radius,
    )
    curves = {
        form: reliability(probability(points[is_counted], sdf[is_counted]), distance[is_counted] <= 0)
        for form, probability in probabilities.items()
        if is_counted.any()
    }
    document = {
        "num_drawn": len(points),
        "num_blank": int(np.count_nonzero(is_blank)),
        "num_near": int(np.count_nonzero(is_near)),
        "num_seen": int(np.count_nonzero(is_counted & is_near)),
        "num_outside_workspace": int(np.count_nonzero(seen & ~in_workspace & is_near)),
        **accuracy,
        "error_mean": float(error.mean()) if len(error) else None,
        "error_sigma": float(error.std()) if len(error) else None,
        "reliability": {form: _curve(curve) for form, curve in curves.items()},
    }
    return document, curves


def _curve(curve: Reliability) -> dict[str, object]:
    values = {name: [None if np.isnan(v) else float(v) for v in getattr(curve, name)] for name in _CURVES}
    return {**values, "count": curve.count, "calibration_error": curve.calibration_error}


def compare_with_mesh(grid: DistanceGrid, mesh_path: Path, *, seed: int, max_points: int = 50_000) -> dict[str, Any]:
    """Errors of cells sampled by `seed`, against the exact mesh distance, as in ``field.json``.

    The mesh is in the grid's frame [m]. num_in_reach cells lie in its box widened by 20 cm; num_drawn were sampled.
    Of these, num_unknown have no distance, num_inside lie inside the mesh, and num_near outside within 20 cm. Only
    num_near are compared: inside a closed mesh, the field is a shell. An open mesh's distance is unsigned. Raises
    InputError for a file that is no mesh, NotEvaluableError with no cell near it.
    """
    mesh = load_mesh(mesh_path)
    distances = grid_distances(grid)
    cells, num_in_reach = _draw_cells(
        grid, mesh.vertices.min(axis=0) - REACH, mesh.vertices.max(axis=0) + REACH, max_points, seed
    )
    drawn = np.ravel_multi_index(tuple(cells.T), grid.channels["sdf"].shape)
    is_known = np.isfinite(distance_at(distances["sdf"], drawn))
    known, points = drawn[is_known], grid.origin + grid.voxel * cells[is_known]
    field = MeshDistance(mesh)
    in_reach = field.distance(points, REACH) < REACH
    known, points = known[in_reach], points[in_reach]
    distance, _, is_inside = field.closest(points)
    is_near = ~is_inside & (distance < REACH)
    refuse_if(
        not is_near.any(),
        f"{mesh_path}: no cell of the grid lies within {REACH:g} m outside the mesh",
        remedy="give the mesh in the frame of the grid (world), in metres",
        error=NotEvaluableError,
    )
    accuracy = field_accuracy(
        {name: distance_at(values, known[is_near]) for name, values in distances.items()},
        distance[is_near],
        None,
        median_radius=median_radius(grid),
    )
    return {
        "file": mesh_path.name,
        "is_closed": mesh.is_closed,
        "num_faces": len(mesh.faces),
        "num_in_reach": num_in_reach,
        "num_drawn": len(drawn),
        "num_unknown": int(np.count_nonzero(~is_known)),
        "num_inside": int(np.count_nonzero(is_inside)),
        "num_near": int(np.count_nonzero(is_near)),
        **accuracy,
    }


def _draw_cells(grid: DistanceGrid, lower: Float64, upper: Float64, max_cells: int, seed: int) -> tuple[Index, int]:
    """Sampled cells (C, 3) in a box, in order, and the number of all its cells."""
    shape = np.array(grid.channels["sdf"].shape)
    first = np.maximum(np.ceil((lower - grid.origin) / grid.voxel).astype(np.int64), 0)
    last = np.minimum(np.floor((upper - grid.origin) / grid.voxel).astype(np.int64), shape - 1)
    counts = np.maximum(last - first + 1, 0)
    num_cells = int(np.prod(counts))
    if num_cells == 0:
        return np.empty((0, 3), dtype=np.int64), 0
    chosen = np.sort(np.random.default_rng(seed).choice(num_cells, min(num_cells, max_cells), replace=False))
    return first + np.stack(np.unravel_index(chosen, counts), axis=1), num_cells
