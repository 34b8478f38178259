"""Joint velocities from positions whose stamps jitter."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from splatctrl_cli.config import fixed
from splatctrl_cli.files.spilled_rows import Table, ranges
from splatctrl_cli.records import Float64, Stamps


def gaps_of(stamp_ns: Stamps) -> NDArray[np.intp]:
    """Indices i of the gaps between states i and i + 1; stamps (T,) rise."""
    steps = np.diff(stamp_ns)
    if not len(steps):
        return np.zeros(0, dtype=np.intp)
    longest = max(fixed.STATES_GAP_PERIODS * float(np.median(steps)), fixed.STATES_GAP_SECONDS * 1e9)
    return np.flatnonzero(steps > longest)


def smoothed_seconds(stamp_ns: Stamps) -> Float64:
    """Times (T,) [s] since the first stamp of a robot that sends at a fixed rate, without the jitter of sending.

    The line through the stamps of the neighbouring states over their numbers, lost ones counted. Stamps that follow
    no fixed rate (residuals above a quarter of a period), or that would no longer rise, come back as they are.
    """
    seconds = np.asarray((stamp_ns - stamp_ns[0]) * 1e-9, dtype=np.float64)
    if len(seconds) < 3:
        return seconds
    lag = min(fixed.STATES_PERIOD_SAMPLES, len(seconds) - 1)
    period = float(np.median(seconds[lag:] - seconds[:-lag])) / lag
    number = _numbers(seconds, period)
    smooth = np.empty_like(seconds)
    sums = _Sums()
    for begin, end in ranges(len(seconds)):
        index = np.arange(begin, end)
        first = np.maximum(index - fixed.STATES_CLOCK_SAMPLES, 0)
        last = np.minimum(index + fixed.STATES_CLOCK_SAMPLES, len(seconds) - 1) + 1
        k, residual = number[: last[-1]], seconds[sums.num : last[-1]] - period * number[sums.num : last[-1]]
        sums.add(k[sums.num :], residual)  # small numbers: the sums below keep their digits
        mean_k, mean_r, mean_kk, mean_kr = sums.means(first, last)
        slope = (mean_kr - mean_k * mean_r) / np.maximum(mean_kk - mean_k**2, 1e-12)
        smooth[begin:end] = period * number[begin:end] + mean_r + slope * (number[begin:end] - mean_k)
        sums.forget(end - fixed.STATES_CLOCK_SAMPLES)
    is_regular = float(np.sqrt(np.mean((smooth - seconds) ** 2))) < 0.25 * period
    return smooth if is_regular and bool(np.all(np.diff(smooth) > 0)) else seconds


class _Sums:
    """Running sums of k, r, k^2 and k r over all states so far, of which the newest are kept."""

    def __init__(self) -> None:
        self._sums = np.zeros((4, 1))  # up to but not with state `_start` and those after it
        self._start = 0

    @property
    def num(self) -> int:
        """States that were added."""
        return self._start + self._sums.shape[1] - 1

    def add(self, k: Float64, r: Float64) -> None:
        """The next states' (T,)."""
        rows = [np.cumsum(np.concatenate([s[-1:], v])) for s, v in zip(self._sums, (k, r, k**2, k * r), strict=True)]
        self._sums = np.hstack([self._sums, np.array(rows)[:, 1:]])

    def means(self, first: NDArray[np.intp], last: NDArray[np.intp]) -> Float64:
        """(4, T) of the states from each first up to its last."""
        return np.asarray((self._sums[:, last - self._start] - self._sums[:, first - self._start]) / (last - first))

    def forget(self, before: int) -> None:
        """The sums that no later state asks for."""
        if before > self._start:
            self._sums, self._start = self._sums[:, before - self._start :].copy(), before


def _numbers(seconds: Float64, period: float) -> Float64:
    """The number (T,) of each state since the first, lost ones counted.

    A clock that ticks with the period follows the stamps slowly, so that jitter of almost half a period
    is not taken for a loss.
    """
    numbers = np.zeros(len(seconds))
    clock, number = 0.0, 0
    for first, last in ranges(len(seconds)):
        block: list[int] = []
        for second in seconds[first:last].tolist():
            ticks = max(round((second - clock) / period), 1) if first or block else 0
            number += ticks
            clock += ticks * period
            clock += fixed.STATES_CLOCK_GAIN * (second - clock)
            block.append(number)
        numbers[first:last] = block
    return numbers


def differentiated(stamp_ns: Stamps, position: Float64) -> Float64:
    """Velocities (T, J) [1/s] of positions (T, J) at rising stamps (T,) [ns].

    The slope, at each state, of the parabola through it and its two neighbours on either side (a Savitzky-Golay
    derivative for uneven steps), on the smoothed clock; nothing is fitted across a gap. A state alone has velocity 0.
    """
    return np.concatenate([np.zeros((0, *position.shape[1:])), *(v for _, v in slopes_by_block(stamp_ns, position))])


def slopes_by_block(stamp_ns: Stamps, position: Table) -> Iterator[tuple[int, Float64]]:
    """`differentiated` a block at a time: the first state of each and the velocities (K, J) there."""
    borders = [0, *(gaps_of(stamp_ns) + 1).tolist(), len(stamp_ns)]
    for start, end in pairwise(borders):
        if end - start == 1:
            yield start, np.zeros((1, *position.shape[1:]))
            continue
        seconds = smoothed_seconds(stamp_ns[start:end])
        size = min(2 * fixed.STATES_POSITION_SAMPLES + 1, end - start)
        for first, last in ranges(end - start):
            low, high = max(min(first - size // 2, end - start - size), 0), min(last + size // 2, end - start)
            high = max(high, min(low + size, end - start))
            slopes = _slopes(seconds[low:high], position[start + low : start + high])
            yield start + first, slopes[first - low : last - low]


def _slopes(seconds: Float64, position: Float64) -> Float64:
    size = min(2 * fixed.STATES_POSITION_SAMPLES + 1, len(seconds))
    starts = np.clip(np.arange(len(seconds)) - size // 2, 0, len(seconds) - size)
    since = sliding_window_view(seconds, size)[starts] - seconds[:, None]  # (T, size)
    scale = np.ptp(since, axis=1, keepdims=True)
    degree = min(2, size - 1)
    design = (since / scale)[..., None] ** np.arange(degree + 1)  # (T, size, degree + 1)
    weights = np.linalg.pinv(design)[:, 1, :] / scale  # of the slope at the state itself
    windows = sliding_window_view(position, size, axis=0)[starts]  # (T, J, size)
    return np.asarray(np.einsum("ts,tjs->tj", weights, windows))
