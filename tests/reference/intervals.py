"""Float64 references of what the verdict takes from motions: one formula, one plain loop each."""

import numpy as np

from splatctrl_cli.records import Float64, Stamps
from splatctrl_cli.robot.model import RobotModel


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


def points_beside(arm: RobotModel, q: Float64, reach: float, step: float) -> list[tuple[Float64, float, str]]:
    """Points of a lattice outside of all spheres and within `reach` of a moving one, how far off, and whose link."""
    centers, found = arm.sphere_centers(q), []
    low, high = (centers.min(axis=0) - 0.12) / step, (centers.max(axis=0) + 0.12) / step
    for cell in np.ndindex(*(int(n) for n in np.ceil(high - low))):
        point = step * (np.floor(low) + cell)
        gaps = _gaps(arm, q, point)
        moving = [gap if moves else np.inf for gap, moves in zip(gaps, arm.moving_spheres, strict=True)]
        if min(gaps) > 0 and min(moving) <= reach:
            found.append((point, min(moving), arm.sphere_set.links[int(np.argmin(moving))]))
    return found


def _gaps(arm: RobotModel, q: Float64, point: Float64) -> list[float]:
    spheres = zip(arm.sphere_centers(q), arm.sphere_set.radii, strict=True)
    return [float(np.linalg.norm(point - center) - radius) for center, radius in spheres]
