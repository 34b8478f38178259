"""Distance and gradient at points and on grids, compared with scipy's k-d tree and tiled torch."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.measure import Limit, Options, Result, medians
from benchmarks.scenes import surface_splats
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SphereField, field_over
from splatctrl_cli.field.grid_cells import GridField, GridLayout
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import Box, Float64, SplatSet

NUM_SPLATS, MANY_SPLATS, NUM_POINTS, MANY_POINTS, VOXEL = 5000, 50_000, 60, 1_000_000, 0.01
TREE_EVERY, TORCH_EVERY = 32, 200  # of the cells, and of the points, that the references are asked
CENTER = np.array([0.0, 0.0, 0.3])
THREADS = 2

Tasks = dict[str, Callable[[], object]]


class Report:
    """Rows for readers, figures and ratios for programs, as they are measured."""

    def __init__(self) -> None:
        self.rows: list[list[str]] = []
        self.figures: dict[str, float] = {}
        self.ratios: dict[str, float] = {}

    def add(
        self, key: str, what: str, seconds: float, count: int, threads: int, peer: str, peer_seconds: float
    ) -> None:
        """Add a row: a task, its seconds and number of points, and a reference's seconds in the same run."""
        unit, scale = ("us", 1e6) if seconds < 1e-2 else ("s", 1.0)
        shown = f"{scale * seconds:.0f} us" if unit == "us" else f"{seconds:.2f} s"
        peer_shown = f"{scale * peer_seconds:.0f} us" if unit == "us" else f"{peer_seconds:.2f} s"
        self.rows.append(
            [
                what,
                str(threads),
                shown,
                f"{1e9 * seconds / count:.0f}",
                peer,
                peer_shown,
                f"{peer_seconds / seconds:.2f}",
            ]
        )
        self.figures[f"{key}_{unit}"] = scale * seconds
        self.ratios[f"{key}_over_peer"] = peer_seconds / seconds


def run(options: Options) -> Result:
    """Measure 60 points (an arm's spheres), a million points, and 1 cm grids, with 5,000 and 50,000 splats."""
    report = Report()
    _few_points(report, options)
    _many_points(report, options)
    _grids(report, NUM_SPLATS, 128 if options.is_quick else 256, options)
    if not options.is_quick:
        _grids(report, MANY_SPLATS, 256, options)
    limits = [Limit(figure="query_safe_us", bound=50.0), Limit(figure="query_grid_us", bound=10.0)]
    bounds = {"bake_5000_safe_s": 1.0, "bake_5000_gpdf_s": 2.5, "bake_50000_safe_s": 8.0, "bake_50000_gpdf_s": 20.0}
    if not options.is_quick:
        limits += [Limit(figure=figure, bound=bound) for figure, bound in bounds.items()]
    return Result(
        title=f"field: {NUM_SPLATS} and {MANY_SPLATS} splats",
        columns=("what", "threads", "time", "per point [ns]", "beside", "its time", "ratio"),
        rows=report.rows,
        figures=report.figures,
        ratios=report.ratios,
        limits=limits,
        notes=[
            "tree: scipy's cKDTree, distances to the nearest centre, or 8; no radius, kernel or gradient",
            f"asked one x-plane in {TREE_EVERY} of a grid, torch one point in {TORCH_EVERY}; times scaled up",
            "torch: log-sum-exp of the Matern field in tiles of 250 points, float32, no gradient",
        ],
    )


def _few_points(report: Report, options: Options) -> None:
    splats = surface_splats(NUM_SPLATS)
    points = CENTER + np.random.default_rng(3).uniform(-0.5, 0.5, (NUM_POINTS, 3))
    tree = cKDTree(splats.centers)
    coarse = GridField(bake(splats, _box(64, 2 * VOXEL), FieldConfig(voxel=2 * VOXEL)))
    tasks: Tasks = {
        name: partial(field_over(Spheres.of(splats.centers, splats.radii), FieldConfig(distance=name)).query, points)
        for name in ("hard", "safe", "gpdf", "safe_gpdf")
    }
    times = medians(
        {**tasks, "grid": partial(coarse.query, points), "tree": partial(tree.query, points)}, options.rounds(400)
    )
    names = {
        "hard": "exact distance",
        "safe": "min(se, exact), the controller's",
        "gpdf": "Matern field",
        "safe_gpdf": "min(gpdf, exact)",
        "grid": "baked grid",
    }
    for key, name in names.items():
        what = f"{NUM_POINTS} points, {name}, gradient"
        report.add(f"query_{key}", what, times[key], NUM_POINTS, 1, "tree", times["tree"])


