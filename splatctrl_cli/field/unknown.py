"""Spheres of a scene's field, and the treatment of never-seen space."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_cdt, distance_transform_edt

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.field.grid_cells import HALF_DIAGONAL
from splatctrl_cli.records import Bool, Columns, Float32, Index, Label, SplatSet, Values
from splatctrl_cli.voxels import Balls

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
    """Splats and balls with one of `labels`. Raises as `field_splats` without such balls."""
    values = [int(label) for label in labels]
    is_chosen = np.isin(splats.labels, values)
    kept = np.zeros(0, bool) if balls is None else np.isin(balls.labels, values)
    if balls is None or not kept.any():
        return ObstacleSpheres(splats=field_splats(splats, labels), index=np.flatnonzero(is_chosen))
    check_labels(splats)
    count, chosen = int(kept.sum()), splats.select(is_chosen)
    added = SplatSet(
        centers=balls.centers[kept],
        radii=np.full(count, balls.radius, np.float32),
        colors=np.full((count, 3), 0.5, np.float32),
        opacities=np.ones(count, np.float32),
        labels=balls.labels[kept],
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
    kept = splats.select(np.isin(splats.labels, [int(label) for label in labels]))
    if not len(kept):
        names = ", ".join(label.name.lower() for label in sorted(labels))
        raise NotEvaluableError(
            f"splats: none of {len(splats)} is labelled {names}",
            remedy="give a scene that has some; --include takes other labels",
        )
    return kept


def check_labels(splats: SplatSet) -> None:
    """Raise InputError for an unknown label."""
    unknown = ~np.isin(splats.labels, [int(label) for label in Label])
    if unknown.any():
        i = int(np.argmax(unknown))
        raise InputError(f"splat {i}: expected a label of 0, 1 or 2, got {splats.labels[i]}")


def label_counts(splats: SplatSet) -> dict[str, int]:
    return {label.name.lower(): int(np.count_nonzero(splats.labels == label)) for label in Label}


BLANKED = ("sdf", "gradient", "probability")  # by policy nan
ROUNDING = 1e-6  # [m], and share of a distance: rounding of float32
BOUND = (
    "no point of the cell is nearer to a splat's sphere or a never-seen cell; "
    "bound + bound_margin is the lesser of hard and the distance to never-seen cells at its centre"
)

Channels = dict[str, Values]


def blank(channels: Mapping[str, Values], is_unknown: Bool) -> Channels:
    """Set distance, gradient, probability (X, Y, Z) to NaN where unknown."""
    blanked = dict(channels)
    for name in BLANKED:
        if name in channels:
            where = is_unknown if channels[name].ndim == 3 else is_unknown[..., None]
            blanked[name] = np.where(where, np.float32(np.nan), channels[name])
    return blanked


@dataclass(frozen=True, kw_only=True)
class Cubes(Columns):
    """The never-seen cells (X, Y, Z) of a grid as solid cubes.

    distance: lower bound [m] of the signed distance from cell centres; away (..., 3): unit vectors of its growth.
    """

    is_unknown: Bool
    distance: Float32
    away: Float32

    @classmethod
    def of(cls, is_unknown: Bool, voxel: float) -> "Cubes":
        """Bound the distances in a grid with known and unknown cells.

        Outside: the larger of the nearest centre's distance minus half a diagonal, and the chessboard distance minus
        half a cell. Inside: half a cell minus the distance to the nearest known centre.
        """
        here = np.indices(is_unknown.shape, dtype=np.int32)
        distance, nearest = distance_transform_edt(~is_unknown, return_indices=True)
        away = (here - nearest).astype(np.float32)
        lowest = np.maximum(distance - HALF_DIAGONAL, distance_transform_cdt(~is_unknown, "chessboard") - 0.5)
        distance, nearest = distance_transform_edt(is_unknown, return_indices=True)
        np.copyto(away, nearest - here, where=is_unknown, casting="same_kind")
        lowest = np.where(is_unknown, 0.5 - distance, lowest)
        away /= np.sqrt(np.square(away).sum(axis=0))
        return cls(
            is_unknown=is_unknown,
            distance=(voxel * lowest - ROUNDING * (1.0 + voxel * np.abs(lowest))).astype(np.float32),
            away=np.moveaxis(away, 0, -1),
        )

    def join(self, channels: Mapping[str, Values], bound_margin: float) -> tuple[Channels, int]:
        """Channels of the nearer of field and cubes, and the number of changed cells."""
        joined = dict(channels)
        is_nearer = np.asarray(self.distance < np.asarray(channels["sdf"], dtype=np.float32))
        joined["sdf"] = np.where(is_nearer, self.distance, channels["sdf"])
        if "gradient" in channels:
            joined["gradient"] = np.where(is_nearer[..., None], self.away, channels["gradient"])
        if "bound" in channels:
            joined["bound"] = np.minimum(channels["bound"], self.distance - np.float32(bound_margin))
        if "probability" in channels:
            joined["probability"] = np.where(self.is_unknown, np.float32(1.0), channels["probability"])
        return joined, int(np.count_nonzero(is_nearer))
