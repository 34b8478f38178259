"""One self-contained HTML file: verdict, timelines, pictures, tables, and 3-D scenes.

The viewer's three.js is trimesh's. A packed scene is JSON ``{"header": {...}, "bytes": "..."}``, with deflated
base64, and each array's type, first byte and count. Points are 16-bit integers within their box.
"""

import base64
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from splatctrl_cli.errors import UsageError, refuse_faults, require
from splatctrl_cli.kernels.surface_image import BALL, BOX, CAPSULE
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import Float32, Float64, Label, SplatSet, UInt8
from splatctrl_cli.robot.surface import RobotSurface

SIDES = 24  # of a cylinder or capsule as it is drawn


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Triangles: vertices (V, 3) float32 [m], faces (F, 3) uint32."""

    vertices: Float32
    faces: NDArray[np.uint32]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """An arm over T states: seconds (T,) from the first; poses (T, L, 4, 4), world.

    bodies (L): by link, in the link's frame. path (T, 3) [m]: the end effector, world. clearance (T,) [m]: NaN if
    unknown.
    """

    seconds: Float64
    bodies: dict[str, Surface]
    poses: Float64
    path: Float64
    clearance: Float64
    margin: float


@dataclass(frozen=True, kw_only=True)
class Space:
    """Content of a 3-D page, world [m].

    splats: by motion time [s] from which they were known, the first from the start. unknown: centres (K, 3) and edge
    of cubes without evidence, by evidence class. surface: where a baked distance is 0. deciding: the event's
    sentence, time [s] and place, with center and radius [m] of the arm's sphere. cameras: each one's name, place
    `eye` [m], unit vector `ahead` and vertical angle `fov` [degrees].
    """

    splats: Mapping[float, SplatSet] = field(default_factory=dict)
    unknown: Mapping[str, tuple[Float32, float]] = field(default_factory=dict)
    surface: Surface | None = None
    motion: Motion | None = None
    deciding: Mapping[str, Any] | None = None
    cameras: Sequence[Mapping[str, Any]] = ()

    def box(self) -> tuple[Float64, Float64]:
        """Lower and upper corner (3,) of 90 % of splats, path and surface."""
        parts = [np.asarray(splats.centers, np.float64) for splats in self.splats.values()]
        if self.motion is not None:
            parts += [self.motion.path, self.motion.poses[:, :, :3, 3].reshape(-1, 3)]
        if self.surface is not None:
            parts.append(np.asarray(self.surface.vertices, np.float64))
        points = np.concatenate([np.zeros((0, 3)), *parts])
        if not len(points):
            return np.full(3, -0.5), np.full(3, 0.5)
        lower, upper = np.percentile(points, [5, 95], axis=0)
        return lower, upper


def bodies_of(surface: RobotSurface) -> dict[str, Surface]:
    """A robot's collision geometry by link, as triangles in the link's frame."""
    parts: dict[str, list[trimesh.Trimesh]] = {}
    for kind, size, T, link in zip(
        surface.kinds, surface.sizes, surface.T_link_solid, surface.solid_links, strict=True
    ):
        parts.setdefault(surface.links[link], []).append(_primitive(kind, size).apply_transform(T))
    for number in np.unique(surface.triangle_links):
        mesh = trimesh.Trimesh(
            **trimesh.triangles.to_kwargs(surface.triangles[surface.triangle_links == number]), process=True
        )
        parts.setdefault(surface.links[number], []).append(mesh)
    whole = {link: trimesh.util.concatenate(meshes) for link, meshes in parts.items()}
    return {
        link: Surface(vertices=np.asarray(mesh.vertices, np.float32), faces=np.asarray(mesh.faces, np.uint32))
        for link, mesh in whole.items()
    }


def _primitive(kind: float, size: Float64) -> "trimesh.Trimesh":
    """Mesh.

    size (3,): half edges of a box; radius, half length of a cylinder or capsule; radius of a ball.
    """
    if kind == BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == BALL:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == CAPSULE:
        capsule = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[SIDES, SIDES // 2])
        return capsule.apply_translation([0.0, 0.0, -capsule.bounds.mean(axis=0)[2]])
    return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=SIDES)


def coarsen(is_unknown: NDArray[np.bool_], origin: Float64, voxel: float, most: int) -> tuple[Float32, float]:
    """Centres (K, 3) and edge [m] of at most `most` cubes on unknown space's border.

    A cube of several cells is unknown if half of them are.
    """
    factor = 1
    while True:
        shape = np.array(is_unknown.shape) // factor
        blocks = is_unknown[tuple(slice(0, n * factor) for n in shape)]
        cells = blocks.reshape(shape[0], factor, shape[1], factor, shape[2], factor)
        full = 2 * cells.sum(axis=(1, 3, 5), dtype=np.int32) >= factor**3
        if len(borders := np.argwhere(full & ~binary_erosion(full, border_value=1))) <= most:
            return np.asarray(origin + voxel * (factor * borders + (factor - 1) / 2), np.float32), factor * voxel
        factor += 1


STEPS = 65535  # of a number of 16 bits


def three_js() -> str:
    """The source of three.js, deflated, base64. Raises UsageError if trimesh has none."""
    with refuse_faults(
        "three.js: not found in trimesh",
        *(OSError, KeyError, ValueError),
        remedy="pip install 'trimesh>=4.4,<6'",
        error=UsageError,
    ):
        archive = trimesh.util.decompress(trimesh.resources.get_bytes("templates/viewer.zip"), file_type="zip")
        page = archive["viewer.html.template"].read().decode("utf-8")
        # three.js ends where trimesh's own script begins
        script = page[page.index("<script>") + len("<script>") : page.index("var camera,controls")]
    return _deflate(script.encode("utf-8"))


def pack(space: Space) -> str:
    block = bytearray()
    lower, upper = space.box()
    header: dict[str, Any] = {
        "middle": ((lower + upper) / 2).tolist(),
        "size": max(float(np.linalg.norm(upper - lower)), 0.2),
        "splats": [
            _splats(block, time_s, splats, without_robot=space.motion is not None)
            for time_s, splats in space.splats.items()
        ],
        "cameras": list(space.cameras),
        "unknown": [
            {"name": name, "points": _points(block, points), "edge": edge, "shade": shade}
            for shade, (name, (points, edge)) in enumerate(space.unknown.items())
            if len(points)
        ],
    }
    if space.surface is not None:
        header["surface"] = _mesh(block, space.surface)
    if space.motion is not None:
        header["motion"] = _motion(block, space.motion)
    if space.deciding is not None:
        header["deciding"] = space.deciding
    return json.dumps({"header": header, "bytes": _deflate(block)}, allow_nan=False)


def _add(block: bytearray, values: ArrayLike, kind: type[np.generic]) -> list[Any]:
    """Append values by column, which deflates best, padded to 4 bytes; return [type, first byte, count]."""
    array, start = np.asarray(values, kind), len(block)
    block += np.ascontiguousarray(array.T).tobytes()
    block += bytes(-len(block) % 4)
    return [np.dtype(kind).name, start, array.size]


def _points(block: bytearray, points: NDArray[np.floating]) -> dict[str, Any]:
    values = np.asarray(points, np.float64).reshape(-1, 3)
    lower, upper = (values.min(axis=0), values.max(axis=0)) if len(values) else (np.zeros(3), np.zeros(3))
    step = np.where(upper > lower, (upper - lower) / STEPS, 1.0)
    whole = np.rint((values - lower) / step)
    return {"array": _add(block, whole, np.uint16), "lower": lower.tolist(), "step": step.tolist()}


def _splats(block: bytearray, time_s: float, splats: SplatSet, *, without_robot: bool) -> dict[str, Any]:
    chosen = splats.select(splats.labels != Label.ROBOT) if without_robot else splats
    largest = float(chosen.radii.max(initial=1e-6))
    colors = np.column_stack([np.clip(chosen.colors, 0.0, 1.0), np.clip(chosen.opacities, 0.0, 1.0)])
    return {
        "time": time_s,
        "centers": _points(block, chosen.centers),
        "radii": _add(block, np.rint(chosen.radii / largest * STEPS), np.uint16),
        "largest": largest,
        "colors": _add(block, np.rint(255 * colors), np.uint8),
        "labels": _add(block, chosen.labels, np.uint8),
    }


def _motion(block: bytearray, motion: Motion) -> dict[str, Any]:
    states, links = motion.poses.shape[:2]
    quats = Rotation.from_matrix(motion.poses[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(states, links * 4)
    return {
        "seconds": _add(block, motion.seconds, np.float32),
        "clearance": [float(value) if np.isfinite(value) else None for value in motion.clearance.round(6)],
        "margin": motion.margin,
        "links": [_mesh(block, body) for body in motion.bodies.values()],
        "quats": _add(block, np.rint(32767 * quats), np.int16),
        "places": _points(block, motion.poses[:, :, :3, 3]),
        "path": _points(block, motion.path),
    }


def _mesh(block: bytearray, surface: Surface) -> dict[str, Any]:
    return {"vertices": _points(block, surface.vertices), "faces": _add(block, surface.faces, np.uint32)}


def _deflate(data: bytes | bytearray) -> str:
    return base64.b64encode(zlib.compress(data)).decode("ascii")


PARTS = Path(__file__).parent / "page_parts"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A word in a state's colour; link: a section's anchor."""

    text: str
    state: str = ""
    link: str = ""


