"""Pictures of single studies: panels of trials by method, reliability curves, spheres over shapes, a planner's trial.

M methods, T trials. A trial is rendered by the kernel that renders a robot's own surface, in flat colours with few
shades, so that a file is small.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.geometry import back_project, face_normals, invert_transform, look_at, project, transform_points
from splatctrl_cli.libraries import mpl
from splatctrl_cli.records import Bool, Float32, Float64, Intrinsics
from splatctrl_cli.report.pictures import CURVE_COLORS, INK, SPHERE_EDGE, drawn_figure, save_figure, set_grid
from splatctrl_cli.robot.coverage import areas, refined
from splatctrl_cli.robot.surface import RobotSurface

HEIGHT = 4.6  # inches
SPREAD = 0.16  # of the space between two methods, over which the trials of one lie


@dataclass(frozen=True, kw_only=True)
class Panel:
    """values (T, M) of the trials by method, NaN where a method has none; level: a value to draw a line at, and what
    it is.
    """

    title: str
    values: Float64
    level: tuple[float, str] | None = None


def trials_picture(
    path: Path, methods: Sequence[str], panels: Sequence[Panel], groups: Sequence[str], title: str
) -> None:
    """Write panels side by side; groups (T,): what the trials are told apart by, a colour each."""
    colors = dict(zip(dict.fromkeys(groups), CURVE_COLORS, strict=False))
    with drawn_figure(HEIGHT) as figure:
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            _draw(axes, panel, methods, [colors[group] for group in groups])
        figure.suptitle(title, fontsize=12, x=0.01, ha="left")
        if len(colors) > 1:
            marks = [mpl.lines.Line2D([], [], color=color, marker="o", label=name) for name, color in colors.items()]
            figure.legend(handles=marks, frameon=False, loc="outside lower center", ncols=len(colors))
        save_figure(figure, path)


def _draw(axes: "mpl.axes.Axes", panel: Panel, methods: Sequence[str], colors: Sequence[str]) -> None:
    num = len(methods)
    middles = np.arange(1, num + 1)
    shift = SPREAD * np.linspace(-1, 1, len(panel.values)) if len(panel.values) > 1 else np.zeros(1)
    for values, by, color in zip(panel.values, shift, colors, strict=True):
        axes.plot(middles + by, values, "o-", color=color, alpha=0.55, linewidth=0.6, markersize=3.5)
    line: dict[str, Any] = {"color": INK, "linewidth": 1.2}
    axes.boxplot(
        [column[np.isfinite(column)] for column in panel.values.T],
        positions=middles,
        widths=0.5,
        showfliers=False,
        medianprops=line | {"linewidth": 2.2},
        boxprops=line,
        whiskerprops=line,
        capprops=line,
    )
    if panel.level is not None:
        value, words = panel.level
        axes.axhline(value, color=INK, linestyle=":", linewidth=1)
        axes.annotate(words, (0.5, value), (0, 3), textcoords="offset points", fontsize=9)
    axes.set_xticks(middles, methods, fontsize=9)
    axes.set_xlim(0.5, num + 0.5)
    low, high = axes.get_ylim()
    axes.set_ylim(min(0.0, low), high)
    axes.set_title(panel.title, fontsize=10, pad=6)
    axes.spines[["top", "right"]].set_visible(False)


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """Of B bins of predicted probability: edges (B + 1,), mean prediction (B,) and share that collided (B,), NaN in
    an empty bin, count (B,); calibration_error is the mean of their difference, weighted by count.
    """

    edges: Float64
    predicted: Float64
    observed: Float64
    count: NDArray[np.int64]
    calibration_error: float


def reliability(probability: Float64, is_colliding: Bool, bins: int = 10) -> Reliability:
    """How often points (Q,) of a predicted probability do collide; bins equal in width.

    Raises NotEvaluableError without points, UsageError for a probability outside [0, 1].
    """
    if not len(probability):
        raise NotEvaluableError("reliability: expected at least one point, got none")
    if not ((probability >= 0) & (probability <= 1)).all():
        i = int(np.argmin((probability >= 0) & (probability <= 1)))
        raise UsageError(f"reliability: point {i}: expected a probability in [0, 1], got {probability[i]}")
    edges = np.linspace(0.0, 1.0, bins + 1)
    which = np.minimum((probability * bins).astype(np.int64), bins - 1)
    count = np.bincount(which, minlength=bins)
    total, collided = (
        np.bincount(which, weights=values, minlength=bins)
        for values in (probability, is_colliding.astype(np.float64))
    )
    return Reliability(
        edges=edges,
        predicted=np.divide(total, count, out=np.full(bins, np.nan), where=count > 0),
        observed=np.divide(collided, count, out=np.full(bins, np.nan), where=count > 0),
        count=count,
        calibration_error=float(np.abs(total - collided).sum() / len(probability)),
    )


def reliability_picture(path: Path, curves: Mapping[str, Reliability], title: str = "Reliability") -> None:
    """Write the share that collided over the predicted probability, a curve a form, and how many points each bin has.

    A probability that means what it says lies on the diagonal.
    """
    with drawn_figure(5.6) as figure:
        axes, bars = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1, 1]})
        axes.plot([0, 1], [0, 1], color=INK, linewidth=1.0, linestyle=(0, (6, 3)))
        axes.annotate(
            "as predicted", (0.42, 0.36), rotation=45, rotation_mode="anchor", color=INK, fontsize=10, va="top"
        )
        for index, (name, curve) in enumerate(curves.items()):
            color = CURVE_COLORS[index % len(CURVE_COLORS)]
            label = f"{name}  calibration error {curve.calibration_error:.3f}"
            axes.plot(curve.predicted, curve.observed, "o-", color=color, linewidth=1.8, label=label)
            width = np.diff(curve.edges) / (len(curves) + 1)
            bars.bar(curve.edges[:-1] + (index + 1) * width, curve.count, width, color=color)
        axes.set(xlabel="predicted probability", ylabel="share that collides", xlim=(0, 1), ylim=(-0.02, 1.02))
        axes.set_aspect("equal")
        axes.set_title(title, pad=12)
        bars.set(xlabel="predicted probability", ylabel="points", xlim=(0, 1), yscale="log")
        for panel in (axes, bars):
            set_grid(panel, "both")
        figure.legend(frameon=False, loc="outside lower center", ncols=2)
        save_figure(figure, path)


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
    size = 2 * radii
    discs = mpl.collections.EllipseCollection(
        size,
        size,
        np.zeros(len(radii)),
        units="xy",
        offsets=centers,
        offset_transform=view.transData,
        facecolors=SPHERE,
        edgecolors=SPHERE_EDGE,
        linewidths=0.7,
    )
    view.add_collection(discs)


def _is_outside(points: Float64, centers: Float64, radii: Float64) -> Bool:
    outside = np.ones(len(points), dtype=np.bool_)
    for center, radius in zip(centers, radii, strict=True):
        outside &= np.linalg.norm(points - center, axis=1) > radius
    return outside


THING, UNSEEN, MAP, START, GOAL = "thing", "never measured", "map", "start", "goal"
ARM, TOUCHED, WAY, CAMERA = "arm here", "sphere named above", "way of the tip", "camera"
COLORS = {
    THING: "#b9c3cb",
    UNSEEN: "#e69f00",
    MAP: "#009e73",
    START: "#56b4e9",
    GOAL: "#cc79a7",
    ARM: "#7a8288",
    TOUCHED: "#d00000",
    WAY: "#111111",
    CAMERA: "#0072b2",
}
SIZE = (520, 400)  # [px] of a view
SHADES, LIGHT_SHADES = 5, 2  # of a colour, by how a surface is turned; of what shines through
SHOWN = 0.45  # of what shines through: the map, the start and the goal
NEAREST = 0.4  # of the way to the place: what is light and nearer to the eye would veil the picture
LENS = Intrinsics(fx=480.0, fy=480.0, cx=(SIZE[0] - 1) / 2, cy=(SIZE[1] - 1) / 2, width=SIZE[0], height=SIZE[1])


@dataclass(frozen=True, kw_only=True)
class TrialScene:
    """Surfaces in the world frame, each link of the name of a colour: solid ones, and light ones that shine through
    where they are nearer. is_seen: whether a camera measured something at points (Q, 3); place (3,) [m]: what to
    look at; cameras (C, 3) [m].
    """

    solid: RobotSurface
    light: Sequence[RobotSurface]
    is_seen: Callable[[Float64], Sequence[bool]]
    place: Float64
    cameras: Float64


def trial_picture(path: Path, scene: TrialScene, views: Sequence[tuple[str, Float64, Float64]], caption: str) -> None:
    """Write views side by side, each a title, its eye (3,) and what it looks at (3,) [m]; the caption above."""
    with drawn_figure(6.2) as figure:
        for axes, (title, eye, target) in zip(figure.subplots(1, len(views)), views, strict=True):
            T_world_camera = look_at(eye, target)
            axes.imshow(_rendered(scene, T_world_camera), interpolation="nearest")
            _mark(axes, scene, T_world_camera)
            axes.set_title(title, fontsize=10, pad=5)
            axes.set(xticks=[], yticks=[], xlim=(-0.5, SIZE[0] - 0.5), ylim=(SIZE[1] - 0.5, -0.5))
        figure.suptitle(caption, fontsize=10, x=0.01, ha="left")
        marks = [mpl.patches.Patch(color=color, label=name) for name, color in COLORS.items()]
        figure.legend(handles=marks, frameon=False, fontsize=9, loc="outside lower center", ncols=len(marks))
        save_figure(figure, path, caption)


def _rendered(scene: TrialScene, T_world_camera: Float64) -> Float64:
    """RGB (H, W, 3) in [0, 1]."""
    depth, color = _layer(scene.solid, T_world_camera, SHADES, scene.is_seen)
    nearest = NEAREST * float(np.linalg.norm(scene.place - T_world_camera[:3, 3]))
    for surface in scene.light:
        nearer, tint = _layer(surface, T_world_camera, LIGHT_SHADES)
        is_before = (nearer > nearest) & ((depth == 0) | (nearer < depth))
        color[is_before] = (1 - SHOWN) * color[is_before] + SHOWN * tint[is_before]
    return color


def _layer(
    surface: RobotSurface,
    T_world_camera: Float64,
    shades: int,
    is_seen: Callable[[Float64], Sequence[bool]] | None = None,
) -> tuple[Float32, Float64]:
    """depth (H, W) [m], 0 = none, and RGB (H, W, 3) of one surface, white where it is not."""
    nothing = np.zeros(SIZE[::-1], np.float32)
    seen = surface.render(np.tile(np.eye(4), (len(surface.links), 1, 1)), LENS, T_world_camera, nothing)
    names = [*surface.links, UNSEEN, "none"]
    number = np.where(seen.link < 0, len(names) - 1, seen.link)
    points = back_project(LENS, seen.depth)
    if is_seen is not None and THING in surface.links:
        is_thing = number == names.index(THING)
        number[is_thing & ~_everywhere(is_seen, transform_points(T_world_camera, points), is_thing)] = len(names) - 2
    palette = np.array([mpl.colors.to_rgb(COLORS.get(name, "#ffffff")) for name in names])
    return seen.depth, palette[number] * np.where(seen.link < 0, 1.0, _shade(points, shades))[..., None]


def _everywhere(is_seen: Callable[[Float64], Sequence[bool]], points_world: Float64, is_asked: Bool) -> Bool:
    """What was seen (H, W) of points (H, W, 3), asked at every second pixel of both directions."""
    coarse = np.ones(is_asked[::2, ::2].shape, bool)
    coarse[is_asked[::2, ::2]] = is_seen(points_world[::2, ::2][is_asked[::2, ::2]])
    return coarse.repeat(2, axis=0).repeat(2, axis=1)[: is_asked.shape[0], : is_asked.shape[1]]


def _shade(points: Float64, shades: int) -> Float64:
    """(H, W) in (0, 1]: bright where a surface faces the camera, in so many steps."""
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(across, down)
    facing = np.abs(np.sum(normal * points, axis=2))
    length = np.linalg.norm(normal, axis=2) * np.linalg.norm(points, axis=2)
    turned = np.divide(facing, length, out=np.zeros_like(facing), where=length > 0)
    return np.asarray(0.45 + 0.55 * np.rint(turned * shades) / shades)


def _mark(axes: "mpl.axes.Axes", scene: TrialScene, T_world_camera: Float64) -> None:
    """A ring about the place, whatever hides it, and the numbers of the cameras that are in the picture."""
    T_camera_world = invert_transform(T_world_camera)
    u, v = project(LENS, transform_points(T_camera_world, scene.place[None])[0])
    axes.plot(u, v, "o", markersize=22, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=1.2)
    for number, eye in enumerate(transform_points(T_camera_world, scene.cameras)):
        if eye[2] > 0:
            u, v = project(LENS, eye)
            axes.annotate(f"cam{number}", (u, v), (6, 4), textcoords="offset points", fontsize=8, clip_on=True)
