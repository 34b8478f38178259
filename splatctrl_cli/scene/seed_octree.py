"""Nested cubes over coloured points: one splat each, more where there is detail.

The paper seeds every pixel. Here a cube splits in eight while its points differ in colour or lie off a plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import SEED_BEND
from splatctrl_cli.kernels.points import CubeMeans, Cubes
from splatctrl_cli.records import Bool, Float32, Float64


@dataclass(frozen=True, kw_only=True)
class CubeLevel:
    """Occupied cubes of one size: points (K, 3) [m], means, and parent (K,) one level up.

    A cube's point is the measured one nearest to the mean.
    """

    edge: float
    points: Float32
    means: CubeMeans
    parent: NDArray[np.int32]

    @property
    def colors(self) -> Float64:
        """Mean colours (K, 3)."""
        return self.means.color

    @cached_property
    def detail(self) -> Float64:
        """Number of points times (colour variance + SEED_BEND * least position variance / edge^2), (K,)."""
        means = self.means
        color_variance = (means.square - means.color**2).sum(axis=1)
        covariance = means.covariance[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        thickness = np.maximum(np.linalg.eigvalsh(covariance)[:, 0], 0.0)
        unexplained = np.maximum(color_variance, 0.0) + SEED_BEND * thickness / self.edge**2
        return np.asarray(means.count * unexplained)


def cube_levels(
    points: Float32, colors: Float32, edge: float, num_levels: int, num_threads: int = 1
) -> list[CubeLevel]:
    """Cubes of edges `edge`, `edge` / 2, … [m] over points (K, 3) with colours (K, 3)."""
    levels: list[CubeLevel] = []
    above = np.zeros(len(points), np.int32)
    for level in range(num_levels):
        size = edge / 2**level
        cubes = Cubes(points, size, num_threads)
        of_point, first = cubes.members()
        means = cubes.means(colors)
        levels.append(CubeLevel(edge=size, points=points[means.nearest], means=means, parent=above[first]))
        above = of_point
    return levels


def leaves(levels: Sequence[CubeLevel], tolerance: float) -> list[Bool]:
    """Masks (K,) per level of standing cubes: one splits while its detail exceeds `tolerance`."""
    masks = []
    is_reached = np.ones(len(levels[0].points), bool)
    for level, below in zip(levels, [*levels[1:], None], strict=True):
        if below is None:
            masks.append(is_reached)
            break
        is_split = is_reached & (level.detail > tolerance)
        masks.append(is_reached & ~is_split)
        is_reached = is_split[below.parent]
    return masks


def tolerance_for(levels: Sequence[CubeLevel], count: int) -> float:
    """Least tolerance (to 1 %) for at most `count` cubes; infinite if the coarsest exceed it."""
    if len(levels[0].points) > count:
        return float("inf")
    low, high = 1e-6, float(max(level.detail.max() for level in levels)) + 1e-6
    while high / low > 1.01:
        middle = float(np.sqrt(low * high))
        fits = sum(int(mask.sum()) for mask in leaves(levels, middle)) <= count
        low, high = (low, middle) if fits else (middle, high)
    return high
