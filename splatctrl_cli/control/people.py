"""A larger margin for people than for things."""

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.records import DistanceField, Float64


class PeopleGrown:
    """min(scene, people - extra): a field in which people reach `extra` [m] farther than they do.

    Where it is at least epsilon, the scene is at least epsilon away and people are at least epsilon + extra. Distance
    and gradient are those of the smaller one.
    """

    def __init__(self, scene: DistanceField, people: DistanceField, extra: float) -> None:
        self._scene, self._people, self._extra = scene, people, extra

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """See `DistanceField`."""
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
