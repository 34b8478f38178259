"""Distance and gradient at points, and on a grid, beside scipy's k-d tree."""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.measure import Options, Result, medians
from benchmarks.scenes import surface_splats
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.bake import bake
from splatctrl_cli.field.distance import GpdfField, SafeField, SphereField
from splatctrl_cli.field.grid import GridField
from splatctrl_cli.records import Box, Float64, SplatSet

NUM_SPLATS, NUM_POINTS, VOXEL = 5000, 60, 0.01
SLAB = 8  # of the largest grid, the tree is asked one x-plane in so many
CENTER = np.array([0.0, 0.0, 0.3])


def run(options: Options) -> Result:
    """60 points (an arm's spheres) against 5,000 splats, and grids of 1 cm."""
    splats = surface_splats(NUM_SPLATS)
    tree = cKDTree(splats.centers)
    rows, figures, ratios = _queries(splats, tree, options)
    for cells, every in ((128, 1),) if options.is_quick else ((128, 1), (256, SLAB)):
        row, ours, reference = _bake(splats, tree, cells, every, options)
        rows.append(row)
        figures |= {f"bake_{cells}_s": ours, f"bake_{cells}_tree_s": reference}
        ratios[f"bake_{cells}_over_tree"] = reference / ours
    return Result(
        title=f"field: {NUM_SPLATS} splats",
        columns=("what", "threads", "time", "per point [ns]", "k-d tree, same points", "ratio"),
        rows=rows,
        figures=figures,
        ratios=ratios,
        notes=[
            "k-d tree: scipy's, distance to the nearest centre alone; no radius, no kernel field, no gradient",
            f"at 256 cells it is asked one x-plane in {SLAB}, and its time multiplied by {SLAB}",
        ],
    )


Rows = list[list[str]]


def _queries(splats: SplatSet, tree: cKDTree, options: Options) -> tuple[Rows, dict[str, float], dict[str, float]]:
    points = CENTER + np.random.default_rng(3).uniform(-0.5, 0.5, (NUM_POINTS, 3))
    exact = SphereField(splats.centers, splats.radii)
    kernel = GpdfField(splats.centers, splats.radii)
    grid = GridField(bake(splats, _box(64), FieldConfig(voxel=2 * VOXEL)))
    tasks: dict[str, Callable[[], object]] = {
        "exact": partial(exact.query, points),
        "kernel": partial(kernel.query, points),
        "safe": partial(SafeField(exact, kernel).query, points),
        "grid": partial(grid.query, points),
        "tree": partial(tree.query, points),
    }
    times = medians(tasks, options.rounds(400))
    names = {
        "exact": f"{NUM_POINTS} points, exact distance, gradient",
        "kernel": f"{NUM_POINTS} points, kernel distance, gradient",
        "safe": f"{NUM_POINTS} points, minimum of both (the controller's), gradient",
        "grid": f"{NUM_POINTS} points, baked grid, gradient",
    }
    rows = [
        [name, "1", f"{1e6 * times[key]:.0f} us", f"{1e9 * times[key] / NUM_POINTS:.0f}",
         f"{1e6 * times['tree']:.0f} us", f"{times['tree'] / times[key]:.2f}"]
        for key, name in names.items()
    ]  # fmt: skip
    figures = {f"query_{key}_us": 1e6 * value for key, value in times.items()}
    return rows, figures, {f"query_{key}_over_tree": times["tree"] / times[key] for key in names}


def _bake(
    splats: SplatSet, tree: cKDTree, cells: int, every: int, options: Options
) -> tuple[list[str], float, float]:
    """A row for people, our seconds and the tree's, both on two threads."""
    box, config = _box(cells), FieldConfig(voxel=VOXEL)
    axes = [box.lower[axis] + VOXEL * np.arange(cells) for axis in range(3)]
    points = np.stack(np.meshgrid(axes[0][::every], axes[1], axes[2], indexing="ij"), axis=-1).reshape(-1, 3)
    tasks: dict[str, Callable[[], object]] = {
        "bake": partial(bake, splats, box, config, threads=2),
        "tree": partial(tree.query, points, workers=2),
    }
    times = medians(tasks, options.rounds(3), num_untimed=0)
    ours, reference = times["bake"], times["tree"] * every
    row = [
        f"bake {cells}^3 cells of 1 cm, both distances, gradient", "2", f"{ours:.2f} s",
        f"{1e9 * ours / cells**3:.0f}", f"{reference:.2f} s", f"{reference / ours:.2f}",
    ]  # fmt: skip
    return row, ours, reference


def _box(cells: int) -> Box:
    """A cube of `cells` cells of VOXEL (of twice that for 64, the same cube as 128) around the scene."""
    half: Float64 = np.full(3, 0.5 * VOXEL * (max(cells, 128) - 1))
    return Box(lower=CENTER - half, upper=CENTER + half)