Row = tuple[Sequence[object], str]
"""Values or `Cell`s of a row, and its state; a bad state marks the row."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Titled rows under a header, or text; is_folded: shown on click."""

    title: str = ""
    header: Sequence[str] = ()
    rows: Sequence[Row] = ()
    text: str = ""
    is_folded: bool = False


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image as data URL, with size [px] and title. over: a second image above it."""

    title: str
    data: str
    width: int
    height: int
    over: str = ""


@dataclass(frozen=True, kw_only=True)
class RunSection:
    """A run's section. space: its 3-D scene's name, or ""; no_space: why none."""

    anchor: str
    title: str
    state: str
    sentence: str
    reasons: Table = field(default_factory=Table)
    lines: Sequence[str] = ()
    timeline: Markup | None = None
    legend: Sequence[tuple[str, str, str]] = ()
    pictures: Sequence[Picture] = ()
    details: Sequence[Table] = ()
    space: str = ""
    no_space: str = ""


@dataclass(frozen=True, kw_only=True)
class Page:
    """A report.

    pictures: of runs without a section; scenes: packed, by name; opens: show the first at once.
    """

    title: str
    state: str
    sentence: str
    lines: Sequence[str] = ()
    tables: Sequence[Table] = ()
    runs: Sequence[RunSection] = ()
    pictures: Sequence[Picture] = ()
    scenes: Mapping[str, str] = field(default_factory=dict)
    opens: bool = False


def render_page(page: Page) -> str:
    """The page as HTML, all text escaped."""
    environment = Environment(loader=FileSystemLoader(PARTS), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "classed": lambda state: str(state).replace(" ", "-"),
        "scripted": lambda text: Markup(text.replace("<", "\\u003c")),
        "shown": _format_cell,
    }
    environment.tests["a_cell"] = lambda value: isinstance(value, Cell)
    parts = {
        name: Markup((PARTS / file).read_text(encoding="utf-8"))
        for name, file in {"css": "page.css", "script": "page.js", "viewer": "viewer.js"}.items()
    }
    return environment.get_template("page.html").render(
        page=page, three=Markup(json.dumps(three_js())) if page.scenes else "", **parts
    )


def picture(path: Path, title: str, most: int) -> Picture:
    """An image file as JPEG, at most `most` [px] wide. Raises InputError if undecodable."""
    image = require(
        cv2.imread(str(path), cv2.IMREAD_COLOR),
        f"{path}: is no image that can be decoded",
        remedy="make the run again",
    )
    return _picture_of(image, title, most)


def compared(photo: UInt8, render: UInt8, title: str, most: int) -> Picture:
    """A render (H, W, 3), RGB, with the photo over its left half."""
    shown, over = (_picture_of(image[:, :, ::-1], title, most) for image in (render, photo))
    return replace(shown, over=over.data)


def _picture_of(image: NDArray[Any], title: str, most: int) -> Picture:
    height, width = image.shape[:2]
    if width > most:
        height, width = round(height * most / width), most
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    # JPEG: WebP is a third smaller, and takes ten times as long
    text = base64.b64encode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()).decode("ascii")
    return Picture(title=title, data=f"data:image/jpeg;base64,{text}", width=width, height=height)


def _format_cell(cell: object) -> str:
    if cell is None or cell == "":
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
