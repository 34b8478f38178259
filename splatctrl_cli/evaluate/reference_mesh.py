"""A baked field beside a mesh of the same scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import BANDS, FieldAccuracy, field_accuracy, grid_distances, median_radius
from splatctrl_cli.mesh_distance import MeshDistance, load_mesh
from splatctrl_cli.records import DistanceGrid, Float64

REACH = BANDS[-1][1]  # [m] of true distance that is compared


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
    in_reach = field.lower_bound(points) < REACH
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


def _drawn_cells(
    grid: DistanceGrid, lower: Float64, upper: Float64, max_cells: int, seed: int
) -> tuple[NDArray[np.int64], int]:
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
