"""What a baked field and a scene answer about points, a block at a time."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import Config
from splatctrl_cli.config.fixed import MARCH_STEPS
from splatctrl_cli.control.audit import observed_at
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.field.clustered_splats import Spheres
from splatctrl_cli.field.distance import SphereField, field_over, march
from splatctrl_cli.field.grid_field import GridField
from splatctrl_cli.field.obstacles import ObstacleSpheres
from splatctrl_cli.field.on_device import OnDevice
from splatctrl_cli.field.probability import make_probability
from splatctrl_cli.jobs.bake.request import BakeSource
from splatctrl_cli.kernels.cuda.memory import Memory
from splatctrl_cli.records import Bool, DistanceField, DistanceGrid, Float64, Label
from splatctrl_cli.voxels import VoxelState

ROUNDING = 1e-6  # [m] and of the lengths in it: what float32 may lose of an exact distance, as in a baked bound
TITLES = (
    *("x", "y", "z", "in_box", "distance", "gradient_x", "gradient_y", "gradient_z", "bound", "probability"),
    *("label", "splat", "observed", "surface_x", "surface_y", "surface_z", "surface_rest"),
)
_LABELS = np.array([*(label.name.lower() for label in sorted(Label)), ""])  # the last for -1
_STATES = np.array([*(state.name.lower() for state in sorted(VoxelState)), ""])
_NAMES = {"label": _LABELS, "observed": _STATES}
_DECIMALS = 7  # of a length [m]: finer than float32


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Of Q points, world: None for what is not known of any point, NaN or -1 for what is not known of one.

    in_box (Q,): in the box that was asked; distance (Q,) [m] and its gradient (Q, 3); bound (Q,) [m]: the exact
    distance to the splats is not less; probability (Q,) of collision; label (Q,) `Label` and splat (Q,), the index in
    the scene's file, of the nearest sphere; observed (Q,) `VoxelState`; surface (Q, 3) [m], where sphere marching
    ended, and rest (Q,) [m], what the field reads there.
    """

    in_box: Bool | None = None
    distance: Float64
    gradient: Float64
    bound: Float64 | None = None
    probability: Float64 | None = None
    label: NDArray[np.int8] | None = None
    splat: NDArray[np.int64] | None = None
    observed: NDArray[np.int8] | None = None
    surface: Float64 | None = None
    rest: Float64 | None = None


class SceneAnswers:
    """The splats of a scene, and the balls around its occupied voxels without one, as a field by `config`."""

    def __init__(
        self,
        source: BakeSource,
        obstacles: ObstacleSpheres,
        config: Config,
        threads: int,
        device: Memory | None = None,
    ) -> None:
        """device: a card that computes the distances. Raises UsageError where unknown space is to count as something:
        that is a matter of grids.
        """
        if config.field.unknown != "free":
            raise UsageError(
                f"field.unknown = {config.field.unknown}: only a baked field has it",
                remedy="bake it with sdf-bake and query that",
            )
        splats = obstacles.splats
        self._spheres = Spheres.of(splats.centers, splats.radii)
        self._exact: SphereField | OnDevice
        self._field: DistanceField
        if device is None:
            self._exact = SphereField.over(self._spheres, threads=threads)
            self._field = field_over(self._spheres, config.field, threads=threads)
        else:
            self._exact = OnDevice(self._spheres, replace(config.field, distance="hard"), device)
            self._field = OnDevice(self._spheres, config.field, device, threads=threads)
        self._probability = make_probability(self._spheres, config.field, threads=threads)
        self._labels, self._index = splats.labels, obstacles.index
        self._workspace, known, limits = source.workspace, source.occupancy, config.occupancy
        self._observed = None
        if known is not None:
            states = known.states(limits.free_below, limits.occupied_above)
            self._observed = partial(observed_at, states, known.origin, known.voxel)
        self._reach = float(np.abs(splats.centers - self._spheres.points.anchor).max())

    def at(self, points: Float64) -> Answers:
        """Everything, at points (Q, 3) [m], world."""
        distance, gradient = self._field.query(points)
        nearest = self._exact.nearest(points)
        walked = march(self._field, self._exact, points, steps=MARCH_STEPS)
        size = self._reach + np.abs(points - self._spheres.points.anchor).max(axis=1)
        return Answers(
            in_box=None if self._workspace is None else self._workspace.contains(points),
            distance=distance,
            gradient=gradient,
            bound=self._exact.query(points)[0] - ROUNDING * (1.0 + size),
            probability=self._probability.at(points, distance),
            label=self._labels[nearest].astype(np.int8),
            splat=self._index[nearest],
            observed=None if self._observed is None else self._observed(points).astype(np.int8),
            surface=walked.hit,
            rest=walked.rest,
        )

    def beside(self, points: Float64, of_grid: Answers) -> Answers:
        """What a grid answered, and the rest of the scene; the probability is that of the grid's distance."""
        mine = self.at(points)
        probability = self._probability.at(points, of_grid.distance)
        return replace(
            mine,
            in_box=of_grid.in_box,
            distance=of_grid.distance,
            gradient=of_grid.gradient,
            bound=of_grid.bound,
            probability=np.where(np.isnan(of_grid.distance), np.nan, probability),
        )


