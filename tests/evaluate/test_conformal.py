from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatctrl_cli.evaluate.conformal import (
    autocorrelation_time,
    conformal_bound,
    conformal_rank,
    stretch_scores,
    stretches,
)
from splatctrl_cli.records import Float64
from tests.properties import few
from tests.reference import conformal as reference


@few(200)
@given(scores=st.lists(st.integers(-5, 20).map(float), min_size=1, max_size=40), percent=st.integers(50, 99))
def test_the_rank_is_that_of_the_definition(scores: list[float], percent: int) -> None:
    rank = conformal_rank(len(scores), percent / 100)
    expected = reference.quantile(scores, Fraction(percent, 100))
    assert (sorted(scores)[rank - 1] if rank <= len(scores) else None) == expected


@pytest.mark.parametrize("num", [2, 3, 9, 19, 98, 99, 100, 1000])
def test_the_highest_confidence_of_n_scores_takes_the_largest(num: int) -> None:
    assert conformal_rank(num, num / (num + 1)) == num
    assert conformal_rank(num, (num + 0.01) / (num + 1)) == num + 1


@few(100)
@given(values=st.lists(st.integers(0, 9), min_size=2, max_size=30).filter(lambda v: len(set(v)) > 1))
def test_the_autocorrelation_time_is_that_of_the_definition(values: list[int]) -> None:
    series = np.array(values, np.float64)
    assert autocorrelation_time(series) == int(np.ceil(reference.autocorrelation_time(series) - 1e-9))


@few(100)
@given(num=st.integers(1, 60), length=st.integers(1, 12))
def test_stretches_are_apart_and_no_set_is_lost(num: int, length: int) -> None:
    found = stretches(num, length)
    expected = reference.stretches(num, length)
    assert found[-1] + 1 == max(len(expected), 1)
    for number, sets in enumerate(expected):
        assert (found[sets] == number).all()
    for before, after in pairwise(expected):
        assert after[0] - before[-1] == length
    assert (np.diff(found) >= 0).all() and (np.diff(found) <= 1).all()


def test_a_miss_between_two_stretches_counts() -> None:
    misses = np.zeros(40)
    misses[::2] = 0.001
    slow = np.repeat(np.linspace(0.0, 0.004, 5), 8)
    for at in range(40):
        series = misses + slow
        series[at] = 0.5
        bound = conformal_bound(series, 0.99)
        assert bound is not None and (bound.bound, bound.at) == (0.5, at)


def correlated(rng: np.random.Generator, shape: tuple[int, int], share: float) -> Float64:
    """Rows (R, T) of a stationary series whose neighbours correlate by `share`."""
    drive = rng.standard_normal(shape)
    series = drive.copy()
    for t in range(1, shape[1]):
        series[:, t] = share * series[:, t - 1] + np.sqrt(1 - share**2) * drive[:, t]
    return series


def test_white_misses_are_independent_and_slow_ones_are_not() -> None:
    rng = np.random.default_rng(1)
    assert np.median([autocorrelation_time(row) for row in rng.standard_normal((50, 200))]) <= 3
    slow = [autocorrelation_time(row) for row in correlated(rng, (50, 1000), 0.8)]
    assert 7 <= np.median(slow) <= 12  # (1 + 0.8) / (1 - 0.8) = 9
    assert autocorrelation_time(np.full(30, 0.004)) == 1


def test_what_is_not_there_takes_no_part() -> None:
    rng = np.random.default_rng(2)
    rows = correlated(rng, (60, 400), 0.7)
    with_holes = np.where(rng.random(rows.shape) < 0.3, np.nan, rows)
    whole, part = (np.median([autocorrelation_time(row) for row in given]) for given in (rows, with_holes))
    assert abs(whole - part) <= 1
    holes = with_holes[0]
    bound = conformal_bound(holes, 0.9)
    assert bound is not None and np.isfinite(bound.bound) and holes[bound.at] == bound.bound
    scores, deciding = stretch_scores(np.array([1.0, np.nan, 3.0, np.nan, np.nan, 2.0]), np.array([0, 0, 1, 2, 2, 3]))
    assert scores.tolist() == [1.0, 3.0, 2.0] and deciding.tolist() == [0, 2, 5]


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.9, 0.99])
@pytest.mark.parametrize("num", [5, 20, 120])
@pytest.mark.parametrize("kind", ["normal", "heavy", "mixed"])
def test_a_further_exchangeable_score_is_covered_as_promised(kind: str, num: int, confidence: float) -> None:
    rng = np.random.default_rng([num, int(100 * confidence), len(kind)])
    trials = 4000
    scores = rng.standard_normal((trials, num + 1))
    if kind == "heavy":
        scores = rng.standard_cauchy((trials, num + 1))
    if kind == "mixed":  # exchangeable but dependent: every row has its own place and width
        scores = 3 * rng.standard_normal((trials, 1)) + rng.random((trials, 1)) * scores
    allowed = min(confidence, num / (num + 1))
    bound = np.sort(scores[:, :-1], axis=1)[:, conformal_rank(num, allowed) - 1]
    covered = float(np.mean(scores[:, -1] <= bound))
    spread = 3.5 * np.sqrt(allowed * (1 - allowed) / trials)
    assert allowed - spread <= covered <= allowed + 1 / (num + 1) + spread


@pytest.mark.parametrize("share", [0.0, 0.6, 0.85])
def test_a_further_stretch_of_a_slow_series_is_covered_as_promised(share: float) -> None:
    rng = np.random.default_rng(int(100 * share))
    num_sets, covered, promised = 150, [], []
    for row in correlated(rng, (600, 4 * num_sets), share):
        bound = conformal_bound(row[:num_sets], 0.9)
        assert bound is not None
        later = row[num_sets + 100 :][: bound.length]
        covered.append(later.max() <= bound.bound)
        promised.append(bound.confidence)
    assert np.mean(covered) >= np.mean(promised) - 3.5 * np.sqrt(0.09 / 600)


def test_one_stretch_bounds_nothing() -> None:
    assert conformal_bound(np.array([0.01]), 0.99) is None
    assert conformal_bound(np.full(7, np.nan), 0.99) is None
    assert conformal_bound(np.zeros(0), 0.99) is None
    assert conformal_bound(np.linspace(0.0, 1.0, 6), 0.99) is None  # all of it is one drift
    two = conformal_bound(np.array([0.01, 0.03]), 0.99)
    assert two is not None and (two.bound, two.num_stretches) == (0.03, 2)
    assert two.confidence == pytest.approx(2 / 3)
