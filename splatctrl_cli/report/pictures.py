"""Pictures of renders against photos, slices of a distance field, and shared drawing.

Matplotlib's Figure keeps no global state. Colours are by Okabe and Ito, or maps readable without red and green.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError, refuse_if
from splatctrl_cli.geometry import face_normals
from splatctrl_cli.libraries import mpl
from splatctrl_cli.records import Bool, Float32, Float64, UInt8
from splatctrl_cli.robot.coverage import areas, refine_triangles

WIDTH = 12.0  # inches; at DPI 100 the width is 1200 pixels
DPI = 100
CONTOURS = (0.0, 0.02, 0.05, 0.10)  # [m]
CURVE_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
INK = "#222222"
SPHERE_FILL, SPHERE_EDGE = "#e69f00b0", "#8a5a00"
STYLE: Any = {  # matplotlib types its keys as one long literal
    "font.family": "DejaVu Sans",
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.edgecolor": "#888888",
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "hatch.linewidth": 0.6,
    "hatch.color": "#a8a8a8",
}


@dataclass(frozen=True, kw_only=True)
class ComparisonRow:
    """A view's photo (H, W, 3) uint8, render in [0, 1], and depths (H, W) [m].

    Depth 0 is missing. `figures`: the render's quality in words; mask (H, W): pixels that count.
    """

    title: str
    figures: str = ""
    photo: UInt8
    render: Float32
    photo_depth: Float32
    render_depth: Float32
    mask: NDArray[np.bool_] | None = None


def comparison_picture(path: Path, rows: Sequence[ComparisonRow]) -> None:
    """Write photo | render | depth error [cm], one row per view."""
    refuse_if(not rows, f"{path}: no view to draw: expected at least one, got 0", error=NotEvaluableError)
    height, width = rows[0].photo.shape[:2]
    row_height = (WIDTH - 1.2) / 3 * height / width + 0.42
    with drawn_figure(path, len(rows) * row_height + 0.15) as figure:
        grid = figure.subplots(
            len(rows), 4, squeeze=False, gridspec_kw={"width_ratios": [1, 1, 1, 0.035], "wspace": 0.04}
        )
        for row, axes in zip(rows, grid, strict=True):
            _draw_comparison(figure, axes, row)


def span_of(seconds: Float64) -> tuple[float, float]:
    """First and last time [s] of an axis, never equal."""
    return float(seconds[0]), max(float(seconds[-1]), float(seconds[0]) + 1e-3)


@contextmanager
def drawn_figure(path: Path, height: float, description: str = "") -> Iterator["mpl.figure.Figure"]:
    """Yield a figure, 1200 pixels wide; write it without date when the block ends.

    description: text in the file's metadata.
    """
    with mpl.rc_context(STYLE):
        layout = mpl.layout_engine.ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08)
        figure = mpl.figure.Figure(figsize=(WIDTH, height), dpi=DPI, layout=layout)
        yield figure
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine(None)  # else savefig lays out once more, and draws everything for it
        metadata = {"Software": "splatctrl"} | ({"Description": description} if description else {})
        figure.savefig(path, dpi=DPI, facecolor="white", metadata=metadata)


def _draw_comparison(figure: "mpl.figure.Figure", axes: Sequence[Any], row: ComparisonRow) -> None:
    photo, render, error, bar = axes
    photo.imshow(row.photo, interpolation="nearest")
    render.imshow(np.clip(row.render, 0.0, 1.0), interpolation="nearest")
    image, median = _draw_depth_error(error, row)
    figure.colorbar(image, cax=bar, extend="max", label="cm")
    titles = (f"photo   {row.title}", f"render   {row.figures}", f"depth error [cm]   {median}, grey: no depth")
    for panel, text in zip((photo, render, error), titles, strict=True):
        _finish(panel, text)


def _draw_depth_error(panel: Any, row: ComparisonRow) -> tuple[Any, str]:
    """Draw |render - recorded depth| [cm]; return its median in words."""
    both = (row.photo_depth > 0) & (row.render_depth > 0)
    error = np.where(both, 100.0 * np.abs(row.render_depth - row.photo_depth), np.nan)
    panel.set_facecolor("#d9d9d9")  # not recorded
    image = panel.imshow(error, cmap="cividis", vmin=0.0, vmax=5.0, interpolation="nearest")
    return image, f"median {np.nanmedian(error):.2f} cm" if both.any() else "no pixel has both depths"


def draw_distance(
    axes: Any, coordinates: Sequence[Float64], distance: Float64, voxel: float, *, names_lines: bool = True
) -> Any:
    """Draw a distance [cm] with contour lines; return the image."""
    finite = distance[np.isfinite(distance)]
    limit = 20.0  # [cm]
    image = axes.imshow(
        100.0 * distance,
        origin="lower",
        extent=extent_of(coordinates, voxel),
        cmap=mpl.colors.LinearSegmentedColormap.from_list(  # pale enough for lines and circles on top
            "pale_red_blue", mpl.colormaps["RdBu"](np.linspace(0.18, 0.80, 63))
        ),
        vmin=-limit,
        vmax=limit,
        interpolation="nearest",
    )
    with_lines = [level for level in CONTOURS if finite.size and finite.min() < level < finite.max()]
    if with_lines and min(distance.shape) > 1:
        lines = axes.contour(
            *coordinates,
            distance,
            levels=with_lines,
            colors=INK,
            linewidths=[2.0 if level == 0 else 1.0 for level in with_lines],
            linestyles="solid",
        )
        if names_lines:
            axes.clabel(lines, fmt=lambda level: f"{100 * level:g} cm", fontsize=9)
    return image


def draw_never_seen(axes: Any, coordinates: Sequence[Float64], never_seen: NDArray[np.bool_], voxel: float) -> None:
    if not never_seen.any():
        return
    veil = np.zeros((*never_seen.shape, 4))
    veil[never_seen] = (0.93, 0.93, 0.93, 0.72)
    axes.imshow(veil, origin="lower", extent=extent_of(coordinates, voxel), interpolation="nearest")
    if min(never_seen.shape) > 1:
        axes.contourf(*coordinates, never_seen.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])


def extent_of(coordinates: Sequence[Float64], voxel: float) -> tuple[float, float, float, float]:
    """Left, right, bottom, top [m] of cells with these centres."""
    (left, right), (bottom, top) = ((c[0] - voxel / 2, c[-1] + voxel / 2) for c in coordinates)
    return float(left), float(right), float(bottom), float(top)


HOLE = "#d55e00"  # recorded, but not rendered


def view_picture(path: Path, row: ComparisonRow) -> None:
    """Write photo and render above colour error and depth error, with the mask's outline."""
    height, width = row.photo.shape[:2]
    render = np.clip(row.render, 0.0, 1.0)
    color_error = np.asarray(100.0 * np.abs(render - row.photo / 255.0).mean(axis=2))
    hole = (row.photo_depth > 0) & ~(row.render_depth > 0)
    with drawn_figure(path, 2 * ((WIDTH - 1.9) / 2 * height / width + 0.4) + 0.2) as figure:
        axes = figure.subplots(2, 2)
        axes[0, 0].imshow(row.photo, interpolation="nearest")
        axes[0, 1].imshow(render, interpolation="nearest")
        color = axes[1, 0].imshow(color_error, cmap="cividis", vmin=0.0, vmax=10.0, interpolation="nearest")
        depth, median = _draw_depth_error(axes[1, 1], row)
        axes[1, 1].imshow(np.where(hole[:, :, None], mpl.colors.to_rgba(HOLE), 0.0), interpolation="nearest")
        labels = ("mean of |render - photo| over RGB, % of the range", "|render - recorded depth|, cm")
        for image, panel, label in zip((color, depth), axes[1], labels, strict=True):
            figure.colorbar(image, ax=panel, extend="max", fraction=0.045, pad=0.02, label=label)
        if row.mask is not None:
            _outline(axes.flat, row.mask)
        titles = (
            f"photo   {row.title}" + ("" if row.mask is None else ", outlined: the mask"),
            f"render   {row.figures}",
            f"colour error   mean {color_error.mean():.1f}%",
            f"depth error   {median}; orange: no render, grey: no record",
        )
        for panel, text in zip(axes.flat, titles, strict=True):
            _finish(panel, text)


