"""A cube to carry into a bowl, among random objects: four layouts at three heights, as in IV-C.

World frame as in `tabletop`: z up, the table's top at z = 0, the arm's base at the origin, x forward. The cube stands
on the left, alone or on a block, the bowl on the right.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from experiments.environments import BASE, drawn_texture, ring_of_cameras, tip_down
from splatctrl_cli import Box
from splatctrl_cli.blocks import PALETTE, Camera, Float64, Primitive, Texture, box, cameras, solid

LAYOUTS = ("scattered", "clustered", "wall", "stacked")
HEIGHTS = ((0.06, 0.14), (0.06, 0.30), (0.18, 0.32))  # [m] of things: low, of every height, tall
CUBE = 0.05  # [m]
HELD = Box(lower=np.array([-0.025, -0.025, 0.070]), upper=np.array([0.025, 0.025, 0.120]))  # in the hand's frame
TIP = 0.11  # [m] from the hand's origin to its fingertips
HOVER = 0.08  # [m] of the fingertips over the cube before they go down, and of the cube over the bowl at the end
HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)  # [rad] where the arm starts: its usual ready posture
REGION = ((0.28, -0.58), (0.82, 0.58))  # [m] of the table's top, in which things stand
FREE = 0.15  # [m] about cube and bowl in which nothing else stands: the hand's half width and 5 cm
BOWL_RADIUS = 0.07  # [m]
WALL = 0.24  # [m] at most, that an arm reaches over
GAP = 0.01  # [m] between the circles about two things


@dataclass(frozen=True, kw_only=True)
class PickAndPlace:
    """things: all that stands there but the cube; cube: where it stands at first; poses (4, 4) of the hand: over the
    cube, about it, and over the bowl.
    """

    things: tuple[Primitive, ...]
    cube: Primitive
    T_world_hover: Float64
    T_world_grasp: Float64
    T_world_place: Float64


def drawn_scene(layout: str, number: int, attempt: int) -> PickAndPlace:
    """The scene of a layout and a number, which chooses the height; each attempt draws another scene."""
    rng = np.random.default_rng([LAYOUTS.index(layout), number, attempt])
    pick, bowl = (np.array([rng.uniform(0.42, 0.52), side * rng.uniform(0.30, 0.40)]) for side in (1, -1))
    base = rng.uniform(0.04, 0.10) * (rng.random() < 0.5)
    rim, yaw = rng.uniform(0.05, 0.12), rng.uniform(-0.3, 0.3)
    taken = [(np.zeros(2), BASE), (pick, FREE), (bowl, FREE)]
    things = [
        box("table", (1.5, 1.5, 0.05), (0.4, 0.0, -0.025), drawn_texture(rng)),
        solid("bowl", "cylinder", (BOWL_RADIUS, rim), (*bowl, 0.5 * rim), drawn_texture(rng)),
        *([box("block", (0.09, 0.09, base), (*pick, 0.5 * base), drawn_texture(rng), yaw)] if base > 0 else []),
        *_things(layout, HEIGHTS[number % len(HEIGHTS)], taken, rng),
    ]
    dark, bright = PALETTE["ocean"]
    blue = Texture(pattern="checks", feature=0.05, dark=dark, bright=bright, seed=1)
    grasp = tip_down((*pick, base + 0.5 * CUBE + float(HELD.lower[2] + HELD.upper[2]) / 2), yaw)
    return PickAndPlace(
        things=tuple(things),
        cube=box("cube", (CUBE, CUBE, CUBE), (*pick, base + 0.5 * CUBE), blue, yaw),
        T_world_hover=tip_down((*pick, base + CUBE + HOVER + TIP), yaw),
        T_world_grasp=grasp,
        T_world_place=tip_down((*bowl, rim + HOVER + float(HELD.upper[2])), rng.uniform(-0.3, 0.3)),
    )


def depth_cameras(width: int, height: int) -> tuple[Camera, ...]:
    """Three RealSense D435, where the training cameras of `tabletop` stand."""
    (lens,) = (camera.intrinsics for camera in ring_of_cameras(1, width, height))
    return tuple(replace(camera, intrinsics=lens) for camera in cameras(width, height) if camera.is_training)


Taken = list[tuple[Float64, float]]  # middle (2,) and radius [m] of the circles that are taken


def _things(layout: str, heights: tuple[float, float], taken: Taken, rng: np.random.Generator) -> Iterator[Primitive]:
    if layout == "clustered":
        middles = [taken[1][0], taken[2][0], np.array([rng.uniform(0.45, 0.70), rng.uniform(-0.1, 0.1)])]
        for number in range(10):
            yield from _thing(f"thing.{number}", heights, taken, rng, about=middles[number % 3])
    elif layout == "wall":
        for number, x in enumerate(np.arange(0.34, 0.80, 0.115)):
            size = (0.10, rng.uniform(0.06, 0.12), min(rng.uniform(*heights), WALL))
            spot = np.array([x + rng.uniform(-0.005, 0.005), rng.uniform(-0.04, 0.04)])
            taken.append((spot, 0.08))
            yield box(f"wall.{number}", size, (*spot, 0.5 * size[2]), drawn_texture(rng), rng.uniform(-0.1, 0.1))
        for number in range(4):
            yield from _thing(f"thing.{number}", heights, taken, rng)
    elif layout == "stacked":
        for number in range(4):
            yield from _stack(f"stack.{number}", heights, taken, rng)
        for number in range(3):
            yield from _thing(f"thing.{number}", heights, taken, rng)
    else:
        for number in range(int(rng.integers(8, 12))):
            yield from _thing(f"thing.{number}", heights, taken, rng)


def _thing(
    name: str, heights: tuple[float, float], taken: Taken, rng: np.random.Generator, about: Float64 | None = None
) -> Iterator[Primitive]:
    """A box, cylinder or ball at a free place, near `about` or anywhere."""
    kind, height = rng.choice(["box", "box", "cylinder", "cylinder", "ball"]), rng.uniform(*heights)
    width, depth = rng.uniform(0.05, 0.15, 2)
    if kind == "ball":
        width = depth = height = min(height, 0.16)
    spot = _spot(0.5 * float(np.hypot(width, depth)) if kind == "box" else 0.5 * width, taken, rng, about)
    if spot is None:
        return
    middle, texture = (*spot, 0.5 * height), drawn_texture(rng)
    if kind == "box":
        yield box(name, (width, depth, height), middle, texture, rng.uniform(0, np.pi))
    elif kind == "cylinder":
        yield solid(name, "cylinder", (0.5 * width, height), middle, texture)
    else:
        yield solid(name, "sphere", (0.5 * height,), middle, texture)


def _stack(name: str, heights: tuple[float, float], taken: Taken, rng: np.random.Generator) -> Iterator[Primitive]:
    """Two or three stacked boxes, each smaller than the box below."""
    width, depth = rng.uniform(0.12, 0.18, 2)
    spot = _spot(0.5 * float(np.hypot(width, depth)), taken, rng, None)
    if spot is None:
        return
    num = int(rng.integers(2, 4))
    top, height, yaw = 0.0, rng.uniform(*heights) / num, rng.uniform(0, np.pi)
    for level in range(num):
        size = (width * (1 - 0.2 * level), depth * (1 - 0.2 * level), height)
        yield box(f"{name}.{level}", size, (*spot, top + 0.5 * height), drawn_texture(rng), yaw)
        top += height


def _spot(radius: float, taken: Taken, rng: np.random.Generator, about: Float64 | None) -> Float64 | None:
    """A free place (2,) [m] for a circle, which is added to `taken`; None if no place is free."""
    for _ in range(60):
        spot = rng.uniform(*REGION)
        if about is not None:
            angle = rng.uniform(0, 2 * np.pi)
            spot = about + rng.uniform(0.0, 0.28) * np.array([np.cos(angle), np.sin(angle)])
        if all(np.linalg.norm(spot - other) > radius + reach + GAP for other, reach in taken):
            taken.append((spot, radius))
            return np.asarray(spot)
    return None
