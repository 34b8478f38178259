"""Shares of successful trials and means of figures, with intervals, and paired comparisons of two methods."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, norm, wilcoxon
from scipy.stats import t as student

CONFIDENCE = 0.95


@dataclass(frozen=True, kw_only=True)
class Share:
    """num_successes of num trials, and the interval [low, high] that contains the true share with `CONFIDENCE`."""

    num_successes: int
    num: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share, NaN of no trial."""
        return self.num_successes / self.num if self.num else math.nan


def share_of(num_successes: int, num: int) -> Share:
    """A share with Wilson's score interval (Wilson 1927), which stays in [0, 1]; [0, 1] without trials."""
    if not num:
        return Share(num_successes=0, num=0, low=0.0, high=1.0)
    z = float(norm.ppf(0.5 + CONFIDENCE / 2))
    p, scale = num_successes / num, 1.0 + z * z / num
    middle = (p + z * z / (2 * num)) / scale
    half = z * math.sqrt(p * (1 - p) / num + z * z / (4 * num * num)) / scale
    low = 0.0 if num_successes == 0 else middle - half
    return Share(num_successes=num_successes, num=num, low=low, high=1.0 if num_successes == num else middle + half)


@dataclass(frozen=True, kw_only=True)
class Paired:
    """Pairs of trials of two methods: numbers of pairs in which only the first, or only the second, succeeded.
    p_value: McNemar's exact test that neither is better.
    """

    num: int
    only_first: int
    only_second: int
    p_value: float


def paired(outcomes: Sequence[tuple[bool, bool]]) -> Paired:
    """McNemar's test, exact (binomial, two-sided), of pairs of successes (first, second); p is 1 if none differ."""
    first = sum(a and not b for a, b in outcomes)
    second = sum(b and not a for a, b in outcomes)
    p_value = min(1.0, 2.0 * float(binom.cdf(min(first, second), first + second, 0.5))) if first + second else 1.0
    return Paired(num=len(outcomes), only_first=first, only_second=second, p_value=p_value)


def mean_between(values: Sequence[float]) -> tuple[float, float, float]:
    """The mean, and the interval of the true mean with `CONFIDENCE` by Student's t; NaN for too few values."""
    if not values:
        return math.nan, math.nan, math.nan
    mean, num = float(np.mean(values)), len(values)
    if num == 1:
        return mean, math.nan, math.nan
    half = float(student.ppf(0.5 + CONFIDENCE / 2, num - 1) * np.std(values, ddof=1)) / math.sqrt(num)
    return mean, mean - half, mean + half


def signed_rank(differences: Sequence[float]) -> tuple[str, str, str, str]:
    """Text on differences within pairs: the mean, its interval, how many are above 0, and the two-sided p of
    Wilcoxon's signed ranks. p is NaN for fewer than five pairs, or if none differs.
    """
    mean, low, high = mean_between(differences)
    p = float(wilcoxon(differences).pvalue) if len(differences) > 4 and np.any(differences) else math.nan
    above = sum(value > 0 for value in differences)
    return f"{mean:+.2f}", f"{low:+.2f} to {high:+.2f}", f"{above}/{len(differences)}", f"{p:.2g}"
