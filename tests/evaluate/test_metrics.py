"""How figures of states fold, the interval of a mean change, agreement with the truth, and the conformal bound."""

from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy import stats

from splatctrl_cli.evaluate import metrics as module
from splatctrl_cli.evaluate.conformal import (
    autocorrelation_time,
    block_of_sets,
    block_scores,
    conformal_bound,
    conformal_rank,
)
from splatctrl_cli.evaluate.metrics import (
    FEWEST,
    MeanChange,
    clearance_agreement,
    largest,
    least,
    lowest,
    mark_seen,
    mean_change,
)
from splatctrl_cli.records import Float64, Intrinsics
from tests.plain import plain_frame
from tests.properties import few
from tests.reference import conformal as reference


@pytest.mark.parametrize(
    ("fold", "values", "expected"),
    [
        (largest, [1e-9, np.inf, np.nan], None),
        (largest, [1e-9, 2e-9, np.nan], 2e-9),
        (largest, [np.nan], None),
        (lowest, [np.nan, -np.inf, 1.0], -np.inf),
        (least, [np.nan, 2.0, np.inf, 1.0], 1.0),
        (least, [np.nan], None),
    ],
)
def test_a_residual_that_is_infinite_is_not_left_out_of_the_largest(
    fold: Callable[[Float64], float | None], values: list[float], expected: float | None
) -> None:
    """Nor of the lowest; the least value ignores what is not finite."""
    assert fold(np.array(values)) == expected


def changed(values: ArrayLike) -> MeanChange:
    return mean_change(np.asarray(values, np.float64).tolist())


def test_fewer_than_eight_pairs_have_no_interval() -> None:
    assert mean_change([1.0] * (FEWEST - 1)) is None
    found = changed([1.0] * FEWEST)
    assert (found.mean, found.low, found.high, found.num_pairs) == (1.0, 1.0, 1.0, 8)


def test_the_interval_is_that_of_scipy_and_the_same_every_time() -> None:
    values = np.random.default_rng(3).normal(0.4, 1.0, 20)
    theirs = stats.bootstrap(
        (values,), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(9)
    ).confidence_interval
    found = changed(values)
    assert found == changed(values) and found.mean == pytest.approx(values.mean())
    assert (found.low, found.high) == pytest.approx((theirs.low, theirs.high), abs=0.03)


def test_a_mean_of_zero_is_found_to_differ_about_as_often_as_is_promised() -> None:
    """Percentile intervals of twenty pairs are somewhat too short: 7 % instead of 5."""
    rng = np.random.default_rng(1)
    found = [changed(rng.normal(0.0, 1.0, 20)) for _ in range(200)]
    assert 4 <= sum(not each.low <= 0 <= each.high for each in found) <= 24


STAMPS = np.arange(6, dtype=np.int64) * 10


def agreement(clearance: list[float], truth: list[float], seen: list[bool]) -> list[float | None]:
    found = clearance_agreement(np.array(clearance), np.array(truth), np.array(seen), 0.005)
    return [
        found[name] for name in ("num_compared", "median", "largest", "largest_over", "tolerance", "share_within")
    ]


def test_agreement_takes_near_and_seen_states_only() -> None:
    """An under-estimate is no over-estimate, and without a state to compare there is no figure."""
    truth, seen = [0.05, 0.05, 0.05, 0.05, 0.10, 0.09], [True, True, True, False, True, True]
    assert agreement([0.04, 0.07, 0.05, 0.9, 0.9, np.nan], truth, seen) == pytest.approx(
        [3, 0.01, 0.02, 0.02, 0.015, 2 / 3]
    )
    assert agreement([0.01], [0.05], [True])[3::2] == [0.0, 0.0]
    assert agreement([1.0, 1.0], [1.0, 1.0], [True, True])[::5] == [0, None]


