"""A million random queries of a baked grid's certified distances: none may exceed the exact distance.

The exact distance is that to the splats' spheres, in float64 over all pairs. Prints per scene how many queries break
each bound, and how far the bounds stay below the exact distance. It also prints how often and by how much the
interpolated `sdf`, which bounds nothing between cell centres, exceeds the exact distance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.measure import Limit, Options, Result
from benchmarks.surfaces import exact_distance, random_balls, shapes, splats_on
from splatctrl_cli.cli.common import table
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.grid_cells import GridField
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import Box, DistanceGrid, Float64
from tests.field.scenes import splat_set

NUM = 1_000_000
NUM_BALLS = 300
PADDING = 0.2  # [m] of the grid around the splats
ROUNDING = 1e-6  # [m] sdf is no bound: it may equal hard, whose float32 is within this of the exact distance
BEYOND = 0.05  # [m] beyond the grid that queries reach: certified holds there too
PROMISES = ("bound_at_cell", "bound_nearest_cell", "bound_interpolated", "certified", "sdf_at_cell")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Results of one scene's grid.

    excess: by bound, the number of queries above the exact distance and the largest excess [m] (negative if none is
    above). given_away: median [m] by which the bounds (nearest cell, interpolated, certified) stay below the exact
    distance. interpolated_*: share of sdf values between cell centres above the exact distance, and their median and
    largest excess [m].
    """

    scene: str
    num_splats: int
    num_cells: int
    num_queries: int
    excess: dict[str, tuple[int, float]]
    given_away: dict[str, float]
    interpolated_share: float
    interpolated_median: float
    interpolated_max: float

    @property
    def holds(self) -> bool:
        """True where no query breaks a promise."""
        return all(count == 0 for count, _ in self.excess.values())


def run(options: Options) -> Result:
    """Broken promises, and what the interpolated sdf does."""
    scenes = [(shape.name, *splats_on(shape, 0.01, is_inset=True, seed=0)) for shape in shapes()]
    scenes += [(f"random balls {seed}", *random_balls(NUM_BALLS, seed=seed)) for seed in (1, 2)]
    each = -(-NUM // (100 if options.is_quick else 1) // len(scenes))
    verdicts = [ask(name, centers, radii, FieldConfig.voxel, each) for name, centers, radii in scenes]
    num_broken = sum(count for verdict in verdicts for count, _ in verdict.excess.values())
    rows = [(v.scene, v.num_splats, v.num_cells, each, *(v.excess[p][0] for p in PROMISES)) for v in verdicts]
    return Result(
        title="certificate: queries that read more than the exact distance to the splats",
        columns=("scene", "splats", "cells", "queries", *PROMISES),
        rows=[[*map(str, row)] for row in rows],
        figures={"num_queries": float(each * len(scenes)), "num_broken": float(num_broken)},
        limits=[Limit(figure="num_broken", bound=0.0)],
        more=given_away(verdicts),
    )


def ask(scene: str, centers: Float64, radii: Float64, voxel: float, num_queries: int) -> Verdict:
    """Bake the splats, and hold the grid to its word."""
    box = Box(
        lower=(centers - radii[:, None]).min(axis=0) - PADDING, upper=(centers + radii[:, None]).max(axis=0) + PADDING
    )
    grid = bake(splat_set(centers, radii), box, FieldConfig(voxel=voxel))
    return judge(scene, grid, centers, radii, num_queries)


def judge(
    scene: str, grid: DistanceGrid, centers: Float64, radii: Float64, num_queries: int, *, seed: int = 0
) -> Verdict:
    """Compare a grid with the exact distance at equal numbers of random points and random cells."""
    voxel = grid.voxel
    shape = np.array(grid.channels["sdf"].shape)
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, shape, (num_queries, 3))
    exact_at_cell = exact_distance(grid.origin + voxel * cells, centers, radii)
    extent = voxel * (shape - 1)
    points = grid.origin + rng.uniform(-BEYOND, extent + BEYOND, (num_queries, 3))
    exact = exact_distance(points, centers, radii)
    inside = GridField(grid).box.contains(points)
    within = points[inside]
    nearest = np.rint((within - grid.origin) / voxel).astype(np.int64)
    between = {
        "bound_nearest_cell": _at(grid, "bound", nearest),
        "bound_interpolated": GridField(grid, "bound").query(within)[0],
    }
    certified = GridField(grid).certified(points)
    over = GridField(grid).query(within)[0] - exact[inside]
    excess = {name: over_of(value - exact[inside]) for name, value in between.items()}
    excess["certified"] = over_of(certified - exact)
    excess["bound_at_cell"] = over_of(_at(grid, "bound", cells) - exact_at_cell)
    excess["sdf_at_cell"] = over_of(_at(grid, "sdf", cells) - exact_at_cell - ROUNDING)
    return Verdict(
        scene=scene,
        num_splats=len(radii),
        num_cells=int(shape.prod()),
        num_queries=num_queries,
        excess={name: excess[name] for name in PROMISES},
        given_away={
            **{name: float(np.median(exact[inside] - value)) for name, value in between.items()},
            "certified": float(np.median(exact[inside] - certified[inside])),
        },
        interpolated_share=float(np.mean(over > ROUNDING)),
        interpolated_median=float(np.median(over[over > ROUNDING])) if (over > ROUNDING).any() else 0.0,
        interpolated_max=float(over.max()),
    )


def over_of(error: Float64) -> tuple[int, float]:
    """How many errors are above 0, and the largest."""
    return int(np.count_nonzero(error > 0)), float(error.max())


def given_away(verdicts: Sequence[Verdict]) -> list[str]:
    """The table of the interpolated sdf, and of the bounds' gaps below the exact distance."""
    names = ("bound_nearest_cell", "bound_interpolated", "certified")
    header = (
        *("scene", "bound, nearest cell", "bound, interpolated", "certified"),
        *("sdf above exact %", "median mm", "max mm"),
    )
    rows = [
        [
            *(v.scene, *(f"{v.given_away[name] * 1e3:.1f}" for name in names), f"{v.interpolated_share * 100:.1f}"),
            *(f"{v.interpolated_median * 1e3:.2f}", f"{v.interpolated_max * 1e3:.1f}"),
        ]
        for v in verdicts
    ]
    return ["median below the exact distance [mm], and the interpolated sdf above it:", *table(header, rows), ""]


def _at(grid: DistanceGrid, channel: str, cells: np.ndarray) -> Float64:
    return np.asarray(grid.channels[channel][tuple(cells.T)], dtype=np.float64)
