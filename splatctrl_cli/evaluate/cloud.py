"""How far the surface of a scene is from reference points, and how much of the reference it covers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatctrl_cli.config.fixed import CLOUD_DISTANCE, CLOUD_GOOD_OVERLAP, CLOUD_NO_OVERLAP
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, Better, Scale
from splatctrl_cli.geometry import face_normals
from splatctrl_cli.mesh_distance import TriangleMesh
from splatctrl_cli.records import Bool, Float64

MAX_POINTS = 2_000_000  # on a mesh
MAX_SPACED = 6_000_000
NO_PAIRS = np.empty((0, 2), np.int64)
OTHER_UNITS = (1e3, 1e-3, 1e2, 1e-2, 10.0, 0.1)  # m, cm, dm and mm, taken for each other


SURFACE_ERROR = Scale(unit="m", better=Better.LOWER, absolute=2e-4, relative=0.02)


@dataclass(frozen=True, kw_only=True)
class CloudScore:
    """accuracy: mean distance [m] of the surface's points to the reference; completeness: of the reference's points
    to the surface; chamfer: the mean of both. Points farther than the maximum distance count only in the `*_beyond`
    shares. completeness_seen: over reference points that a training camera saw. nan where no point is left.
    """

    accuracy: float
    completeness: float
    completeness_seen: float
    chamfer: float
    accuracy_beyond: float
    completeness_beyond: float
    completeness_seen_beyond: float
    num_points: int
    num_reference: int

    def figures(self) -> dict[str, float]:
        """By flat name."""
        return {name: float(value) for name, value in vars(self).items()}


def cloud_score(
    points: Float64,
    reference: Float64,
    seen: Bool,
    *,
    max_distance: float = CLOUD_DISTANCE,
    counts: Bool | None = None,
    unit: float = 1.0,
    threads: int = 1,
) -> CloudScore:
    """Distances between the surface's points (P, 3) and the reference's (R, 3) [m], world; seen (R,).

    As DTU's evaluation and jzhangbs/DTUeval-python, eval.py, have it: means over distances below `max_distance`.
    counts (P,): points that enter the accuracy, all where None; the completeness is over the whole reference.
    unit: metres per unit of the reference's file, for the words of a refusal. Raises NotEvaluableError where nothing
    lies that near, or the reference would fit in another unit.
    """
    if not max_distance > 0:
        raise UsageError(f"--cloud-max: expected a distance above 0 m, got {max_distance:g}")
    counted = points if counts is None else points[counts]
    for name, some in (("scene's surface", counted), ("reference cloud", reference)):
        if not len(some):
            raise NotEvaluableError(f"the {name}: expected points to compare, got none")
    _check_unit(points, reference, max_distance, unit)
    to_reference = _nearest(counted, reference, max_distance, threads)
    to_surface = _nearest(reference, points, max_distance, threads)
    if to_reference.min() >= max_distance:
        raise NotEvaluableError(
            f"the reference cloud: expected points within {1e3 * max_distance:g} mm of the scene's surface, got none;"
            f" it spans {_box(reference)} m, the surface {_box(points)} m",
            remedy="is it the same scene, in the same frame? give the cloud's unit as --cloud-unit",
        )
    accuracy, accuracy_beyond = _mean_below(to_reference, max_distance)
    completeness, completeness_beyond = _mean_below(to_surface, max_distance)
    completeness_seen, completeness_seen_beyond = _mean_below(to_surface[seen], max_distance)
    return CloudScore(
        accuracy=accuracy,
        completeness=completeness,
        completeness_seen=completeness_seen,
        chamfer=(accuracy + completeness) / 2,
        accuracy_beyond=accuracy_beyond,
        completeness_beyond=completeness_beyond,
        completeness_seen_beyond=completeness_seen_beyond,
        num_points=len(counted),
        num_reference=len(reference),
    )


def _check_unit(points: Float64, reference: Float64, margin: float, unit: float) -> None:
    some, others = (p[:: max(1, len(p) // 20_000)] for p in (points, reference))
    fits = {factor: _overlap(some, factor * others, margin) for factor in (1.0, *OTHER_UNITS)}
    best = max(fits, key=lambda factor: fits[factor])
    if fits[1.0] < CLOUD_NO_OVERLAP and fits[best] > CLOUD_GOOD_OVERLAP:
        raise NotEvaluableError(
            f"the reference cloud: expected the size of the scene's surface, which spans {_box(points)} m, got"
            f" {_box(reference)} m; {best:g} times as large it overlaps by {100 * fits[best]:.0f}%",
            remedy=f"give the cloud's unit as --cloud-unit {unit * best:g}",
        )


def _overlap(points: Float64, others: Float64, margin: float) -> float:
    """Volume that the boxes of both, without one percent at either end, and `margin` [m] wider, share of what they
    fill together."""
    (low, high), (low_other, high_other) = (np.percentile(p, (1, 99), axis=0) for p in (points, others))
    sides = np.minimum(high, high_other) - np.maximum(low, low_other) + 2 * margin
    shared = float(np.prod(np.maximum(sides, 0.0)))
    each = [float(np.prod(sides + 2 * margin)) for sides in (high - low, high_other - low_other)]
    return shared / (sum(each) - shared)


CLOUD_SCALES = {  # by the names of `CloudScore.figures`
    **dict.fromkeys(("accuracy", "completeness", "completeness_seen", "chamfer"), SURFACE_ERROR),
    **dict.fromkeys(("accuracy_beyond", "completeness_beyond", "completeness_seen_beyond"), BAD_SHARE),
    **dict.fromkeys(("num_points", "num_reference"), DESCRIBES),
}


def spaced(points: Float64, spacing: float) -> Float64:
    """Of the points (P, 3), taken in random order, those farther than `spacing` [m] from all that were kept before.

    As DTU's evaluation thins (DTUeval-python, eval.py): where points scatter about a surface, every layer of them
    counts, so that one point for each cube of that edge gives an accuracy a tenth better. What shares a cube of half
    the edge is merged before (of the whole edge, where that leaves more than 6 million points).
    """
    _check_spacing(spacing)
    some = thinned(points, spacing / 2)
    if len(some) > MAX_SPACED:
        some = thinned(points, spacing)
    some = some[np.random.default_rng(0).permutation(len(some))]
    low, high = (cKDTree(some).query_pairs(spacing, output_type="ndarray") if len(some) else NO_PAIRS).T
    is_open, kept = np.ones(len(some), np.bool_), np.zeros(len(some), np.bool_)
    while is_open.any():  # who waits for no earlier one stays, and all near those go: what taking them in turn leaves
        first = is_open.copy()
        first[high] = False
        kept |= first
        is_open &= ~first
        is_open[high[first[low]]] = False
        waits = is_open[low] & is_open[high]
        low, high = low[waits], high[waits]
    return some[kept]


def thinned(points: Float64, spacing: float) -> Float64:
    """One of the points (P, 3) for each cube of edge `spacing` [m] that holds any: the first. Thinning parts of a
    cloud, then what is left of them together, leaves the same.
    """
    _check_spacing(spacing)
    if not len(points):
        return points
    cells = np.floor(points / spacing).astype(np.int64)
    cells -= cells.min(axis=0)
    counts = cells.max(axis=0) + 1
    keys = (cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2]
    first = np.sort(np.unique(keys, return_index=True)[1])
    return points[first]


def _check_spacing(spacing: float) -> None:
    if not spacing > 0:
        raise UsageError(f"--cloud-spacing: expected a distance above 0 m, got {spacing:g}")


def points_on(mesh: TriangleMesh, spacing: float) -> Float64:
    """Random points (P, 3) [m] on a mesh, even by area: four for each square of `spacing` [m], 2 million at most."""
    num = min(math.ceil(4 * 0.5 * np.linalg.norm(face_normals(mesh.corners), axis=1).sum() / spacing**2), MAX_POINTS)
    return drawn_on(mesh, num, np.random.default_rng(0))[0]


def drawn_on(mesh: TriangleMesh, num: int, rng: np.random.Generator) -> tuple[Float64, NDArray[np.int64]]:
    """Random points (num, 3) [m] on a mesh, even by area, and the triangle of each (num,)."""
    corners, doubled = mesh.corners, np.linalg.norm(face_normals(mesh.corners), axis=1)
    face = rng.choice(len(corners), num, p=doubled / doubled.sum())
    u, v = rng.random((2, num))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return np.einsum("nk,nka->na", np.stack([1 - u - v, u, v], axis=1), corners[face]), face


def _nearest(points: Float64, others: Float64, limit: float, threads: int) -> Float64:
    """Distance (P,) [m] of each point to the nearest of `others`, inf where that is `limit` or farther."""
    return np.asarray(cKDTree(others).query(points, distance_upper_bound=limit, workers=threads)[0])


def _mean_below(distances: NDArray[np.floating], limit: float) -> tuple[float, float]:
    """Mean of the distances below the limit, and the share of the others."""
    if not len(distances):
        return math.nan, math.nan
    near = distances[distances < limit]
    return float(near.mean()) if len(near) else math.nan, 1.0 - len(near) / len(distances)


def _box(points: Float64) -> str:
    def corner(values: Sequence[float]) -> str:
        return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"

    return f"{corner(points.min(axis=0))} to {corner(points.max(axis=0))}"
