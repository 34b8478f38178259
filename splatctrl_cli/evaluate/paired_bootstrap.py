"""A confidence interval of a mean change over recordings, each of which was judged twice."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FEWEST = 8  # recordings; of fewer there are too few different resamples for their percentiles to mean anything
RESAMPLES = 10_000
CONFIDENCE = 0.95
SEED = 0


@dataclass(frozen=True, kw_only=True)
class MeanChange:
    """The mean of num_pairs differences, and an interval that has it with CONFIDENCE."""

    mean: float
    low: float
    high: float
    num_pairs: int


def mean_change(differences: Sequence[float]) -> MeanChange | None:
    """The mean of paired differences with its percentile interval: means of RESAMPLES draws with replacement, by SEED
    (Efron and Tibshirani 1993, section 13.3). None for fewer than FEWEST pairs.
    """
    values, num = np.asarray(differences, dtype=np.float64), len(differences)
    if num < FEWEST:
        return None
    means = values[np.random.default_rng(SEED).integers(num, size=(RESAMPLES, num))].mean(axis=1)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return MeanChange(mean=float(values.mean()), low=float(low), high=float(high), num_pairs=num)
