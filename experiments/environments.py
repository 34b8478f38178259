"""Environments drawn by a seed: objects on one or two tables, a shelf with openings, a shelf without a divider.

Their kinds are those of Motion Policy Networks (Fishman et al., CoRL 2022). The parameters are ours, because that
work's are not available. World frame: z up, the arm's base at the origin, x forward.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.blocks import (
    PALETTE,
    Camera,
    Float64,
    Intrinsics,
    Primitive,
    Texture,
    box,
    look_at,
    pose_at,
    solid,
    turn_about_z,
)

ENVIRONMENTS = ("tabletop", "cubby", "merged-cubby")
ENVIRONMENT_S = 12.0  # [s] of a recording in one, unless another is asked for

BASE = 0.22  # [m] about the arm's axis that stays free
GRASP = 0.06  # [m] at least between a tip and what is about it: half a hand
BOARD = 0.02  # [m] a shelf's
ALONG_X = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # of a tip, which points along z
LOOK_AT = (0.45, 0.0, 0.25)
EYES = (  # [m] beside the base and looking forward, to the sides, and before it: the first two see into a shelf
    (-0.30, 0.65, 0.95),
    (-0.30, -0.65, 0.95),
    (0.35, 1.10, 0.90),
    (0.35, -1.10, 0.90),
    (1.25, 0.60, 1.00),
    (1.25, -0.60, 1.00),
)


@dataclass(frozen=True, kw_only=True)
class Environment:
    """Primitives, and poses (4, 4) for the tip's start and goal, with z away from the arm."""

    primitives: tuple[Primitive, ...]
    places: tuple[Float64, ...]


def drawn(kind: str, rng: np.random.Generator) -> Environment:
    """An environment of one of `ENVIRONMENTS`."""
    return _tabletop(rng) if kind == "tabletop" else _shelf(rng, is_merged=kind == "merged-cubby")


def ring_of_cameras(num: int, width: int, height: int) -> tuple[Camera, ...]:
    """The first of six cameras about the arm, with the lens of a D435's depth camera (87 degrees wide)."""
    focal = 0.5 * width / np.tan(np.radians(87) / 2)
    lens = Intrinsics(
        fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height
    )  # fmt: skip
    return tuple(
        Camera(name=f"cam{n}", intrinsics=lens, T_world_camera=look_at(eye, LOOK_AT), is_training=True)
        for n, eye in enumerate(EYES[:num])
    )


def _tabletop(rng: np.random.Generator) -> Environment:
    """3 to 15 boxes and cylinders of 5 to 40 cm on a table, or on two in an L; the tip is above them."""
    tables = [(np.array([rng.uniform(0.35, 0.45), 0.0]), np.array([1.5, 1.5]), 0.0)]
    if rng.random() < 0.5:
        place = np.array([0.30, rng.choice([-0.60, 0.60])])
        tables.append((place, np.array([0.9, 0.4]), rng.uniform(0.05, 0.15)))
    solids = [
        box(f"table_{n}", (*size, 0.05 + top), (*middle, top - 0.5 * (0.05 + top)), drawn_texture(rng))
        for n, (middle, size, top) in enumerate(tables)
    ]
    taken: list[tuple[Float64, float]] = [(np.zeros(2), BASE)]
    num_things = int(rng.integers(3, 16))
    for number in range(20 * num_things):
        if len(taken) > num_things:
            break
        size = np.minimum(rng.uniform(0.05, 0.40, 3), [0.20, 0.20, 0.40])
        middle, extent, top = tables[int(rng.integers(len(tables)))]
        spot = middle + rng.uniform(-0.5, 0.5, 2) * (np.minimum(extent, 1.1) - size[:2].max())
        radius = 0.5 * float(np.hypot(*size[:2]))
        is_on_other = any(
            other is not middle and np.all(np.abs(spot - other) < 0.5 * reach + radius)
            for other, reach, _ in tables[1:]
        )
        if is_on_other or any(np.linalg.norm(spot - there) < radius + reach for there, reach in taken):
            continue
        taken.append((spot, radius))
        center = (*spot, top + 0.5 * size[2])
        if rng.random() < 0.5:
            solids.append(box(f"box_{number}", tuple(size), center, drawn_texture(rng), rng.uniform(0, np.pi)))
        else:
            of = (0.5 * size[0], size[2])
            solids.append(solid(f"cylinder_{number}", "cylinder", of, center, drawn_texture(rng)))
    places = []
    for _ in range(24):
        middle, extent, top = tables[int(rng.integers(len(tables)))]
        spot = middle + rng.uniform(-0.5, 0.5, 2) * np.minimum(extent, 1.1)
        places.append(tip_down((*spot, top + rng.uniform(GRASP, 0.30)), rng.uniform(-np.pi, np.pi)))
    return Environment(primitives=tuple(solids), places=tuple(places))