@pytest.mark.parametrize("block", [1, 4, 6])
def test_a_frame_shows_a_surface_to_later_states_only(monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    frame = plain_frame(1.0, Intrinsics(fx=3.0, fy=3.0, cx=1.0, cy=1.0, width=3, height=3), stamp_ns=20)
    monkeypatch.setattr(module, "BLOCK", block)
    points = np.tile([0.0, 0.0, 1.0], (6, 1))
    points[5] = [0.0, 0.0, 1.5]
    seen = np.zeros(6, bool)
    mark_seen(seen, points, STAMPS, frame)
    assert seen.tolist() == [False, False, True, True, True, False]
    mark_seen(seen, points, STAMPS, frame, has_clock=False)
    assert seen.tolist() == [True] * 5 + [False]


@few(200)
@given(scores=st.lists(st.integers(-5, 20).map(float), min_size=1, max_size=40), percent=st.integers(50, 99))
def test_the_rank_is_that_of_the_definition(scores: list[float], percent: int) -> None:
    rank = conformal_rank(len(scores), percent / 100)
    assert (sorted(scores)[rank - 1] if rank <= len(scores) else None) == reference.quantile(
        scores, Fraction(percent, 100)
    )


@pytest.mark.parametrize("num", [2, 3, 9, 19, 98, 99, 100, 1000])
def test_the_highest_confidence_of_n_scores_takes_the_largest(num: int) -> None:
    assert (conformal_rank(num, num / (num + 1)), conformal_rank(num, (num + 0.01) / (num + 1))) == (num, num + 1)


@few(100)
@given(values=st.lists(st.integers(0, 9), min_size=2, max_size=30).filter(lambda v: len(set(v)) > 1))
def test_the_autocorrelation_time_is_that_of_the_definition(values: list[int]) -> None:
    series = np.array(values, np.float64)
    assert autocorrelation_time(series) == int(np.ceil(reference.autocorrelation_time(series) - 1e-9))


@few(100)
@given(num=st.integers(1, 60), length=st.integers(1, 12))
def test_blocks_are_apart_and_no_set_is_lost(num: int, length: int) -> None:
    found = block_of_sets(num, length)
    expected = reference.block_of_sets(num, length)
    assert found[-1] + 1 == max(len(expected), 1)
    for number, sets in enumerate(expected):
        assert (found[sets] == number).all()
    for before, after in pairwise(expected):
        assert after[0] - before[-1] == length
    assert (np.diff(found) >= 0).all() and (np.diff(found) <= 1).all()


def test_a_miss_between_two_blocks_counts() -> None:
    for at in range(40):
        series = 0.001 * (np.arange(40) % 2 == 0) + np.repeat(np.linspace(0.0, 0.004, 5), 8)
        series[at] = 0.5
        bound = conformal_bound(series, 0.99)
        assert (bound.bound, bound.at) == (0.5, at)


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
    bound = conformal_bound(with_holes[0], 0.9)
    assert bound is not None and np.isfinite(bound.bound) and with_holes[0][bound.at] == bound.bound
    scores, deciding = block_scores(np.array([1.0, np.nan, 3.0, np.nan, np.nan, 2.0]), np.array([0, 0, 1, 2, 2, 3]))
    assert (scores.tolist(), deciding.tolist()) == ([1.0, 3.0, 2.0], [0, 2, 5])


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.9, 0.99])
@pytest.mark.parametrize("num", [5, 20, 120])
@pytest.mark.parametrize("kind", ["normal", "heavy", "mixed"])
def test_a_further_exchangeable_score_is_covered_as_promised(kind: str, num: int, confidence: float) -> None:
    """Mixed are exchangeable but dependent: every row has its own place and width."""
    rng, trials = np.random.default_rng([num, int(100 * confidence), len(kind)]), 4000
    scores = (rng.standard_cauchy if kind == "heavy" else rng.standard_normal)((trials, num + 1))
    if kind == "mixed":
        scores = 3 * rng.standard_normal((trials, 1)) + rng.random((trials, 1)) * scores
    allowed = min(confidence, num / (num + 1))
    bound = np.sort(scores[:, :-1], axis=1)[:, conformal_rank(num, allowed) - 1]
    spread = 3.5 * np.sqrt(allowed * (1 - allowed) / trials)
    assert allowed - spread <= np.mean(scores[:, -1] <= bound) <= allowed + 1 / (num + 1) + spread


@pytest.mark.parametrize("share", [0.0, 0.6, 0.85])
def test_a_further_block_of_a_slow_series_is_covered_as_promised(share: float) -> None:
    rng = np.random.default_rng(int(100 * share))
    num_sets, covered, promised = 150, [], []
    for row in correlated(rng, (600, 4 * num_sets), share):
        bound = conformal_bound(row[:num_sets], 0.9)
        covered.append(row[num_sets + 100 :][: bound.length].max() <= bound.bound)
        promised.append(bound.confidence)
    assert np.mean(covered) >= np.mean(promised) - 3.5 * np.sqrt(0.09 / 600)


@pytest.mark.parametrize("series", [[0.01], [np.nan] * 7, [], np.linspace(0.0, 1.0, 6)])
def test_one_block_bounds_nothing(series: ArrayLike) -> None:
    """All of the last one is one drift."""
    assert conformal_bound(np.asarray(series, np.float64), 0.99) is None
    two = conformal_bound(np.array([0.01, 0.03]), 0.99)
    assert (two.bound, two.num_blocks, two.confidence) == (0.03, 2, pytest.approx(2 / 3))
