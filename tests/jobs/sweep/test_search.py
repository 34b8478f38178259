"""Known functions of one or several values, and where the search says that their outcome changes."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from splatctrl_cli.jobs.sweep.search import Flip, find_flip, find_least

Span = tuple[float, float]


class Counted:
    """Outcomes of values: failed within spans, not evaluable within others; every value may be asked for once."""

    def __init__(self, *failed: Span, lacking: Sequence[Span] = ()) -> None:
        self.failed, self.lacking, self.asked = failed, lacking, list[float]()

    def __call__(self, values: Sequence[float]) -> list[str]:
        assert not set(values) & set(self.asked)
        self.asked += values
        return [self.outcome(value) for value in values]

    def outcome(self, value: float) -> str:
        if any(low <= value < high for low, high in self.failed):
            return "failed"
        return "not evaluable" if any(low <= value < high for low, high in self.lacking) else "passed"


def bisected(judge: Callable[[float], str], low: float, high: float, tolerance: float) -> float:
    """What bisection alone takes for the flip."""
    first = judge(low)
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (middle, high) if judge(middle) == first else (low, middle)
    return high


@pytest.mark.parametrize(("start", "end"), [(0.0, 1.0), (1.0, 0.0), (-3.0, 5.0)])
@pytest.mark.parametrize("is_monotone", [True, False])
def test_a_flip_is_told_to_the_tolerance_from_either_side(start: float, end: float, is_monotone: bool) -> None:
    judge = Counted((0.4371, 9.0))
    found = find_flip(judge, start, end, tolerance=0.001, is_monotone=is_monotone)
    assert found.last is not None and found.first is not None and found.is_monotone
    assert min(found.last, found.first) < 0.4371 <= max(found.last, found.first)
    assert 0 < abs(found.first - found.last) <= 0.001 * (1 + 1e-9)
    assert judge.outcome(found.last) == judge.outcome(start) != judge.outcome(found.first)
    assert found.outcomes == {value: judge.outcome(value) for value in judge.asked}


def test_whole_values_flip_between_neighbours() -> None:
    judge = Counted((-1, 1737))
    found = find_flip(judge, 5000, 100, tolerance=200.0, is_whole=True)
    assert (found.last, found.first) == (1737, 1736)
    assert all(value == int(value) for value in judge.asked)
    few = find_flip(Counted((2, 9)), 0, 2, tolerance=0.1, is_whole=True)
    assert (few.last, few.first, len(few.outcomes)) == (1, 2, 3)


def test_a_verdict_that_turns_back_fools_bisection_and_is_caught() -> None:
    """Between 0.2 and 0.3 it fails, from 0.8 on again: halving sees 0.5 pass and tells the flip at 0.8."""
    judge = Counted((0.2, 0.3), (0.8, 9.0))
    assert bisected(judge.outcome, 0.0, 1.0, 0.001) == pytest.approx(0.8, abs=0.001)
    found = find_flip(judge, 0.0, 1.0, tolerance=0.001, is_monotone=True)
    assert found.first == pytest.approx(0.2, abs=0.001) and not found.is_monotone


def test_where_it_turns_back_a_nearer_flip_is_looked_for() -> None:
    """Of the quarters only the middle fails, which says that it turns back; of the eighths the first fails, too."""
    found = find_flip(Counted((0.1, 0.2), (0.45, 0.55)), 0.0, 1.0, tolerance=0.001, is_monotone=True)
    assert found.first == pytest.approx(0.1, abs=0.001) and not found.is_monotone


def test_a_flip_between_ends_that_agree_is_found() -> None:
    found = find_flip(Counted((0.3, 0.6)), 0.0, 1.0, tolerance=0.01, is_monotone=True)
    assert found.first == pytest.approx(0.3, abs=0.01) and not found.is_monotone


def test_what_is_not_declared_monotone_is_searched_and_what_may_be_missed_is_told() -> None:
    narrow = (0.51, 0.55)
    declared = find_flip(Counted(narrow), 0.0, 1.0, tolerance=0.01, is_monotone=True)
    searched = find_flip(Counted((0.51, 0.64)), 0.0, 1.0, tolerance=0.01)
    assert declared.first is None and declared.spacing == pytest.approx(0.25)
    assert searched.first == pytest.approx(0.51, abs=0.01) and searched.spacing == pytest.approx(1 / 8)
    assert find_flip(Counted(narrow), 0.0, 1.0, tolerance=0.01).spacing > narrow[1] - narrow[0]


def test_a_third_verdict_between_the_two_is_a_flip_of_its_own() -> None:
    judge = Counted((0.8, 9.0), lacking=[(0.45, 0.8)])
    found = find_flip(judge, 0.0, 1.0, tolerance=0.01, is_monotone=True)
    assert found.first is not None and judge.outcome(found.first) == "not evaluable"
    assert found.first == pytest.approx(0.45, abs=0.01) and found.is_monotone


def test_without_a_flip_there_is_none() -> None:
    found = find_flip(Counted((5.0, 6.0)), 0.0, 1.0, tolerance=0.01)
    assert (found.last, found.first) == (None, None) and set(found.outcomes.values()) == {"passed"}


def beyond(*slope: float) -> Callable[[Sequence[Sequence[float]]], list[str]]:
    """Fails where the scalar product with the slope is 1 or more."""
    return lambda points: ["failed" if np.dot(slope, point) >= 1.0 else "passed" for point in points]


@pytest.mark.parametrize("slope", [(2.0, 1.5), (1.2, 3.0), (2.0, 2.0, 2.0), (0.9, 0.2)])
def test_the_least_change_of_several_is_near_that_of_a_plane(slope: tuple[float, ...]) -> None:
    alone = [1.0 / each if each >= 1.0 else None for each in slope]
    found = find_least(beyond(*slope), alone, tolerance=0.005)
    assert found is not None
    foot = np.array(slope) / np.dot(slope, slope)
    assert found.length <= 1.06 * np.linalg.norm(foot) + 0.005
    assert found.length == pytest.approx(math.hypot(*found.first), rel=1e-4)
    assert beyond(*slope)([found.last, found.first]) == ["passed", "failed"]
    assert all(0.0 <= share <= 1.0 for share in found.first)
    assert found == find_least(beyond(*slope), alone, tolerance=0.005)


def test_what_only_all_together_flip_is_found_at_the_corner() -> None:
    found = find_least(beyond(0.51, 0.51), [None, None], tolerance=0.01)
    assert found is not None and min(found.first) > 0.9
    assert find_least(beyond(0.4, 0.4), [None, None], tolerance=0.01) is None


def test_a_flip_of_one_value_alone_stands_where_nothing_is_nearer() -> None:
    found = find_least(beyond(4.0, 0.0), [0.25, None], tolerance=0.01)
    assert found is not None and found.first == (0.25, 0.0)


def test_flips_are_the_same_each_time() -> None:
    def once() -> Flip:
        return find_flip(Counted((0.2, 0.3), (0.8, 9.0)), 0.0, 1.0, tolerance=0.003)

    assert once() == once()
