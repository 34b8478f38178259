"""The map's lengths follow from what was recorded: its defaults suit a table at arm's length, and are multiplied."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from splatctrl_cli.config import Config, OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import SCALE_DEPTH, SCALE_NEAREST
from splatctrl_cli.records import RgbdFrame

Lengths = TypeVar("Lengths", SceneConfig, OccupancyConfig)

POWERS: Mapping[str, Mapping[str, int]] = {
    "scene": {
        **dict.fromkeys(("min_radius", "max_radius", "min_depth_error", "max_depth_error", "max_gap"), 1),
        **dict.fromkeys(("lr_center", "keyframe_distance"), 1),
        **{"lambda_depth": -1, "noise": -2},
    },
    "occupancy": {**dict.fromkeys(("voxel", "min_range", "max_range", "see_through"), 1), "depth_error": -1},
}
"""The power of a length in each setting that has one: recordings of one scene in two units then give one map.

Lengths of the robot and its contacts are not among them.
"""


@dataclass(frozen=True, kw_only=True)
class RecordedDepth:
    """How far away [m] what was recorded is: the median, a tenth is nearer than `nearest`, and `farthest` leaves out
    stray pixels.
    """

    median: float
    nearest: float
    farthest: float

    @classmethod
    def of(cls, frames: Sequence[RgbdFrame]) -> "RecordedDepth | None":
        """Of all valid pixels of `frames`, every eighth row and column; None where there is none."""
        seen = [frame.depth[::8, ::8] for frame in frames]
        depth = np.concatenate([image[image > 0] for image in seen]) if seen else np.zeros(0)
        if not len(depth):
            return None
        nearest, median, farthest = (float(q) for q in np.percentile(depth, [10.0, 50.0, 99.5]))
        return cls(median=median, nearest=nearest, farthest=farthest)


def fitted_to(config: Config, depth: RecordedDepth) -> Config:
    """`config` with what was left at its default multiplied by the scale of the recording.

    The scale is `scene.scale`, or where that is 0 the median depth over that of a table at arm's length. Depth counts
    from half the nearest at least, and to the farthest at least.
    """
    is_found = config.scene.scale == 0
    scale = depth.median / SCALE_DEPTH if is_found else config.scene.scale
    scene, occupancy = scaled(config.scene, scale), scaled(config.occupancy, scale)
    values: dict[str, float] = {"scale": scale}
    if is_found and scene.radius_depth == 0:
        values["radius_depth"] = depth.median
    ranges: dict[str, float] = {}
    if is_found and config.occupancy.min_range == OccupancyConfig().min_range:
        least = config.occupancy.min_range  # a nearer scene changes neither noise nor what a camera carries
        ranges["min_range"] = max(least, min(occupancy.min_range, SCALE_NEAREST * depth.nearest))
    if is_found and config.occupancy.max_range == OccupancyConfig().max_range:
        ranges["max_range"] = max(occupancy.max_range, depth.farthest)
    return config.derived(scene=scene.derived(**values), occupancy=occupancy.derived(**ranges))


def scaled(section: Lengths, scale: float) -> Lengths:
    """What was left at its default multiplied by the power of `scale` that a length has there."""
    powers, default = POWERS[section.section], type(section)()
    kept = {key: getattr(section, key) for key in powers}
    return section.derived(
        **{key: value * scale ** powers[key] for key, value in kept.items() if value == getattr(default, key)}
    )
