"""Whether a motion keeps the joints' velocity and acceleration limits, from its positions, a block at a time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import ENCODER, MOTION_WINDOW
from splatctrl_cli.records import Float64, Stamps


@dataclass(frozen=True, kw_only=True)
class Strain:
    """Of T states: the largest velocity (T,) as a share of its joint's limit, at joint (T,); likewise acceleration,
    0 throughout where there is no limit.
    """

    velocity: Float64
    velocity_joint: NDArray[np.int64]
    acceleration: Float64
    acceleration_joint: NDArray[np.int64]


class MotionLimits:
    """Velocities from the last state, and from `MOTION_WINDOW` earlier, each less what the encoder may be off;
    accelerations from three places `MOTION_WINDOW` apart. A sample is of the time before it.
    """

    def __init__(self, velocity_limit: Float64, acceleration_limit: Float64 | None) -> None:
        """velocity_limit (J,) [1/s], acceleration_limit (J,) [1/s^2] or None."""
        self._velocity, self._acceleration = velocity_limit, acceleration_limit
        self._stamps: Stamps = np.zeros(0, np.int64)
        self._positions: Float64 = np.zeros((0, len(velocity_limit)))

    def add(self, stamps: Stamps, positions: Float64) -> Strain:
        """The next states: stamps (T,) [ns], positions (T, J)."""
        num = len(stamps)
        all_stamps = np.concatenate([self._stamps, stamps])
        everything = np.concatenate([self._positions, positions])
        first = len(all_stamps) - num
        share = np.zeros((num, positions.shape[1]))
        window = np.int64(MOTION_WINDOW * 1e9)
        last = np.arange(first, first + num) - 1
        for before in (last, np.minimum(last, np.searchsorted(all_stamps, stamps - window, "right") - 1)):
            has = np.flatnonzero(before >= 0)
            seconds = (stamps[has] - all_stamps[before[has]]) * 1e-9
            moved = np.maximum(np.abs(positions[has] - everything[before[has]]) - 2 * ENCODER, 0.0)
            speed = moved / np.maximum(seconds, 1e-9)[:, None]
            share[has] = np.maximum(share[has], speed / self._velocity)
        sudden = np.zeros_like(share)
        if self._acceleration is not None:
            sudden = self._accelerations(stamps, all_stamps, everything) / self._acceleration
        oldest = max(int(np.searchsorted(all_stamps, stamps[-1] - 2 * window, "right")) - 1, 0)
        self._stamps, self._positions = all_stamps[oldest:], everything[oldest:]
        rows = np.arange(num)
        fastest, hardest = share.argmax(axis=1), sudden.argmax(axis=1)
        return Strain(
            velocity=share[rows, fastest],
            velocity_joint=fastest.astype(np.int64),
            acceleration=sudden[rows, hardest],
            acceleration_joint=hardest.astype(np.int64),
        )

    def _accelerations(self, stamps: Stamps, all_stamps: Stamps, everything: Float64) -> Float64:
        """(T, J) [1/s^2], less what the encoder may be off; 0 where the motion is not old enough."""
        seconds = (all_stamps - all_stamps[0]) * 1e-9
        now = (stamps - all_stamps[0]) * 1e-9
        found = np.zeros((len(stamps), everything.shape[1]))
        old = now >= 2 * MOTION_WINDOW
        for joint in range(everything.shape[1]):
            at = [np.interp(now[old] - k * MOTION_WINDOW, seconds, everything[:, joint]) for k in range(3)]
            second = np.abs(at[0] - 2 * at[1] + at[2]) - 4 * ENCODER
            found[old, joint] = np.maximum(second, 0.0) / MOTION_WINDOW**2
        return found
