"""Spheres of a scene's field: chosen by label, checked and clustered once.

A space-filling curve sorts points into clusters of 16, and clusters into groups of 16, with boxes.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_if
from splatctrl_cli.kernels.field import LANES, SPARE_OFFSET, SPARE_PLACE, Clusters, Offsets
from splatctrl_cli.records import Box, Float32, Float64, Floats, Index, Label, SplatSet, UInt8
from splatctrl_cli.voxels import Balls

_BITS = 10  # per coordinate of a Hilbert code
_GROUPS = 8  # the number of groups is a multiple of this


@dataclass(frozen=True, kw_only=True)
class Spheres:
    """N spheres: centres in C clusters, relative to an anchor, and radii (N,) [m].

    anchor (3,) [m], world; source (16 C,): sphere of each entry; is_point (16 C,): 0 if spare.
    """

    anchor: Float64
    source: Index
    is_point: UInt8
    clusters: Clusters
    radii: Float64

    @classmethod
    def of(cls, centers: ArrayLike, radii: ArrayLike, frame: Box | None = None) -> "Spheres":
        """Cluster centers (N, 3) [m], world, and radii (N,) [m], 0 allowed.

        Anchor and curve follow `frame`, by default the centres' box. Raises NotEvaluableError without centres,
        InputError for a wrong shape, a non-finite value, or a negative radius.
        """
        points, radius_array = _check(centers, radii)
        lower, upper = (points.min(axis=0), points.max(axis=0)) if frame is None else (frame.lower, frame.upper)
        anchor = 0.5 * (lower + upper)
        codes = _hilbert_codes(points, lower, float((upper - lower).max()))
        order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], codes))
        source = np.zeros(LANES * _padded(-(-len(points) // LANES), LANES), dtype=np.int64)
        source[: len(order)] = order
        relative = np.full((len(source), 3), SPARE_PLACE, dtype=np.float32)
        relative[: len(order)] = (points - anchor)[order]
        return cls(
            anchor=anchor,
            source=source,
            is_point=(np.arange(len(source)) < len(order)).astype(np.uint8),
            clusters=Clusters(centers=np.ascontiguousarray(relative.T), boxes=_boxes(relative, len(order))),
            radii=radius_array,
        )

    @property
    def num_points(self) -> int:
        return int(np.count_nonzero(self.is_point))

    def relative(self, points_world: Floats) -> Float32:
        """World points (Q, 3) relative to the anchor."""
        return np.ascontiguousarray(points_world - self.anchor, dtype=np.float32)

    def lay_out(self, values: Floats, *, spare: float) -> Float64:
        """Values (N,) -> (16 C,), `spare` without a point."""
        return np.where(self.is_point, np.asarray(values, dtype=np.float64)[self.source], spare)

    def gather(self, values: Float64) -> Float64:
        """Values (16 C,) -> (N,)."""
        result = np.empty(self.num_points)
        is_point = self.is_point.view(np.bool_)
        result[self.source[is_point]] = values[is_point]
        return result

    def offsets(self, values: Floats, *, spare: float = SPARE_OFFSET) -> Offsets:
        """Lay out offsets (N,), with each cluster's and group's largest."""
        laid_out = self.lay_out(values, spare=spare).astype(np.float32)
        by_cluster = laid_out.reshape(-1, LANES).max(axis=1)
        by_group = np.full(_padded(len(by_cluster) // LANES, _GROUPS), spare, np.float32)
        by_group[: len(by_cluster) // LANES] = by_cluster.reshape(-1, LANES).max(axis=1)
        return Offsets(values=laid_out, maxima=np.concatenate([by_cluster, by_group]))


def _boxes(relative: Float32, num_points: int) -> Float32:
    num_clusters = len(relative) // LANES
    num_groups = num_clusters // LANES
    boxes = np.full((6, num_clusters + _padded(num_groups, _GROUPS)), SPARE_PLACE, dtype=np.float32)
    upper = relative.copy()
    upper[num_points:] = -SPARE_PLACE
    for count, first, size in ((num_clusters, 0, LANES), (num_groups, num_clusters, LANES * LANES)):
        used = -(-num_points // size)
        boxes[:3, first : first + used] = relative.reshape(count, size, 3).min(axis=1)[:used].T
        boxes[3:, first : first + used] = upper.reshape(count, size, 3).max(axis=1)[:used].T
    return boxes


def _padded(count: int, multiple: int) -> int:
    return -(-count // multiple) * multiple


def _hilbert_codes(points: Float64, lower: Float64, extent: float) -> Index:
    """Places (N,) along a Hilbert curve (Skilling, AIP Conf. Proc. 707, 2004)."""
    last = 2**_BITS - 1
    cells = np.clip((points - lower) / max(extent, 1e-30) * last, 0, last).astype(np.int64).T.copy()
    for bit in range(_BITS - 1, 0, -1):
        below = (1 << bit) - 1
        for axis in range(3):
            is_set = (cells[axis] >> bit) & 1 == 1
            swapped = np.where(is_set, 0, (cells[0] ^ cells[axis]) & below)
            cells[0] ^= np.where(is_set, below, swapped)
            cells[axis] ^= swapped
    cells[1] ^= cells[0]
    cells[2] ^= cells[1]
    flips = np.zeros(len(points), dtype=np.int64)
    for bit in range(_BITS - 1, 0, -1):
        flips ^= np.where((cells[2] >> bit) & 1 == 1, (1 << bit) - 1, 0)
    cells ^= flips
    codes = np.zeros(len(points), dtype=np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            codes |= ((cells[axis] >> bit) & 1) << (3 * bit + 2 - axis)
    return codes


def checked_points(points: Floats) -> Float64:
    """Points as float64. Raises InputError unless (Q, 3) and finite."""
    array = shaped_points(points)
    if not np.isfinite(array).all():
        raise not_finite(array)
    return array


def shaped_points(points: Floats) -> Float64:
    """Points as float64. Raises InputError unless (Q, 3)."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    refuse_if(array.ndim != 2 or array.shape[1] != 3, f"query points: expected shape (Q, 3), got {array.shape}")
    return array


