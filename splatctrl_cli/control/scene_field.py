"""The scene as the controller takes it: people reach farther than things, and what approaches has a rate dd/dt."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.records import DistanceField, Float64


@dataclass(frozen=True, kw_only=True)
class SceneStep:
    """The two newest scenes known at a time, and the seconds between them."""

    newer: DistanceField
    older: DistanceField
    seconds: float


SceneStepAt = Callable[[int], SceneStep | None]
"""What was known at a stamp [ns], None where there was only one scene; never anything later."""


def distance_rate(step: SceneStep | None, points: Float64, limit: float) -> float | Float64:
    """dd/dt (Q,) [m/s] at points (Q, 3) [m] that stand still: what the distance lost per second from the older to the
    newer scene, at most `limit`; 0 where the scene went away, so that a row is only ever tightened.

    The rate is that of the past interval, held until the next scene; where a distance is missing it is 0.
    """
    if step is None:
        return 0.0
    change = (step.newer.query(points)[0] - step.older.query(points)[0]) / step.seconds
    return np.asarray(np.clip(np.nan_to_num(change), -limit, 0.0))


def rate_of(
    config: ControlConfig, model: ArmModel, scene_step_at: SceneStepAt | None, stamp_ns: int, q: Float64
) -> float | Float64:
    """dd/dt of the moving spheres at a posture (J,) and stamp, as the configuration wants it."""
    step = None if scene_step_at is None or config.distance_rate == "none" else scene_step_at(stamp_ns)
    if step is None:
        return 0.0
    points = np.ascontiguousarray(model.sphere_centers(q)[np.flatnonzero(model.moving_spheres)])
    return distance_rate(step, points, config.max_distance_rate)


class PeopleGrown:
    """min(scene, people - extra): a field in which people reach `extra` [m] farther than they do.

    Where it is at least epsilon, the scene is at least epsilon away and people are at least epsilon + extra. Distance
    and gradient are those of the smaller one.
    """

    def __init__(self, scene: DistanceField, people: DistanceField, extra: float) -> None:
        self._scene, self._people, self._extra = scene, people, extra

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        distance, gradient = self._scene.query(points)
        to_people, from_people = self._people.query(points)
        is_nearer = to_people - self._extra < distance
        return (
            np.where(is_nearer, to_people - self._extra, distance),
            np.where(is_nearer[:, None], from_people, gradient),
        )


def guarded(scene: DistanceField, people: DistanceField | None, config: ControlConfig) -> DistanceField:
    """What a controller keeps `config.margin` from: the scene, in which people count as much nearer as
    `config.human_margin` is above the margin.
    """
    extra = config.human_margin - config.margin
    return scene if people is None or extra <= 0 else PeopleGrown(scene, people, extra)
