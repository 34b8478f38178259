"""Which splats must go, and why (III-C)."""

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import NEAREST_REACH
from splatctrl_cli.records import Bool, Box, Float32, RgbdFrame
from splatctrl_cli.scene.buffer import SplatBuffer
from splatctrl_cli.scene.occupancy import OccupancyMap

REASONS = ("broken", "workspace", "opacity", "free", "seen_through", "uncertain", "trail", "robot", "weak", "evicted")


def nearest_depth(frame: RgbdFrame, reach: float = NEAREST_REACH) -> Float32:
    """The least valid depth (H, W) [m] within `reach` [m] of each pixel, as far as that goes at the frame's median
    depth; infinite where there is none.
    """
    valid = frame.depth[frame.depth > 0]
    if not len(valid):
        return np.full(frame.depth.shape, np.inf, np.float32)
    half = max(1, round(reach * frame.intrinsics.fx / float(np.median(valid))))
    depth = np.where(frame.depth > 0, frame.depth, np.float32(np.inf))
    return np.asarray(cv2.erode(depth, np.ones((2 * half + 1, 2 * half + 1), np.uint8)), np.float32)


def removals(
    buffer: SplatBuffer,
    occupancy: OccupancyMap,
    workspace: Box,
    min_opacity: float,
    *,
    is_trail: Bool,
    is_floating: Bool,
    counts_time: bool = True,
) -> dict[str, Bool]:
    """Masks (M,) of live splats to remove, by reason; each splat under its first reason in `REASONS`.

    broken: not finite. workspace: outside it. opacity: below alpha_min. free: every voxel around it observed free.
    seen_through: it floats before what a camera measured.
    uncertain: occupancy between 0.3 and 0.7 for longer than the patience. trail: was robot or human, is no longer.
    robot: none here; those that the optimiser moved off the robot or a person.
    evicted: none here; those that gave their slot to surface that had none.
    weak: none here; those that show least and are given up for detail elsewhere are counted under it by refining.
    Updates the buffer's count of uncertain time steps,
    where this is one. Splats whose surroundings were never seen stay, unless the
    rule is "literal".
    """
    config = occupancy.config
    centers = buffer.centers
    is_broken: Bool = ~np.all(np.isfinite(buffer.parameters), axis=1)
    value, is_observed = occupancy.occupancy_around(np.where(is_broken[:, None], np.float32(0), centers))
    is_free, is_uncertain = _verdict(value, is_observed, config)
    if counts_time:
        buffer.num_uncertain[:] = np.where(is_uncertain, buffer.num_uncertain + 1, 0)
    has_lost_patience = is_uncertain & (
        (buffer.num_uncertain > config.uncertain_patience) | (config.rule == "literal")
    )
    masks = {
        "broken": is_broken,
        "workspace": ~workspace.contains(centers),
        "opacity": buffer.opacities < min_opacity,
        "free": is_free,
        "seen_through": is_floating,
        "uncertain": has_lost_patience,
        "trail": is_trail,
        "robot": np.zeros(len(centers), bool),
        "weak": np.zeros(len(centers), bool),
        "evicted": np.zeros(len(centers), bool),
    }
    remaining = buffer.is_alive.copy()
    reasons = {}
    for reason in REASONS:
        reasons[reason] = masks[reason] & remaining
        remaining &= ~masks[reason]
    return reasons


def _verdict(value: Float32, is_observed: Bool, config: OccupancyConfig) -> tuple[Bool, Bool]:
    if config.rule == "literal":
        return value < config.free_below, (value >= config.free_below) & (value < config.occupied_above)
    return (
        is_observed & (value < config.free_below),
        is_observed & (value >= config.free_below) & (value < config.occupied_above),
    )
