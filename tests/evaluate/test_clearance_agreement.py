"""Agreement with the truth, where the surface was seen."""

import numpy as np
import pytest

from splatctrl_cli.evaluate import clearance_agreement as module
from splatctrl_cli.evaluate.clearance_agreement import clearance_agreement, least, mark_seen
from splatctrl_cli.records import Intrinsics
from tests.plain import plain_frame

STAMPS = np.arange(6, dtype=np.int64) * 10


def test_agreement_takes_near_and_seen_states_only() -> None:
    truth = np.array([0.05, 0.05, 0.05, 0.05, 0.10, 0.09])
    clearance = np.array([0.04, 0.07, 0.05, 0.9, 0.9, np.nan])
    seen = np.array([True, True, True, False, True, True])
    agreement = clearance_agreement(clearance, truth, seen, 0.005)
    assert agreement["num_compared"] == 3
    assert agreement["median"] == pytest.approx(0.01)
    assert agreement["largest"] == pytest.approx(0.02)
    assert agreement["largest_over"] == pytest.approx(0.02)
    assert agreement["tolerance"] == pytest.approx(0.015)
    assert agreement["share_within"] == pytest.approx(2 / 3)


def test_an_under_estimate_is_no_over_estimate() -> None:
    agreement = clearance_agreement(np.array([0.01]), np.array([0.05]), np.array([True]), 0.005)
    assert agreement["largest_over"] == 0.0 and agreement["share_within"] == 0.0


def test_without_a_state_to_compare_there_is_no_figure() -> None:
    agreement = clearance_agreement(np.ones(2), np.ones(2), np.ones(2, bool), 0.005)
    assert agreement["num_compared"] == 0 and agreement["median"] is None and agreement["share_within"] is None


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


def test_the_least_value_ignores_what_is_not_finite() -> None:
    assert least(np.array([np.nan, 2.0, np.inf, 1.0])) == 1.0
    assert least(np.array([np.nan])) is None
