"""Joint states of one source, cleaned: in time order, one per stamp, with velocities; what was wrong is counted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.io.state_velocity import Stamps, differentiated, gaps_of
from splatctrl_cli.records import Bool, Float64, JointState, LossReport

STILL = 1e-3  # [rad or m] of motion under which a velocity of zero is believed
CONFLICT = 1e-6  # [rad or m] between states of one stamp
SPEED_RATIO = 3.0  # of logged to differentiated speeds beyond which their units differ
COMPARED = 5000  # states at most, spread over the log
MOVING = 0.05  # [1/s] speeds that are compared


@dataclass(frozen=True, kw_only=True)
class RawTrack:
    """Joint states as recorded, in file order.

    stamp_ns (T,); position (T, J); velocity (T, J), NaN where absent; commanded_velocity (T, J), T_base_ee and
    T_world_ee (T, 4, 4), NaN where absent, None where there are none.
    where: what to call it in a message (a topic, a file).
    """

    where: str
    names: tuple[str, ...]
    stamp_ns: Stamps
    position: Float64
    velocity: Float64
    commanded_velocity: Float64 | None = None
    T_base_ee: Float64 | None = None
    T_world_ee: Float64 | None = None

    def select(self, keep: Bool | NDArray[np.intp]) -> "RawTrack":
        """The states of a mask (T,), or of indices, in that order."""
        commanded, base, world = self.commanded_velocity, self.T_base_ee, self.T_world_ee
        return RawTrack(
            where=self.where,
            names=self.names,
            stamp_ns=self.stamp_ns[keep],
            position=self.position[keep],
            velocity=self.velocity[keep],
            commanded_velocity=None if commanded is None else commanded[keep],
            T_base_ee=None if base is None else base[keep],
            T_world_ee=None if world is None else world[keep],
        )

    def of_joints(self, names: Sequence[str]) -> "RawTrack":
        """The columns of these joints, in that order."""
        order = [self.names.index(name) for name in names]
        commanded = self.commanded_velocity
        return replace(
            self,
            names=tuple(names),
            position=self.position[:, order],
            velocity=self.velocity[:, order],
            commanded_velocity=None if commanded is None else commanded[:, order],
        )


def cleaned(raw: RawTrack, loss: LossReport) -> list[JointState]:
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
    velocity = _with_velocity(ordered, loss) if len(ordered.stamp_ns) else ordered.velocity
    commanded = _optional(ordered.commanded_velocity, len(ordered.stamp_ns))
    base, world = (_optional(T, len(ordered.stamp_ns)) for T in (ordered.T_base_ee, ordered.T_world_ee))
    num_without = sum(a is None and b is None for a, b in zip(base, world, strict=True))
    if 0 < num_without < len(base):
        loss.notes.append(f"{raw.where}: {num_without} of {len(base)} states have no valid end-effector pose")
    return [
        JointState(
            stamp_ns=int(stamp),
            position=ordered.position[index],
            velocity=velocity[index],
            commanded_velocity=commanded[index],
            T_base_ee=base[index],
            T_world_ee=world[index],
        )
        for index, stamp in enumerate(ordered.stamp_ns)
    ]


def _optional(values: Float64 | None, num_states: int) -> list[Float64 | None]:
    """A value per state, None where it is not finite."""
    if values is None:
        return [None] * num_states
    return [value if np.isfinite(value).all() else None for value in values]


def _finite(raw: RawTrack, loss: LossReport) -> RawTrack:
    is_finite: Bool = np.asarray(np.isfinite(raw.position).all(axis=1))
    num_broken = int((~is_finite).sum())
    if not num_broken:
        return raw
    loss.damaged += num_broken
    loss.notes.append(f"{raw.where}: {num_broken} states with NaN or infinity: left out")
    return raw.select(is_finite)


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
    again = np.flatnonzero(is_again)
    differs = np.abs(raw.position[again] - raw.position[again - 1]).max(axis=1) > CONFLICT
    loss.duplicate_states += num_again
    more = f", {int(differs.sum())} of them with other positions" if differs.any() else ""
    loss.notes.append(f"{raw.where}: {num_again} states repeat a stamp{more}: the first of each is kept")
    return raw.select(~is_again)


def _with_velocity(raw: RawTrack, loss: LossReport) -> Float64:
    """velocity (T, J) with what is missing taken from the positions."""
    missing = ~np.isfinite(raw.velocity)
    moved = np.ptp(raw.position, axis=0) > STILL
    is_still = np.asarray((np.where(missing, 0.0, raw.velocity) == 0).all(axis=0))
    is_zero = is_still & ~missing.all(axis=0) & moved
    taken = missing | is_zero
    if not taken.any():
        thinned = raw.select(np.arange(0, len(raw.stamp_ns), 1 + len(raw.stamp_ns) // COMPARED))
        _compare_units(thinned, differentiated(thinned.stamp_ns, thinned.position), loss)
        return raw.velocity
    loss.differentiated_velocities += int(taken.any(axis=1).sum())
    loss.notes.append(f"{raw.where}: {_reason(raw, missing, is_zero)}; they are differences of the positions")
    return np.where(taken, differentiated(raw.stamp_ns, raw.position), raw.velocity)


def _reason(raw: RawTrack, missing: Bool, is_zero: Bool) -> str:
    if missing.all():
        return "no velocities recorded"
    if is_zero.any():
        joints = ", ".join(name for name, zero in zip(raw.names, is_zero, strict=True) if zero)
        return f"velocities of {joints} are zero throughout although they move"
    joints = ", ".join(name for index, name in enumerate(raw.names) if missing[:, index].any())
    return f"velocities of {joints} are missing or NaN in {int(missing.any(axis=1).sum())} states"


def _compare_units(raw: RawTrack, slopes: Float64, loss: LossReport) -> None:
    is_fast = np.abs(slopes) > MOVING
    if is_fast.sum() < 10:
        return
    ratio = float(np.median(np.abs(raw.velocity[is_fast])) / np.median(np.abs(slopes[is_fast])))
    if not 1 / SPEED_RATIO < ratio < SPEED_RATIO:
        loss.notes.append(
            f"{raw.where}: logged velocities are {ratio:.3g} times the change of the positions: other units, "
            "or stamps of another rate"
        )
