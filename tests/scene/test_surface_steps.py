"""A pixel on the robot's outline, measured between the robot and what is behind it, belongs to neither."""

import numpy as np
import pytest

from splatctrl_cli.config.fixed import MASK_STEP
from splatctrl_cli.records import Bool, Float32
from splatctrl_cli.scene.surface_depth import surface_steps

SHAPE, EDGE = (200, 300), 5
ERROR = 0.002  # [m] at 1 m
V, U = np.indices(SHAPE)
ROBOT = (V < 100) & (U >= 100) & (U < 200)
IS_EDGE = (V < 100 + EDGE) & (U >= 100 - EDGE) & (U < 200 + EDGE) & ~ROBOT


def table(rng: np.random.Generator) -> Float32:
    """A slanted plane 1.3 to 1.5 m away, with noise of 2 mm at 1 m."""
    z = 1.0 / (1.0 / 1.5 + 6e-4 * V - 1e-4 * U)
    return np.asarray(z + ERROR * z**2 * rng.standard_normal(SHAPE), np.float32)


def tolerance(z: Float32) -> Float32:
    return np.asarray(0.004 + 2.0 * ERROR * z**2, np.float32)


def steps(depth: Float32, is_object: Bool = ~ROBOT) -> Float32:
    return surface_steps(is_object, depth, IS_EDGE, EDGE, tolerance(depth), ERROR)


def test_pixels_off_the_plane_beside_the_outline_have_half_of_their_distance() -> None:
    rng = np.random.default_rng(0)
    depth = table(rng)
    off = IS_EDGE & (rng.random(SHAPE) < 0.1)
    depth[off] -= 0.030
    found = steps(depth)
    assert np.count_nonzero(found[off] < MASK_STEP) >= 0.99 * np.count_nonzero(off) and found[off].min() > 0.008
    assert np.median(found[off]) == pytest.approx(0.015, abs=0.001)
    others = found[IS_EDGE & ~off]
    assert np.count_nonzero(others < MASK_STEP) <= 0.02 * len(others)  # beyond 4 mm + 2 sigma
    assert np.all(found[~IS_EDGE] == np.float32(MASK_STEP))


def test_what_stands_before_the_plane_and_goes_on_leaves_no_plane_to_be_off() -> None:
    depth = table(np.random.default_rng(1))
    box = (U >= 140) & (U < 160) & (V >= 100) & (V < 120)
    depth[box] -= 0.1
    assert np.all(steps(depth)[box & IS_EDGE] == np.float32(MASK_STEP))


def test_too_little_of_a_plane_says_nothing() -> None:
    depth = table(np.random.default_rng(2))
    depth[100, 120:180] -= np.float32(0.03)
    assert np.all(steps(depth)[100, 120:180] < MASK_STEP)
    two_rows = ~ROBOT & (V >= 100) & ((V < 100 + EDGE) | (abs(V - 113.5) < 1))  # noise decides on their slope
    assert np.all(steps(table(np.random.default_rng(2)), two_rows)[100, 120:180] == np.float32(MASK_STEP))
    assert np.all(steps(depth, np.zeros(SHAPE, bool)) == np.float32(MASK_STEP))


@pytest.mark.parametrize("sigmas", [1.0, 4.0])
def test_the_plane_is_the_least_squares_plane_of_the_pixels_beyond(sigmas: float) -> None:
    depth = table(np.random.default_rng(3))
    depth[102, 150] -= np.float32(0.004 + sigmas * 2.0 * ERROR * 1.4**2)
    v, u = 102, 150
    z = float(depth[v, u])
    expected = MASK_STEP
    for reach in (2 * EDGE, 3 * EDGE):
        beyond = ~ROBOT & ~IS_EDGE & (abs(V - v) <= reach) & (abs(U - u) <= reach)
        design = np.column_stack([np.ones(np.count_nonzero(beyond)), U[beyond], V[beyond]])
        plane = np.linalg.lstsq(design, 1.0 / depth[beyond].astype(np.float64), rcond=None)[0]
        off = float(abs(1.0 / z - plane @ [1.0, u, v])) * z**2
        if off > tolerance(depth)[v, u]:
            expected = min(expected, 0.5 * off)
    assert steps(depth)[v, u] == pytest.approx(expected, abs=1e-6)
