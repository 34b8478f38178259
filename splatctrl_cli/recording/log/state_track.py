"""Joint states of one source, cleaned: in time order, one per stamp, with velocities.

Missing velocities come from positions, without the stamps' jitter; faults are counted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from splatctrl_cli.config import fixed
from splatctrl_cli.files.spilled_rows import RowFile, Rows, Table, blocks_of, ranges
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.records import Bool, Float64, LossReport, Stamps


def gaps_of(stamp_ns: Stamps) -> NDArray[np.intp]:
    """Indices i of gaps between states i and i + 1; stamps (T,) rise."""
    steps = np.diff(stamp_ns)
    if not len(steps):
        return np.zeros(0, dtype=np.intp)
    return np.flatnonzero(
        steps > max(fixed.STATES_GAP_PERIODS * float(np.median(steps)), fixed.STATES_GAP_SECONDS * 1e9)
    )


def smoothed_seconds(stamp_ns: Stamps) -> Float64:
    """Times (T,) [s] since the first stamp, without the sender's jitter.

    Fits a line to neighbouring stamps against message numbers, in which lost messages count. Stamps without a fixed
    rate (RMS residual above a quarter period) are returned unchanged.
    """
    seconds = np.asarray((stamp_ns - stamp_ns[0]) * 1e-9, dtype=np.float64)
    if len(seconds) < 3:
        return seconds
    lag = min(fixed.STATES_PERIOD_SAMPLES, len(seconds) - 1)
    period = float(np.median(seconds[lag:] - seconds[:-lag])) / lag
    number = _numbers(seconds, period)
    smooth = np.empty_like(seconds)
    sums, start = np.zeros((4, 1)), 0  # of k, r, k^2 and k r, up to but not with state `start` and those after it
    for begin, end in ranges(len(seconds)):
        index = np.arange(begin, end)
        first = np.maximum(index - fixed.STATES_CLOCK_SAMPLES, 0)
        last = np.minimum(index + fixed.STATES_CLOCK_SAMPLES, len(seconds) - 1) + 1
        fresh = slice(start + sums.shape[1] - 1, last[-1])
        k, r = number[fresh], seconds[fresh] - period * number[fresh]  # small numbers: their sums keep their digits
        grown = np.cumsum(np.hstack([sums[:, -1:], [k, r, k**2, k * r]]), axis=1)
        sums = np.hstack([sums, grown[:, 1:]])
        mean_k, mean_r, mean_kk, mean_kr = (sums[:, last - start] - sums[:, first - start]) / (last - first)
        slope = (mean_kr - mean_k * mean_r) / np.maximum(mean_kk - mean_k**2, 1e-12)
        smooth[begin:end] = period * number[begin:end] + mean_r + slope * (number[begin:end] - mean_k)
        done = max(end - fixed.STATES_CLOCK_SAMPLES - start, 0)  # no later state needs these
        sums, start = sums[:, done:], start + done
    is_regular = float(np.sqrt(np.mean((smooth - seconds) ** 2))) < 0.25 * period
    return smooth if is_regular and bool(np.all(np.diff(smooth) > 0)) else seconds


def _numbers(seconds: Float64, period: float) -> Float64:
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


def differentiate(stamp_ns: Stamps, position: Float64) -> Float64:
    """Velocities (T, J) [1/s] of positions (T, J) at rising stamps (T,) [ns].

    Each is the slope of a parabola through the state and two neighbours on either side (Savitzky-Golay for uneven
    steps). Times are `smoothed_seconds`; no parabola crosses a gap. A lone state has 0.
    """
    return np.concatenate([np.zeros((0, *position.shape[1:])), *(v for _, v in slopes_by_block(stamp_ns, position))])


def slopes_by_block(stamp_ns: Stamps, position: Table) -> Iterator[tuple[int, Float64]]:
    """Yield `differentiate` by block: index of the first state, velocities (K, J)."""
    for start, end in pairwise([0, *(gaps_of(stamp_ns) + 1).tolist(), len(stamp_ns)]):
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
    design = (since / scale)[..., None] ** np.arange(min(size, 3))  # (T, size, coefficients of the parabola)
    weights = np.linalg.pinv(design)[:, 1, :] / scale  # of the slope at the state itself
    windows = sliding_window_view(position, size, axis=0)[starts]  # (T, J, size)
    return np.asarray(np.einsum("ts,tjs->tj", weights, windows))


@dataclass(frozen=True, kw_only=True, eq=False)
class RawTrack(StateColumns):
    """States as recorded, in file order; absent velocity is NaN.

    where: the track's name in messages. log_ns (T,): log times [ns].
    """

    where: str
    names: tuple[str, ...]
    log_ns: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))

    def select_names(self, names: Sequence[str]) -> "RawTrack":
        order = np.array([self.names.index(name) for name in names], dtype=np.int64)
        return replace(self.select_joints(order), names=tuple(names))


def clean_states(raw: RawTrack, loss: LossReport) -> StateColumns:
    """Sort states by stamp, drop repeated stamps, add missing velocities; note changes in `loss`.

    States with a non-finite position are damage, and left out. Velocities that are absent, NaN, or always zero for a
    moving joint become slopes of the positions.
    """
    ordered = unwrap(_sort(_finite(raw, loss), loss), loss)
    gaps = gaps_of(ordered.stamp_ns)
    if len(gaps):
        longest = float(np.max(np.diff(ordered.stamp_ns)[gaps])) * 1e-9
        loss.state_gaps += len(gaps)
        loss.notes.append(f"{raw.where}: {len(gaps)} gaps between states, the longest {longest:.3f} s")
    num = len(ordered.stamp_ns)
    velocity = _add_velocity(ordered, loss) if num else ordered.velocity
    poses = [table for table in (ordered.T_base_ee, ordered.T_world_ee) if table is not None]
    blocks = [[np.isfinite(T[first:last]).all(axis=(1, 2)) for T in poses] for first, last in ranges(len(ordered))]
    num_without = num - sum(int(np.any(block, axis=0).sum()) for block in blocks)
    if 0 < num_without < num:
        loss.notes.append(f"{raw.where}: {num_without} of {num} states have no valid end-effector pose")
    return replace(ordered, velocity=velocity)


def unwrap(raw: RawTrack, loss: LossReport) -> RawTrack:
    """Remove jumps of a whole turn between successive states, such as pi to -pi."""
    position, file = raw.position, RowFile(raw.position.shape[1:])
    turns: Float64 = np.zeros(position.shape[1])
    is_close = np.diff(raw.stamp_ns) * 1e-9 <= fixed.STATES_BRIDGED
    num = np.zeros(len(turns), dtype=np.int64)
    last: Float64 | None = None
    for first, end in ranges(len(position)):
        block = position[first:end]
        steps = np.diff(block if last is None else np.vstack([last, block]), axis=0)
        is_wrap = (np.abs(steps) > fixed.STATES_WRAP) & (np.abs(steps) < 4 * np.pi - fixed.STATES_WRAP)
        is_wrap &= is_close[end - 1 - len(steps) : end - 1, None]
        num += is_wrap.sum(axis=0)
        added = -2 * np.pi * np.cumsum(np.where(is_wrap, np.sign(steps), 0.0), axis=0) + turns
        added = added if last is not None else np.vstack([turns, added])
        file.append(block + added)
        turns, last = added[-1], block[-1]
    if not num.any():
        return raw
    names = ", ".join(name for name, count in zip(raw.names, num, strict=True) if count)
    loss.notes.append(f"{raw.where}: {names}: {int(num.sum())} steps of a whole turn between states are taken out")
    return replace(raw, position=Rows(file))


def _finite(raw: RawTrack, loss: LossReport) -> RawTrack:
    is_finite = np.concatenate(
        [np.zeros(0, np.bool_), *(np.isfinite(block).all(axis=1) for block in blocks_of(raw.position))]
    )
    num_broken = int((~is_finite).sum())
    if not num_broken:
        return raw
    loss.damaged += num_broken
    loss.notes.append(f"{raw.where}: {num_broken} states with NaN or infinity: left out")
    return raw.select(np.flatnonzero(is_finite))


def _sort(raw: RawTrack, loss: LossReport) -> RawTrack:
    num_back = int((np.diff(raw.stamp_ns) < 0).sum())
    if num_back:
        loss.unsorted_states += num_back
        loss.notes.append(f"{raw.where}: stamps go back at {num_back} of {len(raw.stamp_ns)} states: sorted")
        raw = raw.select(np.argsort(raw.stamp_ns, kind="stable"))
    is_again = np.concatenate([[False], np.diff(raw.stamp_ns) == 0])[: len(raw.stamp_ns)]
    num_again = int(is_again.sum())
    if not num_again:
        return raw
    again = np.flatnonzero(is_again)
    parts = [again[first:last] for first, last in ranges(num_again)]
    apart = (np.abs(raw.position[part] - raw.position[part - 1]).max(axis=1) for part in parts)
    num_other = sum(int((distances > fixed.STATES_CONFLICT).sum()) for distances in apart)
    loss.duplicate_states += num_again
    loss.conflicting_states += num_other
    more = f", {num_other} of them with other positions" if num_other else ""
    loss.notes.append(f"{raw.where}: {num_again} states repeat a stamp{more}: the first of each is kept")
    return raw.select(np.flatnonzero(~is_again))


def _add_velocity(raw: RawTrack, loss: LossReport) -> Table:
    num_taken, is_zero, why = _missing_velocities(raw)
    if not num_taken:
        _compare_units(
            raw.select(np.arange(0, len(raw.stamp_ns), 1 + len(raw.stamp_ns) // fixed.STATES_COMPARED)), loss
        )
        return raw.velocity
    loss.differentiated_velocities += num_taken
    loss.notes.append(f"{raw.where}: {why}; they are differences of the positions")
    whole = RowFile(raw.velocity.shape[1:])
    for first, slopes in slopes_by_block(raw.stamp_ns, raw.position):
        logged = raw.velocity[first : first + len(slopes)]
        whole.append(np.where(~np.isfinite(logged) | is_zero, slopes, logged))
    return Rows(whole)


def _missing_velocities(raw: RawTrack) -> tuple[int, Bool, str]:
    """Number of states to differentiate, mask (J,) of moving joints with zero velocity, a note."""
    num, num_joints = raw.position.shape[:2]
    low, high = np.full(num_joints, np.inf), np.full(num_joints, -np.inf)
    is_still, is_missing, is_there = (np.full(num_joints, first) for first in (True, False, False))
    num_missing = 0
    for first, last in ranges(num):
        position, velocity = raw.position[first:last], raw.velocity[first:last]
        missing = ~np.isfinite(velocity)
        low, high = np.minimum(low, position.min(axis=0)), np.maximum(high, position.max(axis=0))
        is_still &= (np.where(missing, 0.0, velocity) == 0).all(axis=0)
        is_missing |= missing.any(axis=0)
        is_there |= ~missing.all(axis=0)
        num_missing += int(missing.any(axis=1).sum())
    is_zero = np.asarray(is_still & is_there & (high - low > fixed.STATES_STILL))
    named = is_zero if is_zero.any() else is_missing
    joints = ", ".join(name for name, is_named in zip(raw.names, named, strict=True) if is_named)
    if not is_there.any():
        return num_missing, is_zero, "no velocities recorded"
    if is_zero.any():
        return num, is_zero, f"velocities of {joints} are zero throughout although they move"
    return num_missing, is_zero, f"velocities of {joints} are missing or NaN in {num_missing} states"


def _compare_units(raw: RawTrack, loss: LossReport) -> None:
    position, velocity = raw.position[: len(raw.stamp_ns)], raw.velocity[: len(raw.stamp_ns)]
    slopes: Float64 = differentiate(raw.stamp_ns, position)
    is_fast = np.abs(slopes) > fixed.STATES_SPEED
    if is_fast.sum() < 10:
        return
    ratio = float(np.median(np.abs(velocity[is_fast])) / np.median(np.abs(slopes[is_fast])))
    if not 1 / fixed.STATES_SPEED_RATIO < ratio < fixed.STATES_SPEED_RATIO:
        loss.notes.append(
            f"{raw.where}: logged velocities are {ratio:.3g} times the change of the positions: other units, "
            "or stamps of another rate"
        )
