"""Nested cubes over coloured points: where one splat will do, and where the image has detail that needs more.

The paper seeds a splat per pixel. A budget far below the number of pixels has to choose; one splat per equal cube
leaves objects as coarse as the floor. Here a cube is split in eight while its points disagree too much in colour or
do not lie on a plane.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import SEED_BEND
from splatctrl_cli.records import Bool, Float32, Float64

Index = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class CubeLevel:
    """The occupied cubes of one size: points (K, 3) [m], mean colors (K, 3), detail (K,), parent (K,).

    A cube's point is the measured one nearest to the mean of its points: the mean itself would hang in the air of a
    concave corner.

    detail is the number of points times (colour variance + SEED_BEND * least variance of position / edge^2): what one
    splat in the cube fails to explain. parent is the cube one level up that holds it.
    """

    edge: float
    points: Float32
    colors: Float64
    detail: Float64
    parent: Index


def cube_levels(points: Float32, colors: Float32, edge: float, num_levels: int) -> list[CubeLevel]:
    """Cubes of edges `edge`, `edge` / 2, … [m] over points (K, 3) with colours (K, 3)."""
    levels: list[CubeLevel] = []
    above: Index = np.zeros(len(points), np.int64)
    for level in range(num_levels):
        size = edge / 2**level
        first, cube = np.unique(_keys(points, size), return_index=True, return_inverse=True)[1:]
        levels.append(_level(points, colors, cube, above[first], size))
        above = cube
    return levels


def num_cubes(points: Float32, edge: float) -> int:
    """How many cubes of `edge` [m] hold points (K, 3)."""
    return len(np.unique(_keys(points, edge)))


def _keys(points: Float32, edge: float) -> Index:
    """A number for the cube of each point."""
    key: Index = np.zeros(len(points), np.int64)
    for column in points.T:
        key = key * 2_097_152 + np.floor(column.astype(np.float64) / edge).astype(np.int64)
    return key


def _level(points: Float32, colors: Float32, cube: Index, parent: Index, edge: float) -> CubeLevel:
    """Column by column: millions of points are looked at."""
    count = np.bincount(cube).astype(np.float64)

    def mean(columns: Iterable[NDArray[np.floating]]) -> Float64:
        return np.stack([np.bincount(cube, weights=column) / count for column in columns], 1)

    center, color = mean(points.T), mean(colors.T)
    color_variance = (mean(column.astype(np.float64) ** 2 for column in colors.T) - color**2).sum(axis=1)
    offset = [column - middle[cube] for column, middle in zip(points.T, center.T, strict=True)]
    upper = mean(a * b for a, b in combinations_with_replacement(offset, 2))
    covariance = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    thickness = np.maximum(np.linalg.eigvalsh(covariance)[:, 0], 0.0)
    detail = count * (np.maximum(color_variance, 0.0) + SEED_BEND * thickness / edge**2)
    nearest = _least(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2, cube, len(count))
    return CubeLevel(edge=edge, points=points[nearest], colors=color, detail=detail, parent=parent)


def _least(values: NDArray[np.floating], cube: Index, num_cubes: int) -> NDArray[np.intp]:
    """Index (num_cubes,) of the least of each cube's values (K,), the first of equals."""
    least = np.full(num_cubes, np.inf, values.dtype)
    np.minimum.at(least, cube, values)
    found = np.flatnonzero(values == least[cube])[::-1]
    first = np.empty(num_cubes, np.intp)
    first[cube[found]] = found  # the last to be written stays
    return first


def leaves(levels: Sequence[CubeLevel], tolerance: float) -> list[Bool]:
    """Masks (K,) per level of the cubes that stand: a cube is split while its detail exceeds `tolerance`."""
    masks = []
    is_reached = np.ones(len(levels[0].detail), bool)
    for level, below in zip(levels, [*levels[1:], None], strict=True):
        is_split = is_reached & (level.detail > tolerance) & (below is not None)
        masks.append(is_reached & ~is_split)
        if below is not None:
            is_reached = is_split[below.parent]
    return masks


def tolerance_for(levels: Sequence[CubeLevel], count: int) -> float:
    """The smallest tolerance (to 1 %) that leaves at most `count` cubes; infinite where the coarsest are too many."""
    if len(levels[0].detail) > count:
        return float("inf")
    low, high = 1e-6, float(max(level.detail.max() for level in levels)) + 1e-6
    while high / low > 1.01:
        middle = float(np.sqrt(low * high))
        fits = sum(int(mask.sum()) for mask in leaves(levels, middle)) <= count
        low, high = (low, middle) if fits else (middle, high)
    return high
