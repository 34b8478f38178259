"""Joint velocity limits that shrink towards the position limits, as published for the Franka Research 3.

Highest: ``min(v_max, max(0, sqrt(max(0, k (q_upper - q))) - v_0))``; lowest: the same of ``q - q_lower``, negative.
The numbers are those of Franka's control parameters and of libfranka (include/franka/rate_limiting.h,
computeUpperLimitsJointVelocity and computeLowerLimitsJointVelocity), without its tolerance of 1e-3 rad/s.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Float64

FR3 = "fr3"
FR3_JOINTS = (  # v_max [rad/s], v_0 [rad/s], k [rad/s^2], q_lower [rad], q_upper [rad]
    (2.62, 0.30, 12.0, -2.7501, 2.7501),
    (2.62, 0.20, 5.17, -1.7918, 1.7918),
    (2.62, 0.20, 7.00, -2.9065, 2.9065),
    (2.62, 0.30, 8.00, -3.0481, -0.1458),
    (5.26, 0.35, 34.0, -2.8101, 2.8101),
    (4.18, 0.35, 11.0, 0.54092, 4.5205),
    (5.26, 0.35, 34.0, -3.0196, 3.0196),
)


@dataclass(frozen=True, kw_only=True)
class VelocityLimits:
    """The velocity limits of J joints by position: most (J,) [rad/s] everywhere; near a position limit
    ``sqrt(slope (limit - q)) - offset`` with slope (J,) [rad/s^2], offset (J,) [rad/s]; lower, upper (J,) [rad].
    """

    most: Float64
    offset: Float64
    slope: Float64
    lower: Float64
    upper: Float64

    def at(self, q: Float64) -> tuple[Float64, Float64]:
        """Lowest and highest velocity (J,), (J,) [rad/s] at q (J,): zero lies between them."""
        return -self._towards(q - self.lower), self._towards(self.upper - q)

    def _towards(self, room: Float64) -> Float64:
        speed = np.sqrt(np.maximum(self.slope * room, 0.0)) - self.offset
        return np.minimum(self.most, np.maximum(speed, 0.0))


def fr3_limits(joint_names: Sequence[str]) -> VelocityLimits:
    """The limits of the FR3's joints, which are told by what their names end in.

    Raises UsageError for a joint that is none of the arm's, or named twice.
    """
    found = [re.search(r"(?:^|_)joint([1-7])$", name) for name in joint_names]
    numbers = [0 if match is None else int(match.group(1)) for match in found]
    odd = [name for name, n in zip(joint_names, numbers, strict=True) if n == 0 or numbers.count(n) > 1]
    if odd:
        raise UsageError(
            f"control.velocity_limits = fr3: expected names that end in joint1 to joint7, got {', '.join(odd)}",
            remedy="lock the others (--lock), or set control.velocity_limits = urdf",
        )
    table = np.array([FR3_JOINTS[number - 1] for number in numbers]).T
    return VelocityLimits(most=table[0], offset=table[1], slope=table[2], lower=table[3], upper=table[4])
