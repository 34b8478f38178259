"""Plots of replays: what came up is shown, and long series keep their extremes as the columns of a picture."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.report import replay_pictures
from splatctrl_cli.report.replay_pictures import SHORTEST, column, envelope, spans
from tests.report.test_pictures import draw_clearance


def test_each_kind_of_event_that_came_up_has_a_row(tmp_path: Path) -> None:
    draw_clearance(tmp_path / "two.png")
    image = np.asarray(cv2.imread(str(tmp_path / "two.png")), dtype=np.int64)
    orange, purple, brown = ((0, 159, 230), (167, 121, 204), (59, 109, 138))
    widths = [int(np.all(np.abs(image - color) < 3, axis=2).sum(axis=1).max()) for color in (orange, purple, brown)]
    assert widths[1] > 3 * widths[0] > 0 and widths[2] == 0


def test_a_short_series_is_drawn_as_it_is() -> None:
    seconds, values = np.linspace(0, 1, 20), np.arange(20.0)
    of = envelope(seconds, values, columns=10)
    assert of.is_exact
    np.testing.assert_array_equal(of.lowest, values)


@pytest.mark.parametrize("block", [1, 3, 7, 50])
def test_a_column_is_read_by_blocks(monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr(replay_pictures, "BLOCK", block)
    rows = np.arange(14.0).reshape(7, 2)
    np.testing.assert_array_equal(column(rows, 1), rows[:, 1])


def test_a_long_series_keeps_its_extremes_where_they_are() -> None:
    rng = np.random.default_rng(0)
    seconds = np.sort(rng.uniform(0, 100, 5000))
    values = rng.normal(size=5000)
    values[1234], values[4321] = -50.0, 70.0
    of = envelope(seconds, values, columns=100)
    assert not of.is_exact and len(of.seconds) == 100
    low, high = int(np.nanargmin(of.lowest)), int(np.nanargmax(of.highest))
    assert (of.lowest[low], of.highest[high]) == (-50.0, 70.0)
    np.testing.assert_allclose([of.seconds[low], of.seconds[high]], seconds[[1234, 4321]], atol=0.51)
    column = np.minimum((100 * (seconds - seconds[0]) / np.ptp(seconds)).astype(int), 99)
    for k in (0, 50, 99):
        assert of.lowest[k] == values[column == k].min() and of.highest[k] == values[column == k].max()


def test_gaps_and_missing_values_stay_gaps() -> None:
    seconds = np.concatenate([np.linspace(0, 4, 500), np.linspace(6, 10, 500)])
    values = np.ones(1000)
    values[:100] = np.nan
    of = envelope(seconds, values, columns=50)
    is_gap = np.isnan(of.lowest)
    np.testing.assert_array_equal(is_gap, np.isnan(of.highest))
    assert is_gap[(of.seconds > 4.2) & (of.seconds < 5.8)].all() and is_gap[of.seconds < 0.7].all()
    assert not is_gap[(of.seconds > 1) & (of.seconds < 3.8)].any()


def test_short_intervals_can_be_seen_and_those_that_touch_are_one() -> None:
    least = 10 * SHORTEST
    found = spans([(5.0, 6.0), (1.0, 1.0), (1.0 + least / 2, 1.0 + least / 2), (5.5, 5.6)], (0.0, 10.0))
    np.testing.assert_allclose(found, [(1.0, 1.5 * least), (5.0, 1.0)])
    assert spans([], (0.0, 10.0)) == []
    many = [(t, t) for t in np.linspace(0, 10, 100_000)]
    assert spans(many, (0.0, 10.0)) == [(0.0, pytest.approx(10.0 + least))]
