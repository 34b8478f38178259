"""Pictures of a baked field: slices, gradient, collision probability and its reliability."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.libraries import mpl
from splatctrl_cli.records import Bool, DistanceGrid, Float64
from splatctrl_cli.report.pictures import (
    CONTOURS,
    CURVE_COLORS,
    INK,
    SPHERE_EDGE,
    SPHERE_FILL,
    WIDTH,
    draw_distance,
    draw_never_seen,
    drawn_figure,
    extent_of,
    set_grid,
)
from splatctrl_cli.voxels import VoxelState

MAX_LENGTH = 1.5  # of a gradient, top of its colour bar
BAR, MARK = "#0072b2", "#d55e00"


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Every `step`-th cell of a plane across `axis`, with coordinates [m]."""

    axis: int
    index: int
    step: int
    plane: float
    coordinates: tuple[Float64, Float64]
    voxel: float

    def of(self, grid: DistanceGrid, channel: str) -> Float64:
        """The channel in the plane; rows run upwards along the second axis."""
        where: list[Any] = [slice(None, None, self.step)] * 3
        where[self.axis] = self.index
        return np.asarray(np.swapaxes(grid.channels[channel][tuple(where)], 0, 1), np.float64)


def slices_picture(path: Path, grid: DistanceGrid, point: Sequence[float]) -> None:
    """Write slices of `sdf` through the cell nearest to `point` [m].

    Contour lines at 0, 2, 5 and 10 cm; never-seen space is veiled and hatched.
    """
    never = "; hatched: never seen" if _knows_seen(grid) else ""
    lines = ", ".join(f"{100 * level:g}" for level in CONTOURS)
    field = grid.header.get("sdf", "positive outside")
    with _panels(path, grid, point) as (figure, panels):
        for axes, cut in panels:
            image = draw_distance(axes, cut.coordinates, cut.of(grid, "sdf"), cut.voxel, names_lines=False)
            if _knows_seen(grid):
                draw_never_seen(axes, cut.coordinates, cut.of(grid, "observed") == VoxelState.NEVER_SEEN, cut.voxel)
        figure.colorbar(image, ax=[axes for axes, _ in panels], extend="both", label="distance [cm]", pad=0.01)
        figure.suptitle(f"Distance in world: {field}; lines at {lines} cm{never}", fontsize=12)


def field_slice_picture(
    path: Path, grid: DistanceGrid, height: float, spheres: tuple[Float64, Float64], title: str
) -> None:
    """Write the slice of `sdf` nearest to z = `height` [m]; needs channel `observed`.

    Contour lines at 0, 2, 5 and 10 cm; never-seen space is hatched; `spheres` (centres (S, 3), radii (S,)) [m] show
    as circles. Raises NotEvaluableError for a height outside the grid.
    """
    first, num = float(grid.origin[2]), grid.channels["sdf"].shape[2]
    refuse_if(
        not 0 <= round((height - first) / grid.voxel) < num,
        f"{path}: slice z = {height:g} m: expected {first:.3f} to {first + grid.voxel * (num - 1):.3f} m",
        error=NotEvaluableError,
    )
    (cut,) = _cuts(grid, [height] * 3, axes=(2,))
    sides = [float(np.ptp(c)) + cut.voxel for c in cut.coordinates]
    with drawn_figure(path, float(np.clip((WIDTH - 2.6) * sides[1] / sides[0] + 1.5, 4.5, 12.0))) as figure:
        axes = figure.subplots()
        image = draw_distance(axes, cut.coordinates, cut.of(grid, "sdf"), cut.voxel)
        figure.colorbar(image, ax=axes, extend="both", label="distance [cm]", fraction=0.05, pad=0.02)
        draw_never_seen(axes, cut.coordinates, cut.of(grid, "observed") == VoxelState.NEVER_SEEN, cut.voxel)
        _draw_cut_spheres(axes, spheres, cut)
        entries = [
            mpl.patches.Patch(facecolor=SPHERE_FILL, edgecolor=SPHERE_EDGE, label="robot spheres, cut by the plane"),
            mpl.patches.Patch(facecolor="#eeeeee", edgecolor="#a8a8a8", hatch="////", label="never seen"),
        ]
        axes.legend(handles=entries, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2)
        _label(axes, cut)
        axes.set_title(f"{title}   z = {cut.plane:.2f} m", pad=12)


