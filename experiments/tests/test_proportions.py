"""Shares with their intervals, and paired outcomes, against scipy's own."""

import math

import pytest
from scipy.stats import binomtest, ttest_1samp, wilcoxon

from experiments.proportions import CONFIDENCE, mean_between, paired, share_of, signed_rank


@pytest.mark.parametrize(("successes", "num"), [(0, 1), (1, 1), (0, 30), (29, 30), (30, 30), (541, 546), (95, 100)])
def test_the_interval_of_a_share_is_wilsons(successes: int, num: int) -> None:
    share = share_of(successes, num)
    expected = binomtest(successes, num).proportion_ci(CONFIDENCE, method="wilson")
    assert (share.low, share.high) == pytest.approx((expected.low, expected.high), abs=1e-12)
    assert share.value == successes / num and share.low <= share.value <= share.high


def test_a_share_of_no_trial_may_be_anything() -> None:
    share = share_of(0, 0)
    assert math.isnan(share.value) and (share.low, share.high) == (0.0, 1.0)


@pytest.mark.parametrize(("first", "second", "both"), [(0, 6, 3), (4, 4, 0), (12, 3, 40), (1, 0, 0), (0, 0, 9)])
def test_paired_outcomes_are_tested_by_the_pairs_that_differ_alone(first: int, second: int, both: int) -> None:
    outcomes = [(True, False)] * first + [(False, True)] * second + [(True, True)] * both + [(False, False)] * 2
    test = paired(outcomes)
    assert (test.num, test.only_first, test.only_second) == (len(outcomes), first, second)
    expected = binomtest(first, first + second).pvalue if first + second else 1.0
    assert test.p_value == pytest.approx(expected, rel=1e-9)


def test_the_interval_of_a_mean_is_students_and_a_lone_value_has_none() -> None:
    values = [1.0, 2.5, 3.0, 7.0]
    expected = ttest_1samp(values, 0.0).confidence_interval(CONFIDENCE)
    assert mean_between(values) == pytest.approx((3.375, expected.low, expected.high), rel=1e-9)
    assert mean_between([4.0])[0] == 4.0 and math.isnan(mean_between([4.0])[1])
    assert all(math.isnan(value) for value in mean_between([]))


def test_differences_within_pairs_are_tested_by_their_signed_ranks() -> None:
    differences = [-1.0, 2.0, 3.0, -4.0, 5.0, 6.0]
    mean, between, above, p = signed_rank(differences)
    assert (mean, above) == ("+1.83", "4/6") and between.startswith("-2.")
    assert float(p) == pytest.approx(wilcoxon(differences).pvalue, rel=0.05)
    assert (signed_rank([0.0] * 6)[3], signed_rank(differences[:4])[3]) == ("nan", "nan")
