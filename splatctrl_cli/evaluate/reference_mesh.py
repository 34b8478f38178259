"""A baked field beside a mesh of the same scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import BANDS, FieldAccuracy, field_accuracy, grid_distances, median_radius
from splatctrl_cli.evaluate.mesh_distance import MeshDistance, load_mesh
from splatctrl_cli.records import DistanceGrid

REACH = BANDS[-1][1]  # [m] of true distance that is compared


@dataclass(frozen=True, kw_only=True)
class MeshComparison:
    """The accuracy, and how many cells went into it.

    num_in_reach of the grid's cells lie in the box of the mesh widened by 20 cm; num_drawn of those were drawn,
    num_unknown of those have no distance (NaN, by the policy for unknown space), num_inside lie inside the mesh, and
    num_near are outside of it and within 20 cm: those are compared. is_closed: the mesh has an inside.
    """

    accuracy: FieldAccuracy
    is_closed: bool
    num_faces: int
    num_in_reach: int
    num_drawn: int
    num_unknown: int
    num_inside: int
    num_near: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as written to ``accuracy.json``."""
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
    cells = _cells_in_reach(grid, mesh.vertices.min(axis=0) - REACH, mesh.vertices.max(axis=0) + REACH)
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.choice(cells, min(len(cells), max_points), replace=False))
    is_known = np.isfinite(distances["sdf"].reshape(-1)[drawn])
    known = drawn[is_known]
    points = grid.origin + grid.voxel * np.stack(np.unravel_index(known, distances["sdf"].shape), axis=1)
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
        accuracy=field_accuracy(
            {name: values.reshape(-1)[known[is_near]] for name, values in distances.items()},
            distance[is_near],
            None,
            median_radius=median_radius(grid),
        ),
        is_closed=mesh.is_closed,
        num_faces=len(mesh.faces),
        num_in_reach=len(cells),
        num_drawn=len(drawn),
        num_unknown=int(np.count_nonzero(~is_known)),
        num_inside=int(np.count_nonzero(is_inside)),
        num_near=int(np.count_nonzero(is_near)),
    )


def _cells_in_reach(grid: DistanceGrid, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.int64]:
    """Flat indices of the cells whose centres lie in a box."""
    shape = grid.channels["sdf"].shape
    spans = []
    for axis in range(3):
        first = int(np.ceil((lower[axis] - grid.origin[axis]) / grid.voxel))
        last = int(np.floor((upper[axis] - grid.origin[axis]) / grid.voxel))
        spans.append(np.arange(max(first, 0), min(last, shape[axis] - 1) + 1, dtype=np.int64))
    i, j, k = np.ix_(*spans)
    return np.asarray(((i * shape[1] + j) * shape[2] + k).reshape(-1))