def _draw_cut_spheres(axes: Any, spheres: tuple[Float64, Float64], cut: Cut) -> None:
    centers, radii = spheres
    first, second = (other for other in range(3) if other != cut.axis)
    squared = np.square(radii) - np.square(centers[:, cut.axis] - cut.plane)
    for center, radius in zip(centers[squared > 0], np.sqrt(squared[squared > 0]), strict=True):
        axes.add_patch(
            mpl.patches.Circle(
                (center[first], center[second]), radius, facecolor=SPHERE_FILL, edgecolor=SPHERE_EDGE, linewidth=1.2
            )
        )


def probability_picture(path: Path, grid: DistanceGrid, point: Sequence[float]) -> None:
    """Write slices of `probability` through the cell nearest to `point` [m], with the surface."""
    with _panels(path, grid, point) as (figure, panels):
        for axes, cut in panels:
            image = axes.imshow(
                cut.of(grid, "probability"),
                origin="lower",
                extent=extent_of(cut.coordinates, cut.voxel),
                cmap="cividis",
                vmin=0.0,
                vmax=1.0,
                interpolation="nearest",
            )
            _surface(axes, cut, grid, "white")
        figure.colorbar(image, ax=[axes for axes, _ in panels], label="probability of collision", pad=0.01)
        figure.suptitle(f"Probability of collision, {grid.header.get('probability', '')}; white line: sdf = 0")


def gradient_picture(
    path: Path, grid: DistanceGrid, histogram: Sequence[int], bin_width: float, point: Sequence[float]
) -> None:
    """Write the gradient's length in a slice across z, and its histogram over the grid.

    histogram: number of cells by length. Bin k is about k times `bin_width`, the last also above.
    """
    (cut,) = _cuts(grid, point, axes=(2,))
    sides = [float(np.ptp(c)) + cut.voxel for c in cut.coordinates]
    height = float(np.clip(0.5 * (WIDTH - 2.5) * sides[1] / sides[0] + 1.2, 4.0, 8.0))
    with drawn_figure(path, height) as figure:
        left, right = figure.subplots(1, 2)
        image = left.imshow(
            np.linalg.norm(cut.of(grid, "gradient"), axis=2),
            origin="lower",
            extent=extent_of(cut.coordinates, cut.voxel),
            cmap="RdBu_r",
            vmin=2.0 - MAX_LENGTH,
            vmax=MAX_LENGTH,
            interpolation="nearest",
        )
        _surface(left, cut, grid, INK)
        figure.colorbar(image, ax=left, extend="both", label="length of the gradient", fraction=0.05, pad=0.02)
        _label(left, cut)
        _draw_histogram(right, histogram, bin_width)


def _draw_histogram(axes: Any, histogram: Sequence[int], bin_width: float) -> None:
    shares = 100.0 * np.asarray(histogram) / max(1, sum(histogram))
    middles = bin_width * np.arange(len(shares))
    axes.bar(middles, shares, width=bin_width, color=BAR, edgecolor="white", linewidth=0.5)
    axes.axvline(1.0, color=MARK, linewidth=1.5, linestyle=(0, (6, 3)))
    axes.annotate(
        "a distance: 1", (1.0, 1.0), xycoords=("data", "axes fraction"), xytext=(6, -6), textcoords="offset points",
        va="top", color=MARK,
    )  # fmt: skip
    axes.set_yscale("symlog", linthresh=0.01)
    ticks = [0, 0.01, 0.1, 1, 10, 100]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_ylim(0.0, 130.0)
    axes.set(
        xlabel="length of the gradient (last bar: and longer)",
        ylabel="cells [%]",
        xlim=(-bin_width, middles[-1] + bin_width),
    )
    axes.set_title("All cells by the length of their gradient", pad=12)
    set_grid(axes)


@contextmanager
def _panels(
    path: Path, grid: DistanceGrid, point: Sequence[float]
) -> Iterator[tuple["mpl.figure.Figure", list[tuple[Any, Cut]]]]:
    cuts = _cuts(grid, point, axes=(2, 1, 0))
    sides = np.array([[float(np.ptp(c)) + cut.voxel for c in cut.coordinates] for cut in cuts])
    height = float(np.clip((WIDTH - 3.2) * sides[:, 1].max() / sides[:, 0].sum() + 1.5, 3.2, 9.0))
    with drawn_figure(path, height) as figure:
        panels = figure.subplots(1, 3, gridspec_kw={"width_ratios": sides[:, 0]})
        for axes, cut in zip(panels, cuts, strict=True):
            _label(axes, cut)
        yield figure, list(zip(panels, cuts, strict=True))


