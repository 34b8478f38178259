"""Sphere marching: a kernel field's distance refined by walking to its surface (III-D)."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.distance import normalised
from splatctrl_cli.records import DistanceField, Float64

STEPS = 5  # III-D: 3 to 5


@dataclass(frozen=True, kw_only=True)
class March:
    """Of Q points: distance (Q,) [m] walked to the field's zero level and what the field reads at the end of it,
    hit (Q, 3) [m] the points reached, rest (Q,) [m] what the field reads there.
    """

    distance: Float64
    hit: Float64
    rest: Float64


def march(field: DistanceField, exact: DistanceField, points: Float64, *, steps: int = STEPS) -> March:
    """Walk from points (Q, 3) [m], world, to the zero level of `field`, `steps` times by what the field reads.

    Each step goes against the field's gradient where the point then is: with the first direction kept, a walk can
    pass an object by. No step is longer than the `exact` distance to the spheres, so none goes through one. A field
    that underestimates, as the Matern field does, is walked to its zero level, which stands before the spheres (by
    `health.planar_zero_level` over a plane). Points at or behind it stay. Raises UsageError for less than one step.
    """
    if steps < 1:
        raise UsageError(f"marching: expected at least 1 step, got {steps}")
    hit = np.array(points, dtype=np.float64)
    walked = np.zeros(len(hit))
    rest, gradient = field.query(hit)
    for _ in range(steps):
        length = np.clip(np.minimum(rest, exact.query(hit)[0]), 0.0, None)
        direction = normalised(gradient)
        hit -= length[:, None] * direction
        walked += np.where(direction.any(axis=1), length, 0.0)  # without a slope there is nowhere to go
        rest, gradient = field.query(hit)
    return March(distance=walked + rest, hit=hit, rest=rest)
