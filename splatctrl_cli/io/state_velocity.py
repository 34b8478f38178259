"""Joint velocities from positions whose stamps jitter."""

from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from splatctrl_cli.records import Float64

Stamps = NDArray[np.int64]
GAP_PERIODS = 5.0  # a step of the stamps this many times the usual one is a gap
GAP_SECONDS = 0.1  # and of at least this length
PERIOD_SAMPLES = 20  # states over which the period is measured
CLOCK_GAIN = 0.05  # of a stamp's deviation by which the clock that counts states follows
CLOCK_SAMPLES = 50  # states before and after that a stamp is smoothed over
POSITION_SAMPLES = 2  # states before and after that a velocity is fitted to


def gaps_of(stamp_ns: Stamps) -> NDArray[np.intp]:
    """Indices i of the gaps between states i and i + 1; stamps (T,) rise."""
    steps = np.diff(stamp_ns)
    if not len(steps):
        return np.zeros(0, dtype=np.intp)
    longest = max(GAP_PERIODS * float(np.median(steps)), GAP_SECONDS * 1e9)
    return np.flatnonzero(steps > longest)


def smoothed_seconds(stamp_ns: Stamps) -> Float64:
    """Times (T,) [s] since the first stamp of a robot that sends at a fixed rate, without the jitter of sending.

    The line through the stamps of the neighbouring states over their numbers, lost ones counted. Stamps that follow
    no fixed rate (residuals above a quarter of a period), or that would no longer rise, come back as they are.
    """
    seconds = np.asarray((stamp_ns - stamp_ns[0]) * 1e-9, dtype=np.float64)
    if len(seconds) < 3:
        return seconds
    lag = min(PERIOD_SAMPLES, len(seconds) - 1)
    period = float(np.median(seconds[lag:] - seconds[:-lag])) / lag
    number = _numbers(seconds, period)
    index = np.arange(len(seconds))
    first = np.maximum(index - CLOCK_SAMPLES, 0)
    last = np.minimum(index + CLOCK_SAMPLES, len(seconds) - 1) + 1
    residual = seconds - period * number  # small numbers: the sums below keep their digits

    def over(values: Float64) -> Float64:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray((sums[last] - sums[first]) / (last - first))

    mean_k, mean_r = over(number), over(residual)
    spread = over(number**2) - mean_k**2
    slope = (over(number * residual) - mean_k * mean_r) / np.maximum(spread, 1e-12)
    smooth = period * number + mean_r + slope * (number - mean_k)
    is_regular = float(np.sqrt(np.mean((smooth - seconds) ** 2))) < 0.25 * period
    return np.asarray(smooth) if is_regular and bool(np.all(np.diff(smooth) > 0)) else seconds


def _numbers(seconds: Float64, period: float) -> Float64:
    """The number (T,) of each state since the first, lost ones counted.

    A clock that ticks with the period follows the stamps slowly, so that jitter of almost half a period is no loss.
    """
    numbers = np.zeros(len(seconds))
    clock, number = 0.0, 0
    for index in range(1, len(seconds)):
        ticks = max(round((seconds[index] - clock) / period), 1)
        number += ticks
        clock += ticks * period
        clock += CLOCK_GAIN * (seconds[index] - clock)
        numbers[index] = number
    return numbers


def differentiated(stamp_ns: Stamps, position: Float64) -> Float64:
    """Velocities (T, J) [1/s] of positions (T, J) at rising stamps (T,) [ns].

    The slope, at each state, of the parabola through it and its two neighbours on either side (a Savitzky-Golay
    derivative for uneven steps), on the smoothed clock; nothing is fitted across a gap. A state alone has velocity 0.
    """
    velocity = np.zeros_like(position)
    borders = [0, *(gaps_of(stamp_ns) + 1), len(stamp_ns)]
    for start, end in pairwise(borders):
        if end - start > 1:
            velocity[start:end] = _slopes(smoothed_seconds(stamp_ns[start:end]), position[start:end])
    return velocity


def _slopes(seconds: Float64, position: Float64) -> Float64:
    size = min(2 * POSITION_SAMPLES + 1, len(seconds))
    starts = np.clip(np.arange(len(seconds)) - size // 2, 0, len(seconds) - size)
    since = sliding_window_view(seconds, size)[starts] - seconds[:, None]  # (T, size)
    scale = np.ptp(since, axis=1, keepdims=True)
    degree = min(2, size - 1)
    design = (since / scale)[..., None] ** np.arange(degree + 1)  # (T, size, degree + 1)
    weights = np.linalg.pinv(design)[:, 1, :] / scale  # of the slope at the state itself
    windows = sliding_window_view(position, size, axis=0)[starts]  # (T, J, size)
    return np.asarray(np.einsum("ts,tjs->tj", weights, windows))