def _many_points(report: Report, options: Options) -> None:
    splats = surface_splats(NUM_SPLATS)
    num = MANY_POINTS // 10 if options.is_quick else MANY_POINTS
    points = CENTER + np.random.default_rng(4).uniform(-0.5, 0.5, (num, 3))
    tree = cKDTree(splats.centers)
    exact = SphereField(Spheres.of(splats.centers, splats.radii), threads=THREADS)
    safe = field_over(Spheres.of(splats.centers, splats.radii), FieldConfig(), threads=THREADS)
    kernel = GpdfField(Spheres.of(splats.centers, splats.radii), threads=THREADS)
    tasks: Tasks = {
        "hard": partial(exact.query, points),
        "safe": partial(safe.query, points),
        "gpdf": partial(kernel.query, points),
        "tree": partial(tree.query, points, workers=THREADS),
        "tree_8": partial(tree.query, points, k=8, workers=THREADS),
        "torch": partial(_tiled_torch, kernel, splats, points[::TORCH_EVERY]),
    }
    times = medians(tasks, options.rounds(3), num_untimed=0)
    shown = f"{num:,} points"
    for key, name, peer, peer_time in (
        ("hard", "exact distance", "tree", times["tree"]),
        ("safe", "min(se, exact)", "tree, nearest 8", times["tree_8"]),
        ("gpdf", "Matern field", "torch", TORCH_EVERY * times["torch"]),
    ):
        report.add(f"million_{key}", f"{shown}, {name}, gradient", times[key], num, THREADS, peer, peer_time)


def _tiled_torch(kernel: GpdfField, splats: SplatSet, points: Float64) -> torch.Tensor:
    """The Matern field in plain torch: all pairs, a few points at a time."""
    torch.set_num_threads(THREADS)
    length = kernel.kernel.length
    centers = torch.from_numpy(splats.centers)
    exponents = torch.from_numpy((kernel.offsets / length).astype(np.float32))
    tiles = torch.from_numpy(points.astype(np.float32)).split(250)
    return torch.cat(
        [-length * torch.logsumexp(exponents - torch.cdist(tile, centers) / length, dim=1) for tile in tiles]
    )


def _grids(report: Report, num_splats: int, cells: int, options: Options) -> None:
    splats = surface_splats(num_splats)
    layout = GridLayout.over(_box(cells, VOXEL), VOXEL)
    tree = cKDTree(splats.centers)
    axes = [layout.origin[axis] + VOXEL * np.arange(cells) for axis in range(3)]
    planes = np.stack(np.meshgrid(axes[0][::TREE_EVERY], axes[1], axes[2], indexing="ij"), axis=-1).reshape(-1, 3)
    variants = {
        "safe": ("safe", ("sdf", "bound")),
        "gradient": ("safe", ("sdf", "gradient", "bound", "observed")),
        "gpdf": ("safe_gpdf", ("sdf", "bound")),
    }
    tasks: Tasks = {
        key: partial(_bake, splats, layout, FieldConfig(voxel=VOXEL, distance=distance), channels)
        for key, (distance, channels) in variants.items()
    }
    tasks["tree"] = partial(tree.query, planes, workers=THREADS)
    times = medians(tasks, options.rounds(3), num_untimed=0)
    for key, (distance, channels) in variants.items():
        what = f"{num_splats:,} splats, {cells}^3 cells of 1 cm: {distance}, {', '.join(channels)}"
        report.add(
            f"bake_{num_splats}_{key}", what, times[key], cells**3, THREADS, "tree", TREE_EVERY * times["tree"]
        )


def _bake(splats: SplatSet, layout: GridLayout, config: FieldConfig, channels: tuple[str, ...]) -> None:
    baker = Baker(splats, layout, config, channels=channels, threads=THREADS)
    baker.bake(0, layout.shape[0], baker.allocate(layout.shape[0]))


def _box(cells: int, voxel: float) -> Box:
    """A cube of so many cells around the scene."""
    half: Float64 = np.full(3, 0.5 * voxel * (cells - 1))
    return Box(lower=CENTER - half, upper=CENTER + half)
