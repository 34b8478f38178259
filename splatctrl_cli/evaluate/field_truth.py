"""A baked field beside what is known of the scene: the truth of a simulated log, or a mesh."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import BANDS, PROBABILITY_NEAR
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import FieldAccuracy, field_accuracy, grid_distances, median_radius
from splatctrl_cli.evaluate.views import seen_by
from splatctrl_cli.mesh_distance import MeshDistance, load_mesh
from splatctrl_cli.records import Box, DistanceGrid, Float64, Index, RgbdFrame
from splatctrl_cli.report.reliability import Reliability, reliability

FIELDS = ("hard", "sdf")  # the exact distance, and what a controller uses
_CURVES = ("edges", "predicted", "observed")
REACH = BANDS[-1][1]  # [m] of true distance that is compared


@dataclass(frozen=True, kw_only=True)
class TrueCells:
    """Q cells drawn of a grid: centres (Q, 3) [m], the grid's `FIELDS` there (Q,) [m], the true distance (Q,) [m] and
    the surface point (Q, 3) [m] that gives it; world.
    """

    points: Float64
    fields: Mapping[str, Float64]
    distance: Float64
    surface: Float64


@dataclass(frozen=True, kw_only=True)
class TruthComparison:
    """The accuracy, and how many cells went into it.

    num_drawn of the grid's cells, num_blank of them without a distance (field.unknown = nan), num_near of the others
    outside the objects and within 20 cm, num_seen of those with a nearest true surface point that a training camera
    saw inside the workspace; num_outside_workspace more were seen, but their surface lies where the scene keeps no
    splats. reliability: of each form of the probability, at seen cells within 20 cm of a surface, inside or out.
    error_mean, error_sigma [m]: of sdf at seen cells within `PROBABILITY_NEAR` of a surface, None without any.
    """

    accuracy: FieldAccuracy
    num_drawn: int
    num_blank: int
    num_near: int
    num_seen: int
    num_outside_workspace: int
    reliability: Mapping[str, Reliability]
    error_mean: float | None
    error_sigma: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as written to ``field.json``."""
        counts = {name: value for name, value in vars(self).items() if name.startswith("num_")}
        error = {"error_mean": self.error_mean, "error_sigma": self.error_sigma}
        curves = {name: _curve(curve) for name, curve in self.reliability.items()}
        return {**counts, **self.accuracy.as_dict(), **error, "reliability": curves}


def compare_with_truth(
    cells: TrueCells,
    frames: Iterable[RgbdFrame],
    *,
    name: str,
    workspace: Box | None,
    median_radius: float,
    probabilities: Mapping[str, Callable[[Float64, Float64], Float64]],
) -> TruthComparison:
    """The accuracy of `FIELDS`, and the reliability of the probabilities, at cells that `frames` saw the surface of.

    name: of the truth, for errors; workspace: where the scene keeps splats, None where that is not known;
    median_radius [m] of the splats; probabilities: by name, at points (Q, 3) of sdf (Q,) [m]. Raises
    NotEvaluableError where no cell is near an object.
    """
    sdf, distance = cells.fields["sdf"], cells.distance
    is_blank = ~np.isfinite(sdf)
    is_around = (np.abs(distance) < BANDS[-1][1]) & ~is_blank
    is_near = (distance >= BANDS[0][0]) & is_around
    if not is_near.any():
        raise NotEvaluableError(f"{name}: no cell of the grid lies within {BANDS[-1][1]} m outside an object")
    seen, in_workspace = np.zeros_like(is_near), np.ones_like(is_near)
    seen[is_around] = seen_by(cells.surface[is_around], frames)
    if workspace is not None:
        in_workspace[is_around] = workspace.contains(cells.surface[is_around])
    is_counted = seen & in_workspace
    error = (sdf - distance)[is_counted & (np.abs(distance) < PROBABILITY_NEAR)]
    return TruthComparison(
        accuracy=field_accuracy(
            {name: cells.fields[name][is_near] for name in FIELDS},
            distance[is_near],
            is_counted[is_near],
            median_radius=median_radius,
        ),
        num_drawn=len(cells.points),
        num_blank=int(np.count_nonzero(is_blank)),
        num_near=int(np.count_nonzero(is_near)),
        num_seen=int(np.count_nonzero(is_counted & is_near)),
        num_outside_workspace=int(np.count_nonzero(seen & ~in_workspace & is_near)),
        reliability={
            form: reliability(probability(cells.points[is_counted], sdf[is_counted]), distance[is_counted] <= 0)
            for form, probability in probabilities.items()
            if is_counted.any()
        },
        error_mean=float(error.mean()) if len(error) else None,
        error_sigma=float(error.std()) if len(error) else None,
    )


