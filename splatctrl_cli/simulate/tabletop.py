"""The scene: objects on a textured table, an arm behind, fixed cameras around.

World frame: z up, the table's top at z = 0, the arm's base at the origin, x forward.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Bool, Float64, Intrinsics, RgbdFrame
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import Shape
from splatctrl_cli.simulate.arm import Motion
from splatctrl_cli.simulate.primitives import Primitive, Texture, box, solid
from splatctrl_cli.simulate.render import Camera, Meshes, Renderer

PALETTE = {
    "wood": ((0.16, 0.09, 0.05), (0.98, 0.86, 0.66)),
    "slate": ((0.05, 0.08, 0.14), (0.80, 0.90, 0.98)),
    "moss": ((0.04, 0.12, 0.06), (0.85, 0.97, 0.62)),
    "brick": ((0.22, 0.03, 0.03), (1.00, 0.80, 0.62)),
    "ocean": ((0.02, 0.07, 0.25), (0.70, 0.94, 1.00)),
    "grape": ((0.14, 0.03, 0.20), (0.98, 0.82, 0.95)),
    "sand": ((0.24, 0.17, 0.04), (1.00, 0.95, 0.70)),
    "shell": ((0.20, 0.21, 0.24), (1.00, 1.00, 0.98)),
    "enamel": ((0.72, 0.72, 0.71), (0.97, 0.97, 0.95)),
}

# Joint positions [rad]: the hand right of the things on the table, above them, and left of them.
WAYPOINTS = (
    (-0.80, 0.30, 0.00, -2.00, 0.00, 2.30, 0.00),
    (-0.10, 0.10, 0.00, -2.00, 0.00, 2.10, 0.69),
    (0.80, 0.30, 0.00, -2.00, 0.00, 2.30, 1.57),
)

VISITOR = (0.42, 0.08, 0.06)  # [m] x, y and radius of the cylinder that stands there for a while
NUM_VIEWS = 8
MIDDLE = (0.60, 0.02, 0.06)  # [m] the middle of the things


def furniture() -> list[Primitive]:
    return [
        box("table", (1.70, 1.80, 0.05), (0.30, 0.0, -0.025), texture("noise", 0.10, "wood", 1)),
        box("floor", (4.0, 4.0, 0.05), (0.4, 0.0, -0.725), texture("noise", 0.15, "slate", 2)),
        box("wall_back", (0.05, 4.0, 2.2), (-0.80, 0.0, 0.40), texture("noise", 0.13, "moss", 3)),
        box("wall_left", (4.0, 0.05, 2.2), (1.2, 1.30, 0.40), texture("noise", 0.13, "brick", 4)),
        box("wall_right", (4.0, 0.05, 2.2), (1.2, -1.30, 0.40), texture("noise", 0.13, "ocean", 7)),
    ]


def objects() -> list[Primitive]:
    return [
        box(
            "crate", (0.14, 0.18, 0.20), (0.655, 0.315, 0.10), texture("stripes", 0.06, "ocean", 0), np.deg2rad(20.0)
        ),
        box(
            "parcel", (0.22, 0.14, 0.10), (0.66, -0.02, 0.05), texture("noise", 0.055, "brick", 5), np.deg2rad(-15.0)
        ),
        solid(
            "canister", "cylinder", (0.055, 0.19), (0.585, -0.285, 0.095), texture("stripes", 0.055, "moss", 1), 0.0
        ),
        solid("tin", "cylinder", (0.050, 0.14), (0.78, -0.24, 0.07), texture("checks", 0.06, "grape", 0), 0.0),
        solid("ball", "sphere", (0.075,), (0.36, 0.40, 0.075), texture("noise", 0.05, "sand", 6), 0.0),
    ]


def visitor(from_ns: int, to_ns: int, place: Sequence[float] = VISITOR) -> Primitive:
    """The temporary obstacle; place: x, y, radius [m]."""
    x, y, radius = place
    stands = solid("visitor", "cylinder", (radius, 0.30), (x, y, 0.15), texture("stripes", 0.06, "grape", 2), 0.0)
    return replace(stands, from_ns=from_ns, to_ns=to_ns)


def person(from_ns: int, to_ns: int, num_steps: int) -> list[Primitive]:
    """A person who walks along the table's near side, one solid per step."""
    stamps = [from_ns + (to_ns - from_ns) * step // num_steps for step in range(num_steps + 1)]
    grape = texture("noise", 0.05, "grape", 2)
    places = [(0.75 - 0.40 * step / max(num_steps - 1, 1), -0.50, 0.20) for step in range(num_steps)]
    return [
        replace(solid(f"person.{step:03d}", "cylinder", (0.06, 0.40), place, grape, 0.0), from_ns=start, to_ns=end)
        for step, (place, (start, end)) in enumerate(zip(places, pairwise(stamps), strict=True))
    ]


def cameras(width: int, height: int) -> tuple[Camera, ...]:
    """Three training cameras, and a scoring one between the first two; focal length 0.92 widths."""
    scale = width / 320
    intrinsics = Intrinsics(
        fx=295.0 * scale,
        fy=295.0 * scale,
        cx=(width - 1) / 2 + 3.2 * scale,
        cy=(height - 1) / 2 - 2.6 * scale,
        width=width,
        height=height,
    )
    places = (
        ("cam0", (1.15, -0.15, 0.95), (0.36, 0.0, 0.10), True),
        ("cam1", (0.15, -0.85, 0.90), (0.40, 0.0, 0.10), True),
        ("cam2", (0.20, 0.90, 0.95), (0.40, 0.0, 0.10), True),
        ("cam3", (0.80, -0.70, 0.95), (0.40, 0.0, 0.10), False),
    )
    return tuple(
        Camera(name=name, intrinsics=intrinsics, T_world_camera=look_at(eye, target), is_training=is_training)
        for name, eye, target, is_training in places
    )


def arm_motion(duration_s: float) -> Motion:
    waypoints = np.array(WAYPOINTS)
    return Motion(times=np.linspace(0.06, 0.94, len(waypoints)) * duration_s, waypoints=waypoints)


def arm_solids(shapes: Sequence[Shape], T_world_links: dict[str, Float64]) -> list[Primitive]:
    """The arm's shapes at one configuration; patterns are fixed to links."""
    return [
        Primitive(
            name=f"{shape.link}.{index}",
            kind=shape.kind,
            size=shape.size,
            T_world_shape=T_world_links[shape.link] @ shape.T_link_shape,
            texture=texture("noise", 0.05, ("shell", "ocean")[sum(shape.link.encode()) % 2], 20),
        )
        for index, shape in enumerate(shapes)
    ]


def arm_meshes(surface: RobotSurface) -> Meshes:
    """The arm's meshes in white, patterns fixed to links."""
    return Meshes(
        links=surface.links,
        triangles=surface.triangles,
        owners=surface.triangle_links,
        textures=(texture("noise", 0.05, "enamel", 20),) * len(surface.links),
        T_world_link=np.tile(np.eye(4), (len(surface.links), 1, 1)),
    )


def texture(pattern: str, feature: float, palette: str, seed: int) -> Texture:
    dark, bright = PALETTE[palette]
    return Texture(pattern=pattern, feature=feature, dark=dark, bright=bright, seed=seed)


def turntable_views() -> Iterator[RgbdFrame]:
    """Exact views from a 70-degree arc at two heights; stamps are view numbers."""
    width, height = 256, 208  # [px]
    intrinsics = Intrinsics(
        fx=1.15 * width,
        fy=1.15 * width,
        cx=(width - 1) / 2 + 2.4,
        cy=(height - 1) / 2 + 1.7,
        width=width,
        height=height,
    )
    scene = furniture() + objects()
    for number in range(NUM_VIEWS):
        angle = np.deg2rad(-90.0 + 70.0 * number / (NUM_VIEWS - 1))
        height_above = 0.52 if number % 2 == 0 else 0.68
        eye = np.array(MIDDLE) + np.array([0.80 * np.cos(angle), 0.80 * np.sin(angle), height_above])
        camera = Camera(
            name=f"view{number}", intrinsics=intrinsics, T_world_camera=look_at(eye, MIDDLE), is_training=True
        )
        color, depth = Renderer(camera, scene).image([])
        yield RgbdFrame(
            stamp_ns=number,
            camera=camera.name,
            color=color,
            depth=depth,
            intrinsics=intrinsics,
            T_world_camera=camera.T_world_camera,
        )


def object_mask(frame: RgbdFrame) -> Bool:
    """(H, W) True where a view shows an object."""
    camera = Camera(
        name=frame.camera, intrinsics=frame.intrinsics, T_world_camera=frame.T_world_camera, is_training=True
    )
    behind = Renderer(camera, furniture(), color_rays=0).depth([])
    return np.asarray((frame.depth > 0) & ((behind == 0) | (frame.depth < behind - 1e-4)))
