"""The logged command of a person's joystick, or of another controller, as the end-effector velocity to reach for."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.audit import Stamps
from splatctrl_cli.control.target import Guide, reference_velocity
from splatctrl_cli.records import Bool, Float64


@dataclass(frozen=True, kw_only=True)
class TwistTrack:
    """N twists by time: stamp_ns (N,) that rise, twist (N, 6) [m/s, rad/s] of the controlled frame, linear first.

    axes: the frame whose axes they are in, turned with it as the arm moves; None for those of the world.
    """

    stamp_ns: Stamps
    twist: Float64
    axes: str | None = None

    def at(self, stamp_ns: int, timeout: float) -> Float64:
        """The newest twist (6,) not later than a stamp [ns]; zero where it is older than `timeout` [s] or none is."""
        index = int(np.searchsorted(self.stamp_ns, stamp_ns, side="right")) - 1
        if index < 0 or (stamp_ns - self.stamp_ns[index]) * 1e-9 > timeout:
            return np.zeros(6)
        return np.asarray(self.twist[index])

    def is_known(self, stamp_ns: Stamps, timeout: float) -> Bool:
        """Whether a twist holds at each stamp (T,)."""
        index = np.searchsorted(self.stamp_ns, stamp_ns, side="right") - 1
        age = (stamp_ns - self.stamp_ns[np.maximum(index, 0)]) * 1e-9
        return np.asarray((index >= 0) & (age <= timeout))

    def asked(self, model: ArmModel, q: Float64, stamp_ns: int, timeout: float) -> Float64:
        """The twist (6,) of a stamp in the world's axes, at a posture (J,); not capped."""
        twist = self.at(stamp_ns, timeout)
        if self.axes is None:
            return twist
        R = model.frame_pose(q, self.axes)[:3, :3]
        return np.concatenate([R @ twist[:3], R @ twist[3:]])

    def reference(self, model: ArmModel, config: ControlConfig, q: Float64, stamp_ns: int) -> Float64:
        """What the controller reaches for (6,), world: the twist, each part capped in norm as any reference."""
        return reference_velocity(
            self.asked(model, q, stamp_ns, config.twist_timeout),
            gain=1.0,
            max_linear=config.max_linear_speed,
            max_angular=config.max_angular_speed,
        )

    def goal_at(
        self, model: ArmModel, config: ControlConfig, frame: str, q: Float64, stamp_ns: int
    ) -> tuple[Float64, Guide]:
        """The frame's own pose (4, 4) as a goal that moves with the twist; the posture leans nowhere."""
        twist = self.reference(model, config, q, stamp_ns)
        return model.frame_pose(q, frame), Guide(twist=twist, posture=q, velocity=np.zeros(len(q)))
