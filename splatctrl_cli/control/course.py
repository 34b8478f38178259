"""Where a replay's frame should be at each time: a motion as it was logged, followed pose by pose."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.audit import Stamps
from splatctrl_cli.control.target import Guide
from splatctrl_cli.records import Float64, FloatRows


@dataclass(frozen=True, kw_only=True)
class LoggedMotion:
    """T logged states by time: stamp_ns (T,) that never go back, position and velocity (T, J) [rad, rad/s], which may
    be read from a file.
    """

    stamp_ns: Stamps
    position: FloatRows
    velocity: FloatRows

    @property
    def last_ns(self) -> int:
        """Stamp of the last state."""
        return int(self.stamp_ns[-1])

    def at(self, stamp_ns: int) -> tuple[Float64, Float64]:
        """Position and velocity (J,) at a stamp, linear between states; the first before all, and the last, at rest,
        after all.
        """
        if stamp_ns > self.last_ns:
            return np.asarray(self.position[-1]), np.zeros(self.position.shape[1])
        after = int(np.searchsorted(self.stamp_ns, stamp_ns, side="left"))
        if after == 0 or self.stamp_ns[after] == stamp_ns:
            return np.asarray(self.position[after]), np.asarray(self.velocity[after])
        before_ns, after_ns = self.stamp_ns[after - 1 : after + 1]
        share = float(stamp_ns - before_ns) / float(after_ns - before_ns)
        position, velocity = (
            (1.0 - share) * values[after - 1] + share * values[after] for values in (self.position, self.velocity)
        )
        return position, velocity

    def goal_at(self, model: ArmModel, frame: str, stamp_ns: int) -> tuple[Float64, Guide]:
        """The logged pose (4, 4) of a frame at a stamp, and how it and the posture moved then."""
        position, velocity = self.at(stamp_ns)
        return guided_goal(model, frame, position, velocity)


def guided_goal(model: ArmModel, frame: str, position: Float64, velocity: Float64) -> tuple[Float64, Guide]:
    """The pose (4, 4) of a frame at a posture (J,) that moves with a velocity (J,), as a goal that moves."""
    twist = model.frame_jacobian(position, frame) @ velocity
    return model.frame_pose(position, frame), Guide(twist=twist, posture=position, velocity=velocity)
