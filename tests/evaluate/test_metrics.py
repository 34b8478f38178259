"""How figures of states fold over them, and the interval of a mean change."""

import numpy as np
import pytest
from scipy import stats

from splatctrl_cli.evaluate.metrics import FEWEST, largest, lowest, mean_change


def test_a_residual_that_is_infinite_is_not_left_out_of_thelargest() -> None:
    assert largest(np.array([1e-9, np.inf, np.nan])) is None
    assert largest(np.array([1e-9, 2e-9, np.nan])) == 2e-9
    assert largest(np.array([np.nan])) is None
    assert lowest(np.array([np.nan, -np.inf, 1.0])) == -np.inf


def test_fewer_than_eight_pairs_have_no_interval() -> None:
    assert mean_change([1.0] * (FEWEST - 1)) is None
    found = mean_change([1.0] * FEWEST)
    assert found is not None
    assert (found.mean, found.low, found.high, found.num_pairs) == (1.0, 1.0, 1.0, 8)


def test_the_interval_is_that_of_scipy_and_the_same_every_time() -> None:
    values = np.random.default_rng(3).normal(0.4, 1.0, 20)
    found = mean_change(list(values))
    assert found is not None
    theirs = stats.bootstrap(
        (values,), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(9)
    )
    assert found.mean == pytest.approx(values.mean())
    assert found.low == pytest.approx(theirs.confidence_interval.low, abs=0.03)
    assert found.high == pytest.approx(theirs.confidence_interval.high, abs=0.03)
    assert mean_change(list(values)) == found


def test_a_mean_of_zero_is_found_to_differ_about_as_often_as_is_promised() -> None:
    """Percentile intervals of twenty pairs are somewhat too short: 7 % instead of 5."""
    rng, misses = np.random.default_rng(1), 0
    for _ in range(200):
        found = mean_change(list(rng.normal(0.0, 1.0, 20)))
        assert found is not None
        misses += not found.low <= 0 <= found.high
    assert 4 <= misses <= 24
