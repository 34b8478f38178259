"""What a field of a scene is made of: its splats, and balls around occupied voxels that have none."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.records import Index, Label, SplatSet
from splatctrl_cli.voxels import Balls

DEFAULT_LABELS = frozenset({Label.OBJECT, Label.HUMAN})
NO_SPLAT = -1


@dataclass(frozen=True, kw_only=True)
class ObstacleSpheres:
    """The N spheres of a field, balls last, as splats; index (N,) in the scene's splats, NO_SPLAT of a ball."""

    splats: SplatSet
    index: Index

    @property
    def num_unrepresented(self) -> int:
        """How many are balls."""
        return int(np.count_nonzero(self.index == NO_SPLAT))


def obstacle_spheres(
    splats: SplatSet, balls: Balls | None, labels: Collection[Label] = DEFAULT_LABELS
) -> ObstacleSpheres:
    """The splats and the balls with one of `labels`. Raises as `field_splats`, where there is no such ball either."""
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
    index = np.concatenate([np.flatnonzero(is_chosen), np.full(count, NO_SPLAT)])
    return ObstacleSpheres(splats=chosen.joined(added), index=index)


def field_splats(splats: SplatSet, labels: Collection[Label] = DEFAULT_LABELS) -> SplatSet:
    """The splats with one of `labels`, in order: the robot is left out unless asked for.

    Raises NotEvaluableError where none is left, InputError for a label that is none of ours.
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
    """Raise InputError for a label that is none of ours."""
    unknown = ~np.isin(splats.labels, [int(label) for label in Label])
    if unknown.any():
        i = int(np.argmax(unknown))
        raise InputError(f"splat {i}: expected a label of 0, 1 or 2, got {splats.labels[i]}")


def label_counts(splats: SplatSet) -> dict[str, int]:
    """Number of splats by label name."""
    return {label.name.lower(): int(np.count_nonzero(splats.labels == label)) for label in Label}
