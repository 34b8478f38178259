"""Which neighbouring pixels show one surface, at the outline of a robot."""

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import MASK_PLANES, MASK_SIGMAS, MASK_STEP, MASK_UNSURE
from splatctrl_cli.records import Bool, Float32, Float64, Index

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of the terms 1, x, y of a plane
PAIR_OF = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # the number of a pair by its two terms


def surface_steps(is_object: Bool, depth: Float32, is_edge: Bool, edge: int, config: OccupancyConfig) -> Float32:
    """By how much (H, W) [m] the depths of two neighbours on one surface differ at most.

    This is `MASK_STEP`, or half of a pixel's distance from the plane beside it where that is less: of an object pixel
    at the robot's outline (is_edge, `edge` pixels wide). What is measured there may lie anywhere between the robot
    and the plane, and steps of `MASK_STEP` would join it to the plane.

    A plane is fitted to the object pixels beyond the outline within `MASK_PLANES` times its width; in 1 / z it is
    linear. Where they lie on no plane, or on too little of one (`MASK_UNSURE`), the step stays.
    """
    steps = np.full(depth.shape, MASK_STEP, np.float32)
    v, u = np.nonzero(is_object & is_edge)
    if not len(v):
        return steps
    y, x = np.indices(depth.shape) / edge
    weight = (is_object & ~is_edge).astype(np.float64)
    inverse = np.divide(weight, depth, out=np.zeros_like(weight), where=weight > 0)
    terms = np.ones_like(x), x, y
    images = [weight * terms[i] * terms[j] for i, j in PAIRS] + [inverse * term for term in terms] + [inverse**2]
    integrals = np.stack([cv2.integral(image) for image in images])
    at, z = np.stack([term[v, u] for term in terms], axis=-1), depth[v, u].astype(np.float64)
    allowed = config.self_mask_tolerance + MASK_SIGMAS * config.depth_error * z**2
    for times in MASK_PLANES:
        sums = _sums_around(integrals, v, u, times * edge)
        squares = sums[PAIR_OF].transpose(2, 0, 1) + 1e-9 * np.eye(3)  # solvable where there is no pixel
        plane, unit = np.linalg.solve(squares, np.stack([sums[6:9].T, at], axis=-1)).transpose(2, 0, 1)
        unsure = np.sum(at * unit, axis=1)  # the plane's variance at the pixel, by that of one pixel
        spread = sums[9] - np.sum(plane * sums[6:9].T, axis=1)
        is_plane = (unsure <= MASK_UNSURE) & (spread <= sums[0] * (MASK_SIGMAS * config.depth_error) ** 2)
        off = np.abs(1.0 / z - np.sum(at * plane, axis=1)) * z**2
        step = np.where(is_plane & (off > allowed), 0.5 * off, MASK_STEP)
        steps[v, u] = np.minimum(steps[v, u], step)
    return steps


def _sums_around(integrals: Float64, v: Index, u: Index, reach: int) -> Float64:
    """Sums (C, K) of images over squares about pixels (K,), of their integrals (C, H + 1, W + 1)."""
    (top, bottom), (left, right) = (
        np.clip([at - reach, at + reach + 1], 0, size - 1)
        for at, size in zip((v, u), integrals.shape[1:], strict=True)
    )
    inner, outer = integrals[:, bottom, right] + integrals[:, top, left], integrals[:, bottom, left]
    return np.asarray(inner - outer - integrals[:, top, right], np.float64)
