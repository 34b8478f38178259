"""The controller's scene: larger people, and approach rates dd/dt."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.records import DistanceField, Float64


@dataclass(frozen=True, kw_only=True)
class SceneStep:
    """The two newest scenes known at a time, `seconds` apart."""

    newer: DistanceField
    older: DistanceField
    seconds: float


SceneStepAt = Callable[[int], SceneStep | None]
"""What was known at a stamp [ns], None where there was only one scene; never anything later."""


def distance_rate(step: SceneStep | None, points: Float64, limit: float) -> float | Float64:
    """Return dd/dt (Q,) [m/s] at fixed points (Q, 3) [m], from older to newer scene.

    Clipped to [-limit, 0], so a row is only ever tightened; missing distances give 0. The past rate holds until the
    next scene.
    """
    if step is None:
        return 0.0
    change = (step.newer.query(points)[0] - step.older.query(points)[0]) / step.seconds
    return np.asarray(np.clip(np.nan_to_num(change), -limit, 0.0))


def rate_of(
    config: ControlConfig, model: ArmModel, scene_step_at: SceneStepAt | None, stamp_ns: int, q: Float64
) -> float | Float64:
    """Return the configured dd/dt of the moving spheres at a posture (J,) and stamp."""
    step = None if scene_step_at is None or config.distance_rate == "none" else scene_step_at(stamp_ns)
    if step is None:
        return 0.0
    points = np.ascontiguousarray(model.sphere_centers(q)[np.flatnonzero(model.moving_spheres)])
    return distance_rate(step, points, config.max_distance_rate)


class PeopleGrown:
    """min(scene, people - extra): a field in which people extend `extra` [m] farther.

    At epsilon or more, the scene is at least epsilon away, and people epsilon + extra. Distance and gradient are the
    smaller one's.
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
    """Return the field from which a controller keeps `config.margin`.

    People count as nearer by `config.human_margin` less the margin.
    """
    extra = config.human_margin - config.margin
    return scene if people is None or extra <= 0 else PeopleGrown(scene, people, extra)