def _outline(panels: Any, mask: NDArray[np.bool_]) -> None:
    if mask.all() or not mask.any() or min(mask.shape) < 2:
        return
    for panel in panels:
        panel.contour(mask.astype(float), levels=[0.5], colors="#ffffff", linewidths=1.0)


def set_grid(axes: Any, axis: str = "y") -> None:
    """Draw pale grid lines along an axis, or "both"; hide top and right frame."""
    axes.grid(axis=axis, color="#e4e4e4", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _finish(panel: Any, text: str) -> None:
    panel.set_title(text, fontsize=10, pad=5)
    panel.set(xticks=[], yticks=[])
    panel.spines[:].set_visible(False)


VIEWS = (  # title, axis to the right, axis upwards, where the viewer stands
    ("from the side", 0, 2, np.array([0.0, -1.0, 0.0])),
    ("from the front", 1, 2, np.array([1.0, 0.0, 0.0])),
    ("from above", 0, 1, np.array([0.0, 0.0, 1.0])),
)
BODY, UNCOVERED = np.array([0.66, 0.74, 0.79]), np.array([0.84, 0.37, 0.0])
EDGE = 0.02  # [m] of empty space around all


def robot_picture(path: Path, surfaces: Sequence[Float64], centers: Float64, radii: Float64) -> None:
    """Write three axis views: shaded shapes, uncovered parts, spheres as discs.

    surfaces: triangles (F, 3, 3) [m]; centers (S, 3), radii (S,) [m], in one frame.
    """
    triangles = np.concatenate([refine_triangles(surface, 0.01) for surface in surfaces])
    triangles = triangles[areas(triangles) > 0]
    is_bare = _is_outside(triangles.mean(axis=1), centers, radii)
    corners = [triangles.reshape(-1, 3), centers - radii[:, None], centers + radii[:, None]]
    lower = np.min([points.min(axis=0) for points in corners], axis=0) - EDGE
    upper = np.max([points.max(axis=0) for points in corners], axis=0) + EDGE
    with drawn_figure(path, 6.0) as figure:
        widths = [float(upper[across] - lower[across]) for _, across, _, _ in VIEWS]
        axes = figure.subplots(1, len(VIEWS), width_ratios=widths)
        for view, (title, across, along, viewer) in zip(axes, VIEWS, strict=True):
            _draw_shapes(view, triangles, is_bare, (across, along), viewer)
            view.add_collection(
                mpl.collections.EllipseCollection(
                    2 * radii,
                    2 * radii,
                    np.zeros(len(radii)),
                    units="xy",
                    offsets=centers[:, [across, along]],
                    offset_transform=view.transData,
                    facecolors="#e69f0020",
                    edgecolors=SPHERE_EDGE,
                    linewidths=0.7,
                )
            )
            view.set(xlim=(lower[across], upper[across]), ylim=(lower[along], upper[along]), aspect="equal")
            view.set(title=title, xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[along]} [m]")
        figure.suptitle(
            f"{len(radii)} spheres; red: surface outside the spheres of every link, in this posture", color=INK
        )


def _draw_shapes(view: Any, triangles: Float64, is_bare: Bool, plane: tuple[int, int], viewer: Float64) -> None:
    order = np.argsort(triangles.mean(axis=1) @ viewer, kind="stable")
    seen = triangles[order]
    normal = face_normals(seen)
    light = 0.55 + 0.45 * np.abs(normal @ viewer) / np.linalg.norm(normal, axis=1)
    colors = np.where(is_bare[order, None], UNCOVERED, BODY) * light[:, None]
    view.add_collection(
        mpl.collections.PolyCollection(
            list(seen[:, :, list(plane)]), facecolors=colors, edgecolors=colors, linewidths=0.2
        )
    )


def _is_outside(points: Float64, centers: Float64, radii: Float64) -> Bool:
    outside = np.ones(len(points), dtype=np.bool_)
    for center, radius in zip(centers, radii, strict=True):
        outside &= np.linalg.norm(points - center, axis=1) > radius
    return outside
