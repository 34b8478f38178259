"""Joint states of one source, cleaned: in time order, one per stamp, with velocities; what was wrong is counted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.config import fixed
from splatctrl_cli.files.spilled_rows import RowFile, Rows, Table, ranges
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.logs.state_velocity import differentiated, gaps_of, slopes_by_block
from splatctrl_cli.records import Bool, Float64, LossReport


@dataclass(frozen=True, kw_only=True, eq=False)
class RawTrack(StateColumns):
    """Joint states as recorded, in file order; velocity is NaN where absent.

    where: what to call it in a message (a topic, a file).
    """

    where: str
    names: tuple[str, ...]

    def of_names(self, names: Sequence[str]) -> "RawTrack":
        """The columns of these joints, in that order."""
        order = np.array([self.names.index(name) for name in names], dtype=np.int64)
        return replace(self.of_joints(order), names=tuple(names))


@dataclass(frozen=True, kw_only=True)
class _Velocities:
    """What is known of T velocities: is_missing, is_zero (J,) for joints that have none, or that move at zero;
    num_missing: states without one of a joint, num_taken: states in which one has to be taken from the positions.
    """

    is_missing: Bool
    is_all_missing: bool
    is_zero: Bool
    num_missing: int
    num_taken: int


def cleaned(raw: RawTrack, loss: LossReport) -> StateColumns:
    """The states by stamp, each stamp once, each with velocities; every change is noted in `loss`.

    States with a position that is not finite are damage and left out; of states with one stamp the first is kept;
    velocities that are absent, NaN, or zero throughout for a joint that moves, are differences of the positions.
    """
    ordered = _in_order(_finite(raw, loss), loss)
    gaps = gaps_of(ordered.stamp_ns)
    if len(gaps):
        longest = float(np.max(np.diff(ordered.stamp_ns)[gaps])) * 1e-9
        loss.state_gaps += len(gaps)
        loss.notes.append(f"{raw.where}: {len(gaps)} gaps between states, the longest {longest:.3f} s")
    num = len(ordered.stamp_ns)
    velocity = _with_velocity(ordered, loss) if num else ordered.velocity
    num_without = num - _num_posed(ordered)
    if 0 < num_without < num:
        loss.notes.append(f"{raw.where}: {num_without} of {num} states have no valid end-effector pose")
    return replace(ordered, velocity=velocity)


def _num_posed(raw: RawTrack) -> int:
    """States with an end-effector pose."""
    num = 0
    for first, last in ranges(len(raw.stamp_ns)):
        there = np.zeros(last - first, dtype=np.bool_)
        for poses in (raw.T_base_ee, raw.T_world_ee):
            if poses is not None:
                there |= np.isfinite(poses[first:last]).all(axis=(1, 2))
        num += int(there.sum())
    return num


def _finite(raw: RawTrack, loss: LossReport) -> RawTrack:
    is_finite = np.zeros(len(raw.stamp_ns), dtype=np.bool_)
    for first, last in ranges(len(is_finite)):
        is_finite[first:last] = np.isfinite(raw.position[first:last]).all(axis=1)
    num_broken = int((~is_finite).sum())
    if not num_broken:
        return raw
    loss.damaged += num_broken
    loss.notes.append(f"{raw.where}: {num_broken} states with NaN or infinity: left out")
    return raw.select(np.flatnonzero(is_finite))


def _in_order(raw: RawTrack, loss: LossReport) -> RawTrack:
    num_back = int((np.diff(raw.stamp_ns) < 0).sum())
    if num_back:
        loss.unsorted_states += num_back
        loss.notes.append(f"{raw.where}: stamps go back at {num_back} of {len(raw.stamp_ns)} states: sorted")
        raw = raw.select(np.argsort(raw.stamp_ns, kind="stable"))
    is_again = np.concatenate([[False], np.diff(raw.stamp_ns) == 0])[: len(raw.stamp_ns)]
    num_again = int(is_again.sum())
    if not num_again:
        return raw
    again, num_other = np.flatnonzero(is_again), 0
    for first, last in ranges(num_again):
        part = again[first:last]
        differs = np.abs(raw.position[part] - raw.position[part - 1]).max(axis=1) > fixed.STATES_CONFLICT
        num_other += int(differs.sum())
    loss.duplicate_states += num_again
    loss.conflicting_states += num_other
    more = f", {num_other} of them with other positions" if num_other else ""
    loss.notes.append(f"{raw.where}: {num_again} states repeat a stamp{more}: the first of each is kept")
    return raw.select(np.flatnonzero(~is_again))


def _with_velocity(raw: RawTrack, loss: LossReport) -> Table:
    """velocity (T, J) with what is missing taken from the positions."""
    found = _looked_at(raw)
    if not found.num_taken:
        thinned = raw.select(np.arange(0, len(raw.stamp_ns), 1 + len(raw.stamp_ns) // fixed.STATES_COMPARED))
        _compare_units(thinned, loss)
        return raw.velocity
    loss.differentiated_velocities += found.num_taken
    loss.notes.append(f"{raw.where}: {_reason(raw, found)}; they are differences of the positions")
    whole = RowFile(raw.velocity.shape[1:])
    for first, slopes in slopes_by_block(raw.stamp_ns, raw.position):
        logged = raw.velocity[first : first + len(slopes)]
        whole.append(np.where(~np.isfinite(logged) | found.is_zero, slopes, logged))
    return Rows(whole)


def _looked_at(raw: RawTrack) -> _Velocities:
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
    return _Velocities(
        is_missing=is_missing,
        is_all_missing=not is_there.any(),
        is_zero=is_zero,
        num_missing=num_missing,
        num_taken=num if is_zero.any() else num_missing,
    )


def _reason(raw: RawTrack, found: _Velocities) -> str:
    if found.is_all_missing:
        return "no velocities recorded"
    if found.is_zero.any():
        joints = ", ".join(name for name, zero in zip(raw.names, found.is_zero, strict=True) if zero)
        return f"velocities of {joints} are zero throughout although they move"
    joints = ", ".join(name for name, missing in zip(raw.names, found.is_missing, strict=True) if missing)
    return f"velocities of {joints} are missing or NaN in {found.num_missing} states"


def _compare_units(raw: RawTrack, loss: LossReport) -> None:
    """Of states that are few enough to be read at once."""
    position, velocity = raw.position[: len(raw.stamp_ns)], raw.velocity[: len(raw.stamp_ns)]
    slopes: Float64 = differentiated(raw.stamp_ns, position)
    is_fast = np.abs(slopes) > fixed.STATES_SPEED
    if is_fast.sum() < 10:
        return
    ratio = float(np.median(np.abs(velocity[is_fast])) / np.median(np.abs(slopes[is_fast])))
    if not 1 / fixed.STATES_SPEED_RATIO < ratio < fixed.STATES_SPEED_RATIO:
        loss.notes.append(
            f"{raw.where}: logged velocities are {ratio:.3g} times the change of the positions: other units, "
            "or stamps of another rate"
        )