def not_finite(points: Float64) -> InputError:
    """Error that names the first non-finite point (Q, 3)."""
    i = int(np.argmax(~np.isfinite(points).all(axis=1)))
    return InputError(f"query point {i}: expected finite coordinates, got {points[i].tolist()}")


def _check(centers: ArrayLike, radii: ArrayLike) -> tuple[Float64, Float64]:
    center_array, radius_array = np.asarray(centers, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    refuse_if(
        center_array.ndim != 2 or center_array.shape[1] != 3 or radius_array.shape != center_array.shape[:1],
        f"splats: expected centres (N, 3) and radii (N,), got {center_array.shape}, {radius_array.shape}",
    )
    refuse_if(
        not len(center_array),
        "splats: expected at least one to measure distances to, got none",
        error=NotEvaluableError,
    )
    for name, is_bad in (
        ("a finite centre", ~np.isfinite(center_array).all(axis=1)),
        ("a finite radius of 0 m or more", ~(np.isfinite(radius_array) & (radius_array >= 0))),
    ):
        if is_bad.any():
            i = int(np.argmax(is_bad))
            got = center_array[i].tolist() if "centre" in name else radius_array[i]
            raise InputError(
                f"splat {i}: expected {name}, got {got}", remedy=f"{int(is_bad.sum())} such splats in all"
            )
    return center_array, radius_array


DEFAULT_LABELS = frozenset({Label.OBJECT, Label.HUMAN})
NO_SPLAT = -1


@dataclass(frozen=True, kw_only=True)
class ObstacleSpheres:
    """N spheres of a field, balls last; index (N,) of splats, NO_SPLAT for balls."""

    splats: SplatSet
    index: Index

    @property
    def num_unrepresented(self) -> int:
        return int(np.count_nonzero(self.index == NO_SPLAT))


def obstacle_spheres(
    splats: SplatSet, balls: Balls | None, labels: Collection[Label] = DEFAULT_LABELS
) -> ObstacleSpheres:
    """Splats and balls with one of `labels`.

    Raises NotEvaluableError without any, InputError for an unknown label.
    """
    values = [int(label) for label in labels]
    is_chosen = np.isin(splats.labels, values)
    is_obstacle = np.zeros(0, bool) if balls is None else np.isin(balls.labels, values)
    if balls is None or not is_obstacle.any():
        return ObstacleSpheres(splats=field_splats(splats, labels), index=np.flatnonzero(is_chosen))
    check_labels(splats)
    count, chosen = int(is_obstacle.sum()), splats.select(is_chosen)
    added = SplatSet(
        centers=balls.centers[is_obstacle],
        radii=np.full(count, balls.radius, np.float32),
        colors=np.full((count, 3), 0.5, np.float32),
        opacities=np.ones(count, np.float32),
        labels=balls.labels[is_obstacle],
        density=np.zeros(count, np.float32),
    )
    return ObstacleSpheres(
        splats=chosen.joined(added), index=np.concatenate([np.flatnonzero(is_chosen), np.full(count, NO_SPLAT)])
    )


def field_splats(splats: SplatSet, labels: Collection[Label] = DEFAULT_LABELS) -> SplatSet:
    """Splats with one of `labels`, in order; by default without the robot.

    Raises NotEvaluableError without any, InputError for an unknown label.
    """
    check_labels(splats)
    chosen = splats.select(np.isin(splats.labels, [int(label) for label in labels]))
    names = ", ".join(label.name.lower() for label in sorted(labels))
    refuse_if(
        not len(chosen),
        f"splats: none of {len(splats)} is labelled {names}",
        remedy="give a scene that has some; --include takes other labels",
        error=NotEvaluableError,
    )
    return chosen


def check_labels(splats: SplatSet) -> None:
    """Raise InputError for an unknown label."""
    unknown = ~np.isin(splats.labels, [int(label) for label in Label])
    if unknown.any():
        i = int(np.argmax(unknown))
        raise InputError(f"splat {i}: expected a label of 0, 1 or 2, got {splats.labels[i]}")


def label_counts(splats: SplatSet) -> dict[str, int]:
    return {label.name.lower(): int(np.count_nonzero(splats.labels == label)) for label in Label}
