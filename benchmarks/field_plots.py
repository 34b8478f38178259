"""The plots of docs/results.md, each computed by the present code."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.surfaces import Shape, exact_distance, lone_splat, points_around, shapes, splats_on
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SafeField, SeField, SphereField
from splatctrl_cli.field.grid_cells import GridField
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import Box, DistanceField, Float64
from tests.field.scenes import splat_set

COLORS = {"hard": "#4477aa", "gpdf": "#ccbb44", "se": "#ee6677", "safe": "#228833", "truth": "#000000"}
DPI, WIDTH, HEIGHT = 90, 7.0, 3.6  # [px per inch], [inch]
SPACING = 0.01  # [m]


@dataclass(frozen=True, kw_only=True)
class PlanarBias:
    """Values of gpdf over a dense plane of centres, at heights (40,), and ``z - l log(1 + z / l)`` [m]."""

    length: float
    heights: list[float]
    measured: list[float]
    closed_form: list[float]
    largest_difference: float
    at_10_cm: float


def write_plots(folder: Path, bias: Sequence[PlanarBias]) -> None:
    """Write all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    table = next(shape for shape in shapes(with_meshes=False) if shape.name == "tabletop")
    for name, draw in (
        ("field_planar_bias", lambda: draw_planar_bias(bias)),
        ("field_error", lambda: draw_error(table)),
        ("field_levels", lambda: draw_levels(table)),
        ("field_lone_splat", draw_lone_splat),
        ("field_certificate", draw_certificate),
    ):
        figure = draw()
        figure.savefig(folder / f"{name}.png", dpi=DPI, metadata={"Software": None})


def draw_planar_bias(bias: Sequence[PlanarBias]) -> Any:
    """Draw measured values over a plane on the curves of the closed form."""
    figure, axes = new_figure()
    axes.plot([0, 20], [0, 20], color=COLORS["truth"], linewidth=1, label="the true distance z")
    for one, color in zip(bias, ("#66ccee", COLORS["gpdf"], "#aa3377"), strict=True):
        heights, closed_form, measured = (
            100 * np.array(values) for values in (one.heights, one.closed_form, one.measured)
        )
        axes.plot(heights, closed_form, color=color, label=f"z - l log(1 + z / l), l = {one.length * 100:g} cm")
        axes.plot(heights[::2], measured[::2], "o", color=color, markersize=4, label="gpdf, measured")
    axes.set(xlabel="height z over a dense plane [cm]", ylabel="reading [cm]", xlim=(0, 20), ylim=(0, 20))
    axes.legend(fontsize=8)
    return figure


def draw_error(shape: Shape) -> Any:
    """Median and middle 90 % of the error by true distance."""
    points, truth = points_around(shape, 40_000, 0.002, 0.20, seed=2)
    centers, radii = splats_on(shape, SPACING, is_inset=False, seed=0)
    edges = np.concatenate([[0.002, 0.005], np.arange(0.01, 0.2001, 0.01)])
    middles = 50 * (edges[:-1] + edges[1:])
    figure, axes = new_figure()
    for name, field in fields(centers, radii, FieldConfig.length_scale).items():
        error = 1e3 * (field.query(points)[0] - truth)
        low, median, high = np.array(
            [np.percentile(error[(truth >= a) & (truth < b)], (5, 50, 95)) for a, b in pairwise(edges)]
        ).T
        style = "--" if name == "safe" else "-"
        axes.plot(middles, median, style, color=COLORS[name], label=name)
        axes.fill_between(middles, low, high, color=COLORS[name], alpha=0.18, linewidth=0)
    axes.axhline(0, color=COLORS["truth"], linewidth=0.8)
    axes.set(xlabel="true distance [cm]", ylabel="error [mm], median and 5 to 95 %", xlim=(0, 20))
    axes.legend(fontsize=8)
    return figure


