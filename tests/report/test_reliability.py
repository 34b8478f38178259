"""How often points of a predicted probability do collide."""

import numpy as np
import pytest

from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.report.reliability import reliability


def test_a_probability_that_is_drawn_by_itself_is_reliable() -> None:
    rng = np.random.default_rng(0)
    probability = rng.uniform(0, 1, 200_000)
    curve = reliability(probability, rng.uniform(0, 1, 200_000) < probability)
    np.testing.assert_allclose(curve.predicted, np.arange(0.05, 1, 0.1), atol=2e-3)
    np.testing.assert_allclose(curve.observed, curve.predicted, atol=0.02)
    assert curve.calibration_error < 0.005
    assert curve.count.sum() == 200_000


def test_bins_hold_what_they_say() -> None:
    curve = reliability(np.array([0.0, 0.1, 0.6, 0.8, 1.0]), np.array([False, True, True, True, False]), bins=4)
    np.testing.assert_array_equal(curve.count, [2, 0, 1, 2])
    np.testing.assert_allclose(curve.predicted, [0.05, np.nan, 0.6, 0.9])
    np.testing.assert_allclose(curve.observed, [0.5, np.nan, 1.0, 0.5])
    assert curve.calibration_error == pytest.approx((2 * 0.45 + 1 * 0.4 + 2 * 0.4) / 5)


def test_what_is_no_probability_is_refused() -> None:
    with pytest.raises(NotEvaluableError, match="at least one point"):
        reliability(np.empty(0), np.empty(0, bool))
    with pytest.raises(UsageError, match=r"point 1: expected a probability in \[0, 1\], got nan"):
        reliability(np.array([0.5, np.nan]), np.ones(2, bool))
    with pytest.raises(UsageError, match=r"point 0: .* got 1.5"):
        reliability(np.array([1.5]), np.ones(1, bool))