def _cuts(grid: DistanceGrid, point: Sequence[float], *, axes: Sequence[int]) -> list[Cut]:
    shape = grid.channels["sdf"].shape
    cuts = []
    for axis in axes:
        index = int(np.clip(round((point[axis] - float(grid.origin[axis])) / grid.voxel), 0, shape[axis] - 1))
        first, second = (other for other in range(3) if other != axis)
        step = max(1, -(-max(shape[first], shape[second]) // 600))
        right, up = (grid.origin[i] + grid.voxel * np.arange(0, shape[i], step) for i in (first, second))
        cuts.append(
            Cut(
                axis=axis,
                index=index,
                step=step,
                plane=float(grid.origin[axis]) + grid.voxel * index,
                coordinates=(right, up),
                voxel=step * grid.voxel,
            )
        )
    return cuts


def _label(axes: Any, cut: Cut) -> None:
    right, up = (name for name in "xyz" if name != "xyz"[cut.axis])
    axes.set(xlabel=f"{right} [m]", ylabel=f"{up} [m]", aspect="equal")
    axes.set_title(f"{'xyz'[cut.axis]} = {round(cut.plane, 2) + 0.0:.2f} m", pad=8)


def _knows_seen(grid: DistanceGrid) -> bool:
    return "observed" in grid.channels and "no occupancy" not in str(grid.header.get("observed"))


def _surface(axes: Any, cut: Cut, grid: DistanceGrid, color: str) -> None:
    sdf = cut.of(grid, "sdf")
    known = sdf[np.isfinite(sdf)]
    if known.size and known.min() < 0 < known.max() and min(sdf.shape) > 1:
        axes.contour(*cut.coordinates, sdf, levels=[0.0], colors=color, linewidths=1.5)


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """B bins of probability: edges (B + 1,), mean prediction, collided share, count (B,).

    Empty bins have NaN. calibration_error: mean |predicted - observed|, weighted by count.
    """

    edges: Float64
    predicted: Float64
    observed: Float64
    count: NDArray[np.int64]
    calibration_error: float


def reliability(probability: Float64, is_colliding: Bool, bins: int = 10) -> Reliability:
    """Collision rates of points (Q,) by predicted probability.

    Raises NotEvaluableError without points, UsageError for a probability outside [0, 1].
    """
    refuse_if(not len(probability), "reliability: expected at least one point, got none", error=NotEvaluableError)
    if not ((probability >= 0) & (probability <= 1)).all():
        i = int(np.argmin((probability >= 0) & (probability <= 1)))
        raise UsageError(f"reliability: point {i}: expected a probability in [0, 1], got {probability[i]}")
    which = np.minimum((probability * bins).astype(np.int64), bins - 1)
    count = np.bincount(which, minlength=bins)
    total, collided = (
        np.bincount(which, weights=values, minlength=bins)
        for values in (probability, is_colliding.astype(np.float64))
    )
    return Reliability(
        edges=np.linspace(0.0, 1.0, bins + 1),
        predicted=np.divide(total, count, out=np.full(bins, np.nan), where=count > 0),
        observed=np.divide(collided, count, out=np.full(bins, np.nan), where=count > 0),
        count=count,
        calibration_error=float(np.abs(total - collided).sum() / len(probability)),
    )


def reliability_picture(path: Path, curves: Mapping[str, Reliability], title: str = "Reliability") -> None:
    """Write each curve's collided share over predicted probability, and points per bin.

    A calibrated probability lies on the diagonal.
    """
    with drawn_figure(path, 5.6) as figure:
        axes, bars = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1, 1]})
        axes.plot([0, 1], [0, 1], color=INK, linewidth=1.0, linestyle=(0, (6, 3)))
        axes.annotate(
            "as predicted", (0.42, 0.36), rotation=45, rotation_mode="anchor", color=INK, fontsize=10, va="top"
        )
        for index, (name, curve) in enumerate(curves.items()):
            color = CURVE_COLORS[index % len(CURVE_COLORS)]
            axes.plot(
                curve.predicted,
                curve.observed,
                "o-",
                color=color,
                linewidth=1.8,
                label=f"{name}  calibration error {curve.calibration_error:.3f}",
            )
            width = np.diff(curve.edges) / (len(curves) + 1)
            bars.bar(curve.edges[:-1] + (index + 1) * width, curve.count, width, color=color)
        axes.set(xlabel="predicted probability", ylabel="share that collides", xlim=(0, 1), ylim=(-0.02, 1.02))
        axes.set_aspect("equal")
        axes.set_title(title, pad=12)
        bars.set(xlabel="predicted probability", ylabel="points", xlim=(0, 1), yscale="log")
        for panel in (axes, bars):
            set_grid(panel, "both")
        figure.legend(frameon=False, loc="outside lower center", ncols=2)
