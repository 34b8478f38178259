"""Which splats a field is made of."""

from collections.abc import Collection

import numpy as np

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.records import Label, SplatSet

DEFAULT_LABELS = frozenset({Label.OBJECT, Label.HUMAN})


def field_splats(splats: SplatSet, labels: Collection[Label] = DEFAULT_LABELS) -> SplatSet:
    """The splats with one of `labels`, in order: the robot is left out unless asked for.

    Raises NotEvaluableError where none is left, InputError for an unknown label.
    """
    check_labels(splats)
    kept = splats.select(np.isin(splats.labels, [int(label) for label in labels]))
    if not len(kept):
        names = ", ".join(label.name.lower() for label in sorted(labels))
        raise NotEvaluableError(
            f"splats: none of {len(splats)} is labelled {names}",
            remedy="give a scene that has some; sdf-bake --include takes other labels",
        )
    return kept


def check_labels(splats: SplatSet) -> None:
    """Raise InputError for an unknown label."""
    unknown = ~np.isin(splats.labels, [int(label) for label in Label])
    if unknown.any():
        i = int(np.argmax(unknown))
        raise InputError(f"splat {i}: expected a label of 0, 1 or 2, got {splats.labels[i]}")


def label_counts(splats: SplatSet) -> dict[str, int]:
    """Number of splats by label name."""
    return {label.name.lower(): int(np.count_nonzero(splats.labels == label)) for label in Label}
