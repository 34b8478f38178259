"""The simulated arm: the Franka Emika Panda's joints in primitive shapes, and its motion.

Joints follow the modified Denavit-Hartenberg table (d1 = 0.333, d3 = 0.316, a4 = 0.0825, a5 = -0.0825, d5 = 0.384, a7
= 0.088, flange 0.107 m), and published limits. The shapes are ours: capsules (a cylinder and two spheres) and boxes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from splatctrl_cli.geometry import frame_along, pose_at
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.urdf import Shape

BASE = "link0"
HAND = "hand"

# name, origin xyz [m], roll about x [rad], lower, upper [rad], velocity [rad/s], effort [N m]
JOINTS = (
    ("joint1", (0.0, 0.0, 0.333), 0.0, -2.8973, 2.8973, 2.175, 87.0),
    ("joint2", (0.0, 0.0, 0.0), -np.pi / 2, -1.7628, 1.7628, 2.175, 87.0),
    ("joint3", (0.0, -0.316, 0.0), np.pi / 2, -2.8973, 2.8973, 2.175, 87.0),
    ("joint4", (0.0825, 0.0, 0.0), np.pi / 2, -3.0718, -0.0698, 2.175, 87.0),
    ("joint5", (-0.0825, 0.384, 0.0), -np.pi / 2, -2.8973, 2.8973, 2.61, 12.0),
    ("joint6", (0.0, 0.0, 0.0), np.pi / 2, -0.0175, 3.7525, 2.61, 12.0),
    ("joint7", (0.088, 0.0, 0.0), np.pi / 2, -2.8973, 2.8973, 2.61, 12.0),
)
FLANGE = 0.107  # [m] along z of link7
SPACING = 0.042  # [m] at most, between the spheres along a link
BAR_WIDTH = 0.04  # [m] at most, of the bars that boxes are cut into to be covered
HAND_YAW = -np.pi / 4  # the hand is mounted turned by 45 degrees
GAP = 0.003  # [m] between a collision shape and the visual shape inside of it
WAIST = 0.030  # [m] less radius at a capsule's waist: axis over `LONG`, without ends of a share `BULGE`
LONG, BULGE = 0.10, 0.05
PEAK = 1.875  # a minimum-jerk segment's top speed divided by its mean speed


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """Points within `radius` [m] of the segment from `start` to `end` (3,) [m], link frame."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True, kw_only=True)
class Block:
    """Axis-aligned box: middle and full size (3,) [m], link frame."""

    middle: tuple[float, float, float]
    size: tuple[float, float, float]


SHAPES: dict[str, tuple[Capsule | Block, ...]] = {
    "link0": (
        Capsule(start=(-0.08, 0, 0.06), end=(0, 0, 0.06), radius=0.06),
        Capsule(start=(0, 0, 0.06), end=(0, 0, 0.10), radius=0.06),
    ),
    "link1": (
        Capsule(start=(0, 0, -0.18), end=(0, 0, 0), radius=0.06),
        Capsule(start=(0, -0.07, 0), end=(0, 0, 0), radius=0.06),
    ),
    "link2": (
        Capsule(start=(0, 0, 0.07), end=(0, 0, 0), radius=0.06),
        Capsule(start=(0, -0.16, 0), end=(0, 0, 0), radius=0.06),
    ),
    "link3": (
        Capsule(start=(0, 0, -0.10), end=(0, 0, -0.03), radius=0.055),
        Capsule(start=(0, 0, -0.03), end=(0.0825, 0.055, 0), radius=0.052),
    ),
    "link4": (
        Capsule(start=(0, 0, 0.05), end=(0, 0, 0), radius=0.052),
        Capsule(start=(0, 0, 0), end=(-0.0825, 0.09, 0), radius=0.055),
    ),
    "link5": (
        Capsule(start=(0, 0, -0.25), end=(0, 0.01, -0.19), radius=0.052),
        Capsule(start=(0, 0.01, -0.19), end=(0, 0.07, -0.02), radius=0.042),
    ),
    "link6": (
        Capsule(start=(0, 0, -0.01), end=(0.088, 0, 0), radius=0.048),
        Capsule(start=(0.088, 0, 0), end=(0.088, 0.02, 0), radius=0.048),
    ),
    "link7": (Capsule(start=(0, 0, 0.04), end=(0, 0, 0.065), radius=0.042),),
    "hand": (
        Block(middle=(0, 0, 0.033), size=(0.05, 0.18, 0.066)),
        Block(middle=(0, 0.04, 0.085), size=(0.02, 0.02, 0.05)),
        Block(middle=(0, -0.04, 0.085), size=(0.02, 0.02, 0.05)),
    ),
}


