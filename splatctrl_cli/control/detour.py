"""A planned way out of a local minimum: the controller's goal moves along it, and waits for the arm."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.course import guided_goal
from splatctrl_cli.control.target import Guide
from splatctrl_cli.records import Float64


class Path(Protocol):
    """A motion with a clock; `planner.path.TimedPath` is one."""

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        ...

    def at(self, time: float) -> tuple[Float64, Float64]:
        """Position and velocity (1, J) at a time [s]."""
        ...


@dataclass
class Detour:
    """A path with a clock that runs on only while the frame is within `wait_distance` [m] of its goal on the path."""

    path: Path
    wait_distance: float
    clock: float = 0.0

    @property
    def is_over(self) -> bool:
        """True once the goal stands at the path's end."""
        return self.clock >= self.path.duration

    def goal(self, model: ArmModel, frame: str) -> tuple[Float64, Guide]:
        """The pose (4, 4) of a frame where the clock stands, and how it and the posture move there."""
        position, velocity = self.path.at(self.clock)
        return guided_goal(model, frame, position[0], velocity[0])

    def advance(self, seconds: float, pose_error: Float64) -> None:
        """Let the clock run, unless the frame is behind by its pose error (6,)."""
        if float(np.linalg.norm(pose_error[:3])) < self.wait_distance:
            self.clock = min(self.clock + seconds, self.path.duration)


PlanDetour = Callable[[int, Float64, Float64], Detour | None]
"""A stamp [ns], the posture (J,) and the goal's pose (4, 4) -> a way there in the scene known then, or None."""
