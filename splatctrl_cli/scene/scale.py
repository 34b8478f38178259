"""Scale of a map's lengths from recorded depth; defaults suit a table at arm's length."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from splatctrl_cli.config import Config, OccupancyConfig, SceneConfig, fixed
from splatctrl_cli.records import Float32, Float64, RgbdFrame

Lengths = TypeVar("Lengths", SceneConfig, OccupancyConfig)

POWERS: Mapping[str, Mapping[str, int]] = {
    "scene": {
        **dict.fromkeys(("min_radius", "max_radius", "min_depth_error", "max_depth_error", "max_gap"), 1),
        **dict.fromkeys(("lr_center", "keyframe_distance"), 1),
        **{"lambda_depth": -1, "noise": -2},
    },
    "occupancy": {**dict.fromkeys(("voxel", "min_range", "max_range", "see_through"), 1), "depth_error": -1},
}
"""Power of a length in each setting with lengths; one scene recorded in two units gives one map.

Lengths of the robot and its contacts do not scale.
"""


@dataclass(frozen=True, kw_only=True)
class RecordedDepth:
    """Recorded depth [m]: median, 10th percentile `nearest`, and `farthest` without stray pixels.

    noise [1/m]: `depth_noise` of the noisiest camera, 0 if unknown. pixel [m]: width of a pixel at the median depth.
    """

    median: float
    nearest: float
    farthest: float
    noise: float = 0.0
    pixel: float = float("inf")

    @classmethod
    def of(cls, frames: Sequence[RgbdFrame]) -> "RecordedDepth | None":
        """Measure valid pixels of every eighth row and column; None without valid pixels."""
        seen = [frame.depth[::8, ::8] for frame in frames]
        depth = np.concatenate([image[image > 0] for image in seen]) if seen else np.zeros(0)
        if not len(depth):
            return None
        nearest, median, farthest = (float(q) for q in np.percentile(depth, [10.0, 50.0, 99.5]))
        cameras = sorted({frame.camera for frame in frames})
        return cls(
            median=median,
            nearest=nearest,
            farthest=farthest,
            noise=max(depth_noise([f.depth for f in frames if f.camera == camera]) for camera in cameras),
            pixel=median / max(frame.intrinsics.fx for frame in frames),
        )


def depth_noise(images: Sequence[Float32]) -> float:
    """Standard deviation [1/m] of one camera's inverse depth (H, W); 0 if unknown.

    Depth z deviates by this times z^2, as in disparity sensors (Khoshelham and Elberink 2012: 1.425e-3 of a Kinect).
    Residuals of linear fits to blocks are noise; a low quantile leaves out edges. Wider blocks may at most double the
    result.
    """
    narrow, *wider = (_linear_noise(images, times) for times in (1, *fixed.NOISE_WIDER))
    return max(narrow, min(max(wider), 2 * narrow))


def _linear_noise(images: Sequence[Float32], times: int) -> float:
    left: list[Float64] = []
    for depth in images:
        side = times * int(max(depth.shape[1] // fixed.NOISE_BLOCKS, fixed.NOISE_LEAST_SIDE))
        rows, columns = (size // side for size in depth.shape)
        blocks = depth[: rows * side, : columns * side].reshape(rows, side, columns, side).swapaxes(1, 2)
        pixels = blocks.reshape(-1, side * side)
        inverse = 1.0 / pixels[(pixels > 0).all(axis=1)].astype(np.float64)
        v, u = np.divmod(np.arange(side * side, dtype=np.float64), side)
        linear = np.linalg.qr(np.stack([np.ones_like(u), u, v], axis=1))[0]
        residual = inverse - inverse @ linear @ linear.T
        left.append(np.sqrt(np.sum(residual**2, axis=1) / (side * side - 3)))
    residuals = np.concatenate(left) if left else np.zeros(0)
    return float(np.quantile(residuals, fixed.NOISE_QUANTILE)) if len(residuals) >= fixed.NOISE_FEWEST else 0.0


def fitted_to(config: Config, depth: RecordedDepth, *, has_robot: bool = False) -> Config:
    """`config` with defaults fitted to the recording; the same object if nothing changes.

    Lengths scale by `scene.scale`; if it is 0, by the median depth relative to a table's at arm's length. Then
    min_radius becomes at most a pixel, and max_range at least the farthest depth. min_range grows to half the nearest
    depth at most. With a robot, scale 0 scales nothing, and larger recorded noise replaces `depth_error`.
    """
    least = OccupancyConfig().depth_error
    if has_robot and depth.noise > least == config.occupancy.depth_error:
        config = config.derived(occupancy=config.occupancy.derived(depth_error=depth.noise))
    if has_robot and config.scene.scale == 0:
        return config
    is_found = config.scene.scale == 0
    scale = depth.median / fixed.SCALE_DEPTH if is_found else config.scene.scale
    scene, occupancy = scale_lengths(config.scene, scale), scale_lengths(config.occupancy, scale)
    values: dict[str, float] = {"scale": scale}
    if is_found and scene.radius_depth == 0:
        values["radius_depth"] = depth.median
    if is_found and config.scene.min_radius == SceneConfig().min_radius:
        values["min_radius"] = min(scene.min_radius, depth.pixel)
    ranges: dict[str, float] = {}
    if is_found and config.occupancy.min_range == OccupancyConfig().min_range:
        least = config.occupancy.min_range  # a nearer scene changes neither noise nor what a camera carries
        ranges["min_range"] = max(least, min(occupancy.min_range, fixed.SCALE_NEAREST * depth.nearest))
    if is_found and config.occupancy.max_range == OccupancyConfig().max_range:
        ranges["max_range"] = max(occupancy.max_range, depth.farthest)
    return config.derived(scene=scene.derived(**values), occupancy=occupancy.derived(**ranges))


def describe_scale(config: Config, depth: RecordedDepth) -> str:
    scene, occupancy = config.scene, config.occupancy
    if scene.scale == 0:
        return f"depth is noisier than usual: {1e3 * occupancy.depth_error:.2g} mm at 1 m, growing with its square"
    return (
        f"depth is {depth.median:.3g} m in the median, scale {scene.scale:.3g}: voxels of {occupancy.voxel:.3g} m, "
        f"splats up to {scene.max_radius:.3g} m, depth from {occupancy.min_range:.3g} to {occupancy.max_range:.3g} m"
    )


def scale_lengths(section: Lengths, scale: float) -> Lengths:
    """Multiply each setting at its default by `scale` to its power in `POWERS`."""
    powers, default = POWERS[section.section], type(section)()
    values = {key: getattr(section, key) for key in powers}
    return section.derived(
        **{key: value * scale ** powers[key] for key, value in values.items() if value == getattr(default, key)}
    )