def _curve(found: Reliability) -> dict[str, object]:
    """Plain values; None where a bin is empty."""
    values = {name: [None if np.isnan(v) else float(v) for v in getattr(found, name)] for name in _CURVES}
    return {**values, "count": found.count, "calibration_error": found.calibration_error}


@dataclass(frozen=True, kw_only=True)
class MeshComparison:
    """The accuracy against the mesh of `file`, and how many cells went into it.

    num_in_reach of the grid's cells lie in the box of the mesh widened by 20 cm; num_drawn of those were drawn,
    num_unknown of those have no distance (NaN, by the policy for unknown space), num_inside lie inside the mesh near
    its surface, and num_near are outside of it and within 20 cm: those are compared. is_closed: the mesh has an
    inside.
    """

    file: str
    accuracy: FieldAccuracy
    is_closed: bool
    num_faces: int
    num_in_reach: int
    num_drawn: int
    num_unknown: int
    num_inside: int
    num_near: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as written to ``field.json``."""
        counts = {name: value for name, value in vars(self).items() if name != "accuracy"}
        return {**counts, **self.accuracy.as_dict()}


def compare_with_mesh(grid: DistanceGrid, mesh_path: Path, *, seed: int, max_points: int = 50_000) -> MeshComparison:
    """Errors of the grid's distances at cell centres, drawn with the seed, against the exact distance to a mesh.

    The mesh is in the grid's frame, in metres, and neither moved nor scaled. Inside a closed mesh nothing is compared
    (the field is a shell there); an open one has no inside, and its unsigned distance is the truth on both sides.
    Which cells a camera saw is not known here: `seen` of the accuracy is empty. Raises InputError for a file that is
    no mesh, NotEvaluableError where no cell is near it.
    """
    mesh = load_mesh(mesh_path)
    distances = grid_distances(grid)
    cells, num_in_reach = _drawn_cells(
        grid, mesh.vertices.min(axis=0) - REACH, mesh.vertices.max(axis=0) + REACH, max_points, seed
    )
    drawn = np.ravel_multi_index(tuple(cells.T), grid.channels["sdf"].shape)
    is_known = np.isfinite(distances["sdf"].at(drawn))
    known, points = drawn[is_known], grid.origin + grid.voxel * cells[is_known]
    field = MeshDistance(mesh)
    in_reach = field.distance(points, REACH) < REACH
    known, points = known[in_reach], points[in_reach]
    distance, _, is_inside = field.closest(points)
    is_near = ~is_inside & (distance < REACH)
    if not is_near.any():
        raise NotEvaluableError(
            f"{mesh_path}: no cell of the grid lies within {REACH:g} m outside the mesh",
            remedy="give the mesh in the frame of the grid (world), in metres",
        )
    return MeshComparison(
        file=mesh_path.name,
        accuracy=field_accuracy(
            {name: values.at(known[is_near]) for name, values in distances.items()},
            distance[is_near],
            None,
            median_radius=median_radius(grid),
        ),
        is_closed=mesh.is_closed,
        num_faces=len(mesh.faces),
        num_in_reach=num_in_reach,
        num_drawn=len(drawn),
        num_unknown=int(np.count_nonzero(~is_known)),
        num_inside=int(np.count_nonzero(is_inside)),
        num_near=int(np.count_nonzero(is_near)),
    )


def _drawn_cells(grid: DistanceGrid, lower: Float64, upper: Float64, max_cells: int, seed: int) -> tuple[Index, int]:
    """Some of the cells (C, 3) whose centres lie in a box, in order, and how many there are in all."""
    shape = np.array(grid.channels["sdf"].shape)
    first = np.maximum(np.ceil((lower - grid.origin) / grid.voxel).astype(np.int64), 0)
    last = np.minimum(np.floor((upper - grid.origin) / grid.voxel).astype(np.int64), shape - 1)
    counts = np.maximum(last - first + 1, 0)
    num_cells = int(np.prod(counts))
    if num_cells == 0:
        return np.empty((0, 3), dtype=np.int64), 0
    chosen = np.sort(np.random.default_rng(seed).choice(num_cells, min(num_cells, max_cells), replace=False))
    return first + np.stack(np.unravel_index(chosen, counts), axis=1), num_cells