def slim(shape: Capsule | Block) -> tuple[Capsule | Block, ...]:
    """Visual shapes inside a collision shape.

    Their surface is 3 mm (median) and 27 mm (95 %) inside, at most 30 mm.
    """
    if isinstance(shape, Block):
        x, y, z = (size - 2 * GAP for size in shape.size)
        return (Block(middle=shape.middle, size=(x, y, z)),)
    start, end = np.array(shape.start, dtype=float), np.array(shape.end, dtype=float)
    if float(np.linalg.norm(end - start)) < LONG:
        return (Capsule(start=shape.start, end=shape.end, radius=shape.radius - GAP),)
    low, high = (start + share * (end - start) for share in (BULGE, 1 - BULGE))
    return (
        Capsule(start=shape.start, end=_point(low), radius=shape.radius - GAP),
        Capsule(start=_point(high), end=shape.end, radius=shape.radius - GAP),
        Capsule(start=shape.start, end=shape.end, radius=shape.radius - WAIST),
    )


def _point(values: Float64) -> tuple[float, float, float]:
    x, y, z = values.round(6).tolist()
    return x, y, z


SLIM = {link: tuple(part for shape in shapes for part in slim(shape)) for link, shapes in SHAPES.items()}

# Parts that no model of the arm has, by name: the link that carries them, and their capsules.
UNMODELLED: dict[str, tuple[str, tuple[Capsule, ...]]] = {
    "tool": ("hand", (Capsule(start=(0, 0, 0.05), end=(0, 0, 0.145), radius=0.012),)),
    "cable": (  # off the forearm by 3 to 4 cm
        "link5",
        (
            Capsule(start=(0.05, 0, -0.25), end=(0.085, 0.01, -0.21), radius=0.006),
            Capsule(start=(0.085, 0.01, -0.21), end=(0.09, 0.04, -0.12), radius=0.006),
            Capsule(start=(0.09, 0.04, -0.12), end=(0.075, 0.07, -0.04), radius=0.006),
            Capsule(start=(0.075, 0.07, -0.04), end=(0.03, 0.08, 0), radius=0.006),
        ),
    ),
    "bracket": (  # with a camera of 9 cm
        "hand",
        (
            Capsule(start=(0.02, 0, 0.01), end=(0.075, 0, 0.01), radius=0.008),
            Capsule(start=(0.08, -0.0325, 0.02), end=(0.08, 0.0325, 0.02), radius=0.0125),
        ),
    ),
}


def link_shape(link: str, shape: Capsule | Block) -> Shape:
    if isinstance(shape, Block):
        return Shape(link=link, kind="box", size=shape.size, T_link_shape=pose_at(shape.middle))
    start, end = np.array(shape.start, dtype=float), np.array(shape.end, dtype=float)
    return Shape(
        link=link,
        kind="capsule",
        size=(shape.radius, float(np.linalg.norm(end - start))),
        T_link_shape=pose_at((start + end) / 2, frame_along(end - start)),
    )


def arm_urdf(visual: Mapping[str, tuple[Capsule | Block, ...]] = SHAPES) -> str:
    """URDF text: links link0..link7 and hand, joints joint1..joint7 and a fixed hand_joint.

    visual: visible shapes; `SHAPES` collide.
    """
    lines = ['<?xml version="1.0"?>', '<robot name="arm">']
    for link, shapes in SHAPES.items():
        lines.append(f'  <link name="{link}">')
        for pair in zip_longest(_primitives(visual[link]), _primitives(shapes)):
            for tag, part in zip(("visual", "collision"), pair, strict=True):
                if part is not None:
                    geometry, origin = part
                    body = f"      {origin}\n      <geometry>{geometry}</geometry>"
                    lines.append(f"    <{tag}>\n{body}\n    </{tag}>")
        lines.append("  </link>")
    for index, (name, xyz, roll, lower, upper, velocity, effort) in enumerate(JOINTS):
        lines += [
            f'  <joint name="{name}" type="revolute">',
            f'    <origin xyz="{_words(xyz)}" rpy="{_words((roll, 0, 0))}"/>',
            f'    <parent link="link{index}"/>',
            f'    <child link="link{index + 1}"/>',
            '    <axis xyz="0 0 1"/>',
            f'    <limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="{effort}"/>',
            "  </joint>",
        ]
    lines += [
        '  <joint name="hand_joint" type="fixed">',
        f'    <origin xyz="0 0 {FLANGE}" rpy="{_words((0, 0, HAND_YAW))}"/>',
        '    <parent link="link7"/>',
        '    <child link="hand"/>',
        "  </joint>",
        "</robot>",
    ]
    return "\n".join(lines) + "\n"


def hand_pose(q: Float64) -> Float64:
    """T_base_hand (4, 4) at joint positions q (7,) [rad]."""
    T = np.eye(4)
    for (_, xyz, roll, *_), angle in zip(JOINTS, q, strict=True):
        T = T @ _turn(0, roll, xyz) @ _turn(2, angle)
    return T @ _turn(2, HAND_YAW, (0.0, 0.0, FLANGE))


def arm_spheres_yaml() -> str:
    """Covering spheres in cuRobo's YAML layout (`collision_spheres` by link)."""
    lines = ["collision_spheres:"]
    for link, shapes in SHAPES.items():
        lines.append(f"  {link}:")
        for center, radius in covering_spheres(shapes):
            row = ", ".join(f"{value:.4f}" for value in center + 0.0)
            lines.append(f"    - {{center: [{row}], radius: {radius:.4f}}}")
    return "\n".join(lines) + "\n"