def draw_levels(shape: Shape) -> Any:
    """Draw each field's 5 cm level in a vertical cut through box, table and cylinder."""
    centers, radii = splats_on(shape, SPACING, is_inset=True, seed=0)
    x, z = np.meshgrid(np.linspace(-0.5, 0.4, 361), np.linspace(-0.12, 0.36, 193))
    points = np.stack([x.ravel(), np.full(x.size, 0.13), z.ravel()], axis=1)
    truth = shape.signed(points)
    figure, axes = new_figure()
    axes.contourf(100 * x, 100 * z, truth.reshape(x.shape), levels=[-1, 0], colors=["#cccccc"])
    axes.contour(100 * x, 100 * z, truth.reshape(x.shape), levels=[0.05], colors=COLORS["truth"], linewidths=2.5)
    readings = {"truth": truth}
    for name, field in fields(centers, radii, FieldConfig.length_scale).items():
        readings[name] = np.where(truth > 0, field.query(points)[0], -0.01)  # a shell: nothing to see inside
        style = "dashed" if name == "safe" else "solid"
        axes.contour(
            *(100 * x, 100 * z, readings[name].reshape(x.shape)),
            levels=[0.05],
            colors=COLORS[name],
            linewidths=1.2,
            linestyles=style,
        )
    for name in readings:
        axes.plot([], [], color=COLORS[name], label=name, linestyle="dashed" if name == "safe" else "solid")
    axes.set(xlabel="x [cm]", ylabel="z [cm]", aspect="equal")
    axes.legend(fontsize=8, loc="upper right", title="reads 5 cm", title_fontsize=8)
    return figure


def draw_lone_splat() -> Any:
    """Draw each field's values towards a splat that floats before a wall."""
    figure, panels = new_figure(columns=2)
    steps = np.linspace(0.0, 0.15, 151)
    points = np.stack([steps, np.zeros_like(steps), np.zeros_like(steps)], axis=1)
    for axes, (wall, spacing) in zip(panels, ((0.04, 0.005), (0.08, 0.005)), strict=True):
        centers, radii = lone_splat(wall, wall_spacing=spacing, radius=0.0)
        for name, field in fields(centers, radii, FieldConfig.length_scale).items():
            style = "--" if name == "safe" else "-"
            axes.plot(100 * steps, 100 * field.query(points)[0], style, color=COLORS[name], label=name)
        axes.set(xlabel="distance to the splat [cm]", title=f"wall {wall * 100:g} cm behind it", xlim=(0, 15))
        axes.title.set_fontsize(9)
    panels[0].set(ylabel="reading [cm]")
    panels[0].legend(fontsize=8)
    return figure


def draw_certificate() -> Any:
    """Draw, along a line past a few balls: exact distance, interpolated sdf, bound of the cell, certified."""
    centers = np.array([[0.03, 0.0, 0.0], [0.13, 0.03, 0.012], [0.19, -0.02, 0.0]])
    radii = np.array([0.012, 0.006, 0.02])
    grid = bake(
        splat_set(centers, radii),
        Box(lower=np.array([-0.043, -0.147, -0.146]), upper=np.array([0.27, 0.15, 0.15])),
        FieldConfig(),
    )
    steps = np.linspace(-0.02, 0.25, 1081)
    points = np.stack([steps, np.full_like(steps, 0.021), np.full_like(steps, 0.013)], axis=1)
    nearest = np.rint((points - grid.origin) / grid.voxel).astype(np.int64)
    bound = np.asarray(grid.channels["bound"][tuple(nearest.T)], dtype=np.float64)
    curves: dict[str, tuple[Float64, str]] = {
        "exact distance to the splats": (exact_distance(points, centers, radii), COLORS["truth"]),
        "sdf, interpolated": (GridField(grid).query(points)[0], COLORS["se"]),
        "certified": (GridField(grid).certified(points), COLORS["safe"]),
        "bound of the nearest cell": (bound, COLORS["hard"]),
    }
    figure, axes = new_figure()
    for name, (values, color) in curves.items():
        axes.plot(100 * steps, 100 * values, color=color, label=name, linewidth=1.2)
    axes.axhline(0, color="#999999", linewidth=0.6)
    axes.set(xlabel="along a line past three balls [cm], cells of 2 cm", ylabel="distance [cm]", xlim=(-2, 25))
    axes.legend(fontsize=8)
    return figure


def fields(centers: Float64, radii: Float64, length: float) -> dict[str, DistanceField]:
    """The four fields with the default weights."""
    exact, kernel = (
        SphereField(Spheres.of(centers, radii)),
        SeField(Spheres.of(centers, radii), FieldConfig(length_scale=length)),
    )
    return {
        "hard": exact,
        "gpdf": GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=length)),
        "se": kernel,
        "safe": SafeField(exact, kernel),
    }


def new_figure(columns: int = 1) -> tuple[Any, Any]:
    """A figure without a window, and its axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns, sharey=True)
