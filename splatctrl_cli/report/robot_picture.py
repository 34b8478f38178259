"""The picture of a robot's spheres over its shapes, from three sides."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.geometry import face_normals
from splatctrl_cli.libraries import mpl
from splatctrl_cli.records import Bool, Float64
from splatctrl_cli.report.pictures import INK, SPHERE_EDGE, drawn_figure, save_figure
from splatctrl_cli.robot.coverage import areas, refined

VIEWS = (  # title, axis to the right, axis upwards, where the viewer stands
    ("from the side", 0, 2, np.array([0.0, -1.0, 0.0])),
    ("from the front", 1, 2, np.array([1.0, 0.0, 0.0])),
    ("from above", 0, 1, np.array([0.0, 0.0, 1.0])),
)
BODY, UNCOVERED = np.array([0.66, 0.74, 0.79]), np.array([0.84, 0.37, 0.0])
SPHERE = "#e69f0020"
EDGE = 0.02  # [m] of empty space around all


def robot_picture(path: Path, surfaces: Sequence[Float64], centers: Float64, radii: Float64) -> None:
    """Write a PNG of three views along the axes: the shapes, shaded, their uncovered parts, the spheres as discs.

    surfaces: triangles (F, 3, 3) [m]; centers (S, 3) [m], radii (S,) [m], all in one frame.
    """
    triangles = np.concatenate([refined(surface, 0.01)[0] for surface in surfaces])
    triangles = triangles[areas(triangles) > 0]
    is_bare = _is_outside(triangles.mean(axis=1), centers, radii)
    corners = [triangles.reshape(-1, 3), centers - radii[:, None], centers + radii[:, None]]
    lower = np.min([points.min(axis=0) for points in corners], axis=0) - EDGE
    upper = np.max([points.max(axis=0) for points in corners], axis=0) + EDGE
    with drawn_figure(6.0) as figure:
        widths = [float(upper[across] - lower[across]) for _, across, _, _ in VIEWS]
        axes = figure.subplots(1, len(VIEWS), width_ratios=widths)
        for view, (title, across, along, viewer) in zip(axes, VIEWS, strict=True):
            _draw_shapes(view, triangles, is_bare, (across, along), viewer)
            _draw_spheres(view, centers[:, [across, along]], radii)
            view.set(xlim=(lower[across], upper[across]), ylim=(lower[along], upper[along]), aspect="equal")
            view.set(title=title, xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[along]} [m]")
        figure.suptitle(
            f"{len(radii)} spheres; red: surface outside the spheres of every link, in this posture", color=INK
        )
        save_figure(figure, path)


def _draw_shapes(view: Any, triangles: Float64, is_bare: Bool, plane: tuple[int, int], viewer: Float64) -> None:
    """Triangles painted from far to near, lit from the viewer."""
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


def _draw_spheres(view: Any, centers: Float64, radii: Float64) -> None:
    view.add_collection(
        mpl.collections.EllipseCollection(
            2 * radii,
            2 * radii,
            np.zeros(len(radii)),
            units="xy",
            offsets=centers,
            offset_transform=view.transData,
            facecolors=SPHERE,
            edgecolors=SPHERE_EDGE,
            linewidths=0.7,
        )
    )


def _is_outside(points: Float64, centers: Float64, radii: Float64) -> Bool:
    outside = np.ones(len(points), dtype=np.bool_)
    for center, radius in zip(centers, radii, strict=True):
        outside &= np.linalg.norm(points - center, axis=1) > radius
    return outside
