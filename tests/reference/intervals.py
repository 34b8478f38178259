"""Float64 references of what the verdict takes from motions: one formula, one plain loop each."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.records import Float64, Stamps


def interval_bound(first: Float64, last: Float64, motion: Float64, levers: Float64) -> float:
    """Least over spheres of (d_0 + d_1 - L) / 2, L = sum over joints of lever arm times motion."""
    bounds = []
    for d_0, d_1, arms in zip(first, last, levers, strict=True):
        travel = sum(float(lever) * abs(float(step)) for lever, step in zip(arms, motion, strict=True))
        bounds.append((float(d_0) + float(d_1) - travel) / 2)
    return min(bounds)


def velocity_shares(stamps: Stamps, positions: Float64, limit: Float64, window: float, off: float) -> Float64:
    """(T,) largest over the joints of |q_i - q_k| less 2 `off`, over time and limit; k: the state before i, and the
    newest that is `window` [s] older.
    """
    found = np.zeros(len(stamps))
    for i in range(1, len(stamps)):
        older = [k for k in range(i) if stamps[i] - stamps[k] >= round(window * 1e9)]
        for k in (i - 1, *older[-1:]):
            for joint, most in enumerate(limit):
                moved = max(abs(float(positions[i, joint] - positions[k, joint])) - 2 * off, 0.0)
                found[i] = max(found[i], moved / (float(stamps[i] - stamps[k]) * 1e-9) / float(most))
    return found


def near_figures(
    arm: ArmModel,
    q: Float64,
    q_first: Float64,
    margin: float,
    last_seen: Callable[[Float64], Stamps],
    now_ns: int,
) -> tuple[float, float, int]:
    """Share of the points on the shells in new space that were never seen, the age [s] within which three quarters of
    the seen ones were seen, and how many points there are.
    """
    never, ages, num = [], [], 0
    for _, point in _shells(arm, q, margin):
        num += 1
        last = int(last_seen(point[None])[0])
        if min(_gaps(arm, q_first, point)) > 0.05:
            never.append(last < 0)
        if last >= 0:
            ages.append((now_ns - last) * 1e-9)
    return float(np.mean(never)), float(np.quantile(ages, 0.75)), num


def blind_share(
    arm: ArmModel, q: Float64, q_first: Float64, margin: float, last_seen: Callable[[Float64], Stamps]
) -> float:
    """Share of the moving spheres with at least five points on their shell in new space, 90 % of them never seen."""
    moving = np.flatnonzero(arm.moving_spheres).tolist()
    never: dict[int, list[bool]] = {s: [] for s in moving}
    for s, point in _shells(arm, q, margin):
        if min(_gaps(arm, q_first, point)) > 0.05:
            never[s].append(int(last_seen(point[None])[0]) < 0)
    return sum(len(found) >= 5 and np.mean(found) >= 0.9 for found in never.values()) / len(moving)


def hidden(
    arm: ArmModel,
    q: Float64,
    margin: float,
    last_seen: Callable[[Float64], Stamps],
    distance: Callable[[Float64], Float64],
) -> float:
    """The least distance [m] to surfaces of the points on the shells that were never seen."""
    found = [np.inf]
    for _, point in _shells(arm, q, margin, _spiral(200)):
        if int(last_seen(point[None])[0]) < 0:
            found.append(float(distance(point[None])[0]))
    return min(found)


def beyond(
    arm: ArmModel,
    q: Float64,
    q_first: Float64,
    margin: float,
    last_seen: Callable[[Float64], Stamps],
    distance: Callable[[Float64], Float64],
) -> float:
    """The least distance [m] to surfaces of the points in new space that were never seen, of shells with at least 20
    points there, 90 % of them never seen.
    """
    new: dict[int, list[tuple[Float64, bool]]] = {}
    for s, point in _shells(arm, q, margin, _spiral(200)):
        if min(_gaps(arm, q_first, point)) > 0.05:
            new.setdefault(s, []).append((point, int(last_seen(point[None])[0]) < 0))
    found = [np.inf]
    for points in new.values():
        never = [point for point, is_never in points if is_never]
        if len(points) >= 20 and len(never) >= 0.9 * len(points):
            found += [float(distance(point[None])[0]) for point in never]
    return min(found)


def _spiral(num: int) -> list[tuple[float, float, float]]:
    """Directions by the golden angle, each a slice of equal height further down."""
    found = []
    for k in range(num):
        height = 1 - (2 * k + 1) / num
        angle, flat = np.pi * (1 + np.sqrt(5)) * k, np.sqrt(1 - height**2)
        found.append((float(flat * np.cos(angle)), float(flat * np.sin(angle)), height))
    return found


CUBE = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)]


def _shells(
    arm: ArmModel, q: Float64, margin: float, steps: Sequence[tuple[float, float, float]] = CUBE
) -> Iterator[tuple[int, Float64]]:
    """Points of the moving spheres' shells outside of all other spheres, and whose they are."""
    for s in np.flatnonzero(arm.moving_spheres):
        for step in steps:
            away = np.array(step) / np.linalg.norm(step)
            point = arm.sphere_centers(q)[s] + (arm.sphere_set.radii[s] + margin) * away
            others = _gaps(arm, q, point)
            others[s] = np.inf
            if min(others) > 0.01:
                yield int(s), point


def _gaps(arm: ArmModel, q: Float64, point: Float64) -> list[float]:
    spheres = zip(arm.sphere_centers(q), arm.sphere_set.radii, strict=True)
    return [float(np.linalg.norm(point - center) - radius) for center, radius in spheres]
