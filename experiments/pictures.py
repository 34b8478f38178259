"""Pictures of single studies: panels of trials by method, reliability curves, spheres over shapes, a planner's trial.

M methods, T trials. A trial is rendered by the kernel that renders a robot's own surface, in flat colours with few
shades, so that a file is small.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.blocks import (
    CURVE_COLORS,
    INK,
    Bool,
    Float32,
    Float64,
    Intrinsics,
    RobotSurface,
    back_project,
    drawn_figure,
    invert_transform,
    look_at,
    mpl,
    project,
    transform_points,
)

HEIGHT = 4.6  # inches
SPREAD = 0.16  # of the space between two methods, over which the trials of one lie


@dataclass(frozen=True, kw_only=True)
class Panel:
    """values (T, M) of the trials by method, NaN if missing; level: value of a line to draw, and its name."""

    title: str
    values: Float64
    level: tuple[float, str] | None = None


def trials_picture(
    path: Path, methods: Sequence[str], panels: Sequence[Panel], groups: Sequence[str], title: str
) -> None:
    """Write panels side by side; groups (T,): group of each trial; each group has a colour."""
    colors = dict(zip(dict.fromkeys(groups), CURVE_COLORS, strict=False))
    with drawn_figure(path, HEIGHT) as figure:
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            _draw(axes, panel, methods, [colors[group] for group in groups])
        figure.suptitle(title, fontsize=12, x=0.01, ha="left")
        if len(colors) > 1:
            marks = [mpl.lines.Line2D([], [], color=color, marker="o", label=name) for name, color in colors.items()]
            figure.legend(handles=marks, frameon=False, loc="outside lower center", ncols=len(colors))


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
    """Surfaces in the world frame, each link with the name of a colour. solid: opaque surfaces; light: translucent
    surfaces. is_seen: True for points (Q, 3) that a camera measured; place (3,) [m]: point to look at; cameras (C, 3)
    [m].
    """

    solid: RobotSurface
    light: Sequence[RobotSurface]
    is_seen: Callable[[Float64], Sequence[bool]]
    place: Float64
    cameras: Float64


def trial_picture(path: Path, scene: TrialScene, views: Sequence[tuple[str, Float64, Float64]], caption: str) -> None:
    """Write views side by side, each with title, eye (3,) and target (3,) [m]; the caption is above."""
    with drawn_figure(path, 6.2, caption) as figure:
        for axes, (title, eye, target) in zip(figure.subplots(1, len(views)), views, strict=True):
            T_world_camera = look_at(eye, target)
            axes.imshow(_rendered(scene, T_world_camera), interpolation="nearest")
            _mark(axes, scene, T_world_camera)
            axes.set_title(title, fontsize=10, pad=5)
            axes.set(xticks=[], yticks=[], xlim=(-0.5, SIZE[0] - 0.5), ylim=(SIZE[1] - 0.5, -0.5))
        figure.suptitle(caption, fontsize=10, x=0.01, ha="left")
        marks = [mpl.patches.Patch(color=color, label=name) for name, color in COLORS.items()]
        figure.legend(handles=marks, frameon=False, fontsize=9, loc="outside lower center", ncols=len(marks))


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
    """Seen points (H, W) of points (H, W, 3), evaluated at every second pixel in both directions."""
    coarse = np.ones(is_asked[::2, ::2].shape, bool)
    coarse[is_asked[::2, ::2]] = is_seen(points_world[::2, ::2][is_asked[::2, ::2]])
    return coarse.repeat(2, axis=0).repeat(2, axis=1)[: is_asked.shape[0], : is_asked.shape[1]]


def _shade(points: Float64, shades: int) -> Float64:
    """Brightness (H, W) in (0, 1] in `shades` steps; a surface that faces the camera is bright."""
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(across, down)
    facing = np.abs(np.sum(normal * points, axis=2))
    length = np.linalg.norm(normal, axis=2) * np.linalg.norm(points, axis=2)
    turned = np.divide(facing, length, out=np.zeros_like(facing), where=length > 0)
    return np.asarray(0.45 + 0.55 * np.rint(turned * shades) / shades)


def _mark(axes: "mpl.axes.Axes", scene: TrialScene, T_world_camera: Float64) -> None:
    """Draw a ring about the place, even if hidden, and the numbers of the cameras in the picture."""
    T_camera_world = invert_transform(T_world_camera)
    u, v = project(LENS, transform_points(T_camera_world, scene.place[None])[0])
    axes.plot(u, v, "o", markersize=22, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=1.2)
    for number, eye in enumerate(transform_points(T_camera_world, scene.cameras)):
        if eye[2] > 0:
            u, v = project(LENS, eye)
            axes.annotate(f"cam{number}", (u, v), (6, 4), textcoords="offset points", fontsize=8, clip_on=True)