def covering_spheres(shapes: tuple[Capsule | Block, ...]) -> list[tuple[Float64, float]]:
    """Spheres (center (3,), radius) [m], link frame, whose union contains every shape.

    Spheres of radius sqrt(R^2 + (h/2)^2), at steps h along a segment, cover a tube of radius R. For a box's bar, R is
    half its section's diagonal.
    """
    spheres: list[tuple[Float64, float]] = []
    for start, end, radius in (spine for shape in shapes for spine in _spines(shape)):
        steps = int(np.ceil(np.linalg.norm(end - start) / SPACING - 1e-9))
        step = float(np.linalg.norm(end - start)) / steps
        grown = float(np.ceil(np.hypot(radius, step / 2) * 1e4) / 1e4)
        spheres += [(start + (end - start) * (i / steps), grown) for i in range(steps + 1)]
    outer: list[tuple[Float64, float]] = []
    for center, radius in sorted(spheres, key=lambda sphere: -sphere[1]):
        if not any(np.linalg.norm(center - other) + radius <= big + 5e-4 for other, big in outer):
            outer.append((center, radius))
    return outer


def _spines(shape: Capsule | Block) -> list[tuple[Float64, Float64, float]]:
    """Segments (start, end) and tube radii, of a capsule or a box's bars."""
    if isinstance(shape, Capsule):
        return [(np.array(shape.start, dtype=float), np.array(shape.end, dtype=float), shape.radius)]
    size = np.array(shape.size)
    thin, wide, long = (int(axis) for axis in np.argsort(size, kind="stable"))
    num_bars = int(np.ceil(size[wide] / BAR_WIDTH - 1e-9))
    width = size[wide] / num_bars
    half = np.zeros(3)
    num_steps = max(2, int(np.ceil(size[long] / SPACING - 1e-9)))
    half[long] = (size[long] - size[long] / num_steps) / 2
    spines = []
    for bar in range(num_bars):
        middle = np.array(shape.middle, dtype=float)
        middle[wide] += (bar + 0.5) * width - size[wide] / 2
        spines.append((middle - half, middle + half, float(np.hypot(size[thin], width)) / 2))
    return spines


def _primitives(shapes: tuple[Capsule | Block, ...]) -> Iterator[tuple[str, str]]:
    balls: set[tuple[tuple[float, float, float], float]] = set()
    for shape in shapes:
        if isinstance(shape, Block):
            yield f'<box size="{_words(shape.size)}"/>', f'<origin xyz="{_words(shape.middle)}" rpy="0 0 0"/>'
            continue
        start, end = np.array(shape.start, dtype=float), np.array(shape.end, dtype=float)
        length = float(np.linalg.norm(end - start))
        x, y, z = (end - start) / length
        pitch, yaw = float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x)) if x or y else 0.0
        middle = _words((start + end) / 2)
        yield (
            f'<cylinder radius="{shape.radius}" length="{length:.9g}"/>',
            f'<origin xyz="{middle}" rpy="{_words((0, pitch, yaw))}"/>',
        )
        for point in (shape.start, shape.end):
            if (point, shape.radius) not in balls:
                balls.add((point, shape.radius))
                yield f'<sphere radius="{shape.radius}"/>', f'<origin xyz="{_words(point)}" rpy="0 0 0"/>'


def _turn(axis: int, angle: float, xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Float64:
    T, c, s = np.eye(4), np.cos(angle), np.sin(angle)
    i, j = ((1, 2), (2, 0), (0, 1))[axis]
    T[i, i], T[i, j], T[j, i], T[j, j] = c, -s, s, c
    T[:3, 3] = xyz
    return T


def _words(values: object) -> str:
    return " ".join(f"{value + 0.0:.12g}" for value in np.asarray(values, dtype=float))


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Waypoints (W, J) [rad], reached at rest at times (W,) [s], joined by minimum-jerk segments."""

    times: Float64
    waypoints: Float64

    def within(self, velocity_limit: Float64) -> "Motion":
        """The same path, slowed as a whole if a joint would exceed its limit (J,) [rad/s]."""
        speeds = PEAK * np.abs(np.diff(self.waypoints, axis=0)) / np.diff(self.times)[:, None]
        slower = max(1.0, float(np.max(speeds / velocity_limit)))
        return replace(self, times=self.times + (slower - 1.0) * (self.times - self.times[0]))

    def at(self, time: float) -> tuple[Float64, Float64]:
        """Positions (J,) [rad] and velocities (J,) [rad/s]; at rest outside the path."""
        time = float(np.clip(time, self.times[0], self.times[-1]))
        index = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2))
        span = self.times[index + 1] - self.times[index]
        s = (time - self.times[index]) / span
        step = self.waypoints[index + 1] - self.waypoints[index]
        position = self.waypoints[index] + step * (10 * s**3 - 15 * s**4 + 6 * s**5)
        return position, step * (30 * s**2 - 60 * s**3 + 30 * s**4) / span
