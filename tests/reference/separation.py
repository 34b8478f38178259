"""ISO/TS 15066:2016, 5.5.4.2.3, each formula as it stands, integrals by small steps."""

from collections.abc import Callable, Mapping
from itertools import pairwise

STEP = 1e-5  # [s]


def integral(speed: Callable[[float], float], start: float, end: float) -> float:
    """The distance [m] at a speed of time, by the rule of midpoints."""
    num = max(round((end - start) / STEP), 1)
    width = (end - start) / num
    return sum(speed(start + (k + 0.5) * width) for k in range(num)) * width


def protective_distance(s_h: float, s_r: float, s_s: float, c: float, z_d: float, z_r: float) -> float:
    """(1)."""
    return s_h + s_r + s_s + c + z_d + z_r


def person(v_h: float, t_r: float, t_s: float) -> float:
    """(2), of which (3) is that of a constant speed."""
    return integral(lambda _: v_h, 0.0, t_r + t_s)


def reaction(v_r: float, t_r: float) -> float:
    """(4), of which (5) is that of a constant speed; an arm that goes away does not count."""
    return integral(lambda _: max(v_r, 0.0), 0.0, t_r)


def braking(v: float, fastest: float, deceleration: float) -> tuple[float, float]:
    """T_s, and (6) of a part at speed v on an arm whose fastest part brakes by `deceleration`."""
    t_s = fastest / deceleration
    return t_s, integral(lambda t: v * (1.0 - t / t_s), 0.0, t_s) if t_s else 0.0


def between(share: float, table: Mapping[float, float]) -> float:
    """The value at a share of the speed, on straight lines through the table and 0."""
    points = sorted({0.0: 0.0, **table}.items())
    for (low, first), (high, last) in pairwise(points):
        if low <= share <= high:
            return first + (last - first) * (share - low) / (high - low)
    raise AssertionError(share)


def largest_scale(travel: Callable[[float], float], room: float, num: int = 1000) -> float:
    """The largest of num + 1 scales from 0 to 1 at which the travel is within the room, 0 for none."""
    return max((k / num for k in range(num + 1) if travel(k / num) <= room), default=0.0)
