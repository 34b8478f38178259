"""How a simulated arm moves: from waypoint to waypoint."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.records import Float64


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Waypoints (W, J) [rad], reached at rest at times (W,) [s], joined by minimum-jerk segments."""

    times: Float64
    waypoints: Float64

    def at(self, time: float) -> tuple[Float64, Float64]:
        """Positions (J,) [rad] and velocities (J,) [rad/s]; at rest before the first and after the last waypoint."""
        time = float(np.clip(time, self.times[0], self.times[-1]))
        index = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2))
        span = self.times[index + 1] - self.times[index]
        s = (time - self.times[index]) / span
        step = self.waypoints[index + 1] - self.waypoints[index]
        position = self.waypoints[index] + step * (10 * s**3 - 15 * s**4 + 6 * s**5)
        return position, step * (30 * s**2 - 60 * s**3 + 30 * s**4) / span
