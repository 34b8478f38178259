"""Random objects on the table of `tabletop`: boxes, cylinders and balls of household size that do not touch."""

import numpy as np

from splatctrl_cli.geometry import pose_at, turn_about_z
from splatctrl_cli.records import Float64
from splatctrl_cli.simulate.primitives import Primitive, Texture
from splatctrl_cli.simulate.tabletop import PALETTE

NUM_THINGS = (6, 11)  # least and most
REGION = ((0.28, -0.55), (0.85, 0.55))  # [m] of the table's top, in which they stand
GAP = 0.03  # [m] at least, between the circles about two of them
KINDS = ("box", "box", "cylinder", "cylinder", "sphere")  # how often each is drawn
FREE_OF_BASE = 0.25  # [m] about the arm's base
PATTERNS = ("noise", "stripes", "checks")
ATTEMPTS = 2000


def random_things(seed: int) -> list[Primitive]:
    """Six to eleven objects on the table, the same for the same seed."""
    rng = np.random.default_rng([seed, 0])
    wanted = int(rng.integers(NUM_THINGS[0], NUM_THINGS[1] + 1))
    placed: list[tuple[Float64, float]] = []
    things: list[Primitive] = []
    for _ in range(ATTEMPTS):
        if len(things) == wanted:
            break
        kind = KINDS[int(rng.integers(len(KINDS)))]
        size = _size(kind, rng)
        radius = float(np.hypot(size[0], size[1])) / 2 if kind == "box" else size[0]
        position = rng.uniform(*REGION)
        is_apart = all(np.linalg.norm(position - other) > radius + r + GAP for other, r in placed)
        if is_apart and np.linalg.norm(position) > FREE_OF_BASE + radius:
            placed.append((position, radius))
            things.append(_thing(f"{kind}.{len(things)}", kind, size, position, rng))
    return things


def _size(kind: str, rng: np.random.Generator) -> tuple[float, ...]:
    if kind == "box":
        return tuple(float(v) for v in rng.uniform((0.06, 0.06, 0.08), (0.20, 0.20, 0.36)))
    if kind == "cylinder":
        return float(rng.uniform(0.03, 0.07)), float(rng.uniform(0.10, 0.36))
    return (float(rng.uniform(0.04, 0.10)),)


def _thing(name: str, kind: str, size: tuple[float, ...], position: Float64, rng: np.random.Generator) -> Primitive:
    height = size[2] / 2 if kind == "box" else size[1] / 2 if kind == "cylinder" else size[0]
    yaw = rng.uniform(0.0, np.pi)
    T = pose_at([*position, height], turn_about_z(yaw))
    dark, bright = PALETTE[list(PALETTE)[int(rng.integers(len(PALETTE)))]]
    texture = Texture(
        pattern=PATTERNS[int(rng.integers(len(PATTERNS)))],
        feature=float(rng.uniform(0.05, 0.08)),
        dark=dark,
        bright=bright,
        seed=int(rng.integers(1000)),
    )
    return Primitive(name=name, kind=kind, size=size, T_world_shape=T, texture=texture)