class GridAnswers:
    """The channels of a baked grid: distances between its cells' centres, labels and observations of the nearest."""

    def __init__(self, grid: DistanceGrid, where: str) -> None:
        """Raises InputError as `GridField`, and for a cell whose label or state is none of ours."""
        self._field = GridField(grid)
        self.box = self._field.box
        self._has_bound = "bound" in grid.channels
        self._probability = GridField(grid, "probability") if "probability" in grid.channels else None
        self._cells = {}
        for name in _NAMES.keys() & grid.channels.keys():
            values, most = grid.channels[name].astype(np.uint8), len(_NAMES[name]) - 2
            if values.max() > most:
                raise InputError(
                    f"{where}: {name}: expected 0 to {most}, got {values.max()}", remedy="bake the field again"
                )
            self._cells[name] = partial(observed_at, values, grid.origin, grid.voxel)

    def at(self, points: Float64) -> Answers:
        """What the grid holds at points (Q, 3) [m], world; nothing outside the box of the cell centres."""
        inside = self._field.contains(points)
        distance, gradient = self._field.query(points)
        probability = None if self._probability is None else self._probability.query(points)[0]
        return Answers(
            in_box=inside,
            distance=np.where(inside, distance, np.nan),
            gradient=np.where(inside[:, None], gradient, np.nan),
            bound=np.where(inside, self._field.certified(points), np.nan) if self._has_bound else None,
            probability=None if probability is None else np.where(inside, probability, np.nan),
            label=self._nearest("label", points, inside),
            observed=self._nearest("observed", points, inside),
        )

    def _nearest(self, channel: str, points: Float64, inside: Bool) -> NDArray[np.int8] | None:
        look = self._cells.get(channel)
        return None if look is None else np.where(inside, look(points), -1).astype(np.int8)


def rows_of(points: Float64, answers: Answers) -> str:
    """Lines of CSV, a cell for each of `TITLES`, empty where the answer is not known."""
    length, a = f"%.{_DECIMALS}f", answers
    bound = None if a.bound is None else np.floor(a.bound * 10**_DECIMALS) / 10**_DECIMALS  # in print a bound still
    splat = None if a.splat is None else np.where(a.splat < 0, "", a.splat.astype(str))
    columns: list[tuple[str, NDArray[np.generic] | None]] = [
        *(("%.9g", points[:, axis]) for axis in range(3)),
        ("%d", a.in_box),
        (length, a.distance),
        *(("%.6f", a.gradient[:, axis]) for axis in range(3)),
        (length, bound),
        ("%.6g", a.probability),
        ("%s", None if a.label is None else _LABELS[a.label]),
        ("%s", splat),
        ("%s", None if a.observed is None else _STATES[a.observed]),
        *((length, None if a.surface is None else a.surface[:, axis]) for axis in range(3)),
        (length, a.rest),
    ]
    template = ",".join("" if values is None else form for form, values in columns) + "\n"
    cells = [values.tolist() for _, values in columns if values is not None]
    return "".join(map(template.__mod__, zip(*cells, strict=True))).replace("nan", "")