def _shelf(rng: np.random.Generator, *, is_merged: bool) -> Environment:
    """2x2 to 3x3 openings of 20 to 40 cm on a table, facing the arm up to a yaw; the tip's places are inside
    openings.
    """
    columns, rows = (int(n) for n in rng.integers(2, 4, 2))
    widths = np.minimum(rng.uniform(0.20, 0.40, columns), 1.0 / columns)
    heights = np.minimum(rng.uniform(0.20, 0.40, rows), 0.9 / rows)
    depth = rng.uniform(0.20, 0.35)
    y, z = (np.concatenate([[0.0], np.cumsum(sizes)]) for sizes in (widths, heights))
    y -= 0.5 * y[-1]
    angle, yaw, near = rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3), rng.uniform(0.45, 0.60)
    T = pose_at([near * np.cos(angle), near * np.sin(angle), 0.5 * BOARD], turn_about_z(angle + yaw))
    dividers = [("upright", n, row) for n in range(1, columns) for row in range(rows)]
    dividers += [("board", n, column) for n in range(1, rows) for column in range(columns)]
    missing = dividers[int(rng.integers(len(dividers)))] if is_merged else None
    texture, solids = drawn_texture(rng), [box("table", (1.5, 1.5, 0.05), (0.4, 0.0, -0.025), drawn_texture(rng))]

    def add(name: str, size: Sequence[float], middle: Sequence[float]) -> None:
        placed = T.copy()
        placed[:3, 3] = T[:3, :3] @ np.array(middle) + T[:3, 3]
        solids.append(Primitive(name=name, kind="box", size=tuple(size), T_world_shape=placed, texture=texture))

    add("back", (BOARD, y[-1] - y[0] + BOARD, z[-1] + BOARD), (depth, 0.0, 0.5 * z[-1]))
    for n in range(columns + 1):
        for row in range(rows):
            if ("upright", n, row) != missing:
                add(
                    f"upright_{n}_{row}",
                    (depth, BOARD, heights[row] + BOARD),
                    (0.5 * depth, y[n], z[row : row + 2].mean()),
                )
    for n in range(rows + 1):
        for column in range(columns):
            if ("board", n, column) != missing:
                size = (depth, widths[column] + BOARD, BOARD)
                add(f"board_{n}_{column}", size, (0.5 * depth, y[column : column + 2].mean(), z[n]))
    places = []
    for row in range(rows):
        for column in range(columns):
            for inside in (0.25, 0.6):
                forward = ALONG_X @ turn_about_z(rng.uniform(-np.pi, np.pi))
                middle = [inside * depth, y[column : column + 2].mean(), z[row : row + 2].mean()]
                places.append(T @ pose_at(middle, forward))
    order = rng.permutation(len(places))
    return Environment(primitives=tuple(solids), places=tuple(places[k] for k in order))


def tip_down(position: Sequence[float], yaw: float) -> Float64:
    """A tip that points down."""
    return pose_at(position, turn_about_z(yaw) @ np.diag([1.0, -1.0, -1.0]))


def drawn_texture(rng: np.random.Generator) -> Texture:
    """Of a thing: a pattern and two colours."""
    dark, bright = PALETTE[str(rng.choice(sorted(PALETTE)))]
    pattern = str(rng.choice(["noise", "stripes", "checks"]))
    return Texture(
        pattern=pattern, feature=rng.uniform(0.05, 0.10), dark=dark, bright=bright, seed=int(rng.integers(100))
    )
