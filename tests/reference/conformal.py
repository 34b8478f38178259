"""Split conformal prediction over blocks of time, each step as it is defined."""

from fractions import Fraction

from splatctrl_cli.records import Float64


def quantile(scores: list[float], confidence: Fraction) -> float | None:
    """The least score that at least (n + 1) * confidence of the n scores do not exceed; None where none is."""
    for score in sorted(scores):
        if sum(other <= score for other in scores) >= (len(scores) + 1) * confidence:
            return score
    return None


def autocorrelation_time(values: Float64) -> float:
    """1 + 2 sum of the biased autocorrelations before the first that is not positive."""
    num, mean = len(values), sum(values) / len(values)
    covariance = [
        sum((values[i] - mean) * (values[i + lag] - mean) for i in range(num - lag)) / num for lag in range(num)
    ]
    total = 1.0
    for lag in range(1, num):
        if covariance[lag] <= 0:
            break
        total += 2 * covariance[lag] / covariance[0]
    return total


def block_of_sets(num_sets: int, length: int) -> list[list[int]]:
    """Whole blocks of `length` sets, of which each begins `length` sets after the last of the one before."""
    found, first = [], 0
    while first + length <= num_sets:
        found.append(list(range(first, first + length)))
        first = found[-1][-1] + length
    return found
