"""Velocities from positions, and the two clocks of a log."""

import numpy as np
import pytest

from splatctrl_cli.recording.log.state_topics import checked_stamps
from splatctrl_cli.recording.log.state_track import RawTrack, clean_states, differentiate, gaps_of, smoothed_seconds
from splatctrl_cli.records import LossReport
from tests.refused import expect_refusal

MS = 1_000_000

START_NS = 1_700_000_000_000_000_000


def regular(num: int, period_ms: float = 10.0) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return START_NS + np.round(np.arange(num) * period_ms * MS).astype(np.int64)


def test_the_derivative_of_a_parabola_is_exact_at_uneven_steps() -> None:
    stamps = START_NS + np.cumsum(np.random.default_rng(1).integers(4, 30, 60)) * MS
    t = (stamps - stamps[0]) * 1e-9
    position = np.stack([1 + 2 * t + 3 * t**2, -t], axis=1)
    assert differentiate(stamps, position) == pytest.approx(np.stack([2 + 6 * t, -np.ones(60)], axis=1), abs=1e-6)


def test_jitter_of_sending_is_smoothed_out_of_a_fixed_rate() -> None:
    rng = np.random.default_rng(2)
    true = regular(500)
    sent = true + rng.integers(-3 * MS, 3 * MS, 500)
    t = (true - true[0]) * 1e-9
    position, truth = np.sin(2 * t)[:, None], 2 * np.cos(2 * t)[:, None]
    error = np.abs(differentiate(sent, position) - truth)
    raw = np.abs(np.gradient(position[:, 0], (sent - sent[0]) * 1e-9)[:, None] - truth)
    assert error.max() < 0.04 and np.median(error) < np.median(raw) / 10


def test_nothing_is_fitted_across_a_gap() -> None:
    stamps = regular(20)
    stamps[10:] += 5_000 * MS
    position = np.where(np.arange(20) < 10, 0.0, 1.0)[:, None]
    assert list(gaps_of(stamps)) == [9]
    assert differentiate(stamps, position) == pytest.approx(np.zeros((20, 1)), abs=1e-9)


def track(position: np.ndarray[tuple[int, int], np.dtype[np.float64]], velocity: float | None) -> RawTrack:
    return RawTrack(
        where="log",
        names=("a", "b"),
        stamp_ns=regular(len(position)),
        position=position,
        velocity=np.full(position.shape, np.nan if velocity is None else velocity),
    )


def test_a_velocity_of_zero_is_believed_of_a_joint_that_stands_still_only() -> None:
    position = np.stack([np.arange(50) * 0.01, np.full(50, 0.3)], axis=1)
    loss = LossReport()
    assert clean_states(track(position, 0.0), loss)[20].velocity == pytest.approx([1.0, 0.0])
    said = "log: velocities of a are zero throughout although they move; they are differences of the positions"
    assert (loss.differentiated_velocities, loss.notes) == (50, [said])


def test_recorded_velocities_are_kept_and_other_units_are_said() -> None:
    position = np.stack([np.arange(50) * 0.01, np.arange(50) * 0.01], axis=1)
    loss = LossReport()
    assert clean_states(track(position, 1.1), loss)[20].velocity == pytest.approx([1.1, 1.1])
    assert (loss.notes, loss.differentiated_velocities) == ([], 0)
    clean_states(track(position, float(np.degrees(1.0))), loss)
    assert "57.3 times the change of the positions" in loss.notes[0]


def test_a_clock_that_was_set_is_said_and_one_late_message_is_not() -> None:
    stamps, log, loss = regular(60), regular(60), LossReport()
    log[30] += 3_000 * MS
    checked_stamps(stamps, log, "t", loss)
    assert loss.notes == []
    stamps[40:] += 2_500 * MS
    checked_stamps(stamps, log, "t", loss)
    assert "stamps step by 2.500 s against the time of logging at state 40" in loss.notes[0]


def test_lost_states_do_not_bend_the_smoothed_clock_and_stamps_without_a_rate_stay() -> None:
    keep = np.ones(200, dtype=bool)
    keep[[30, 31, 77, 150]] = False
    stamps = regular(200)[keep]
    assert smoothed_seconds(stamps) == pytest.approx((stamps - stamps[0]) * 1e-9, abs=1e-9)
    odd = START_NS + np.cumsum(np.random.default_rng(3).integers(1, 100, 300)) * MS
    assert np.array_equal(smoothed_seconds(odd), (odd - odd[0]) * 1e-9)


@pytest.mark.parametrize("num", [6, 60])
def test_a_jump_from_simulated_to_wall_time_is_mixed_clocks_and_so_are_stamps_set_in_part(num: int) -> None:
    stamps, log, loss = regular(num), regular(num), LossReport()
    stamps[: num // 2] -= START_NS
    said = f"mixed clocks: stamps jump by .* at state {num // 2}"
    expect_refusal(said, checked_stamps, stamps, log, "t", loss)
    stamps = regular(num)
    stamps[3] = 0
    expect_refusal(f"t: mixed clocks: 1 of {num} states have no stamp", checked_stamps, stamps, log, "t", loss)
    assert np.array_equal(checked_stamps(np.zeros(num, np.int64), log, "t", loss), log), "never set: of logging"
    assert "no state has a stamp" in loss.notes[0]


def test_another_clock_and_its_drift_are_measured_and_delays_of_logging_alone_are_none() -> None:
    log, rng, loss = regular(2000), np.random.default_rng(4), LossReport()
    slow = np.round(np.arange(2000) * 0.01 * 1e9 * 1e-3).astype(np.int64)
    stamps = log - START_NS - slow  # simulated, 1000 ppm slow
    delay = rng.exponential(2 * MS, 2000).astype(np.int64)
    assert np.array_equal(checked_stamps(stamps, log + delay, "t", loss), stamps)
    assert "two clocks" in loss.notes[0]
    assert float(loss.notes[1].split("(")[1].split(" ")[0]) == pytest.approx(1000, rel=0.03)
    delay, none = np.random.default_rng(5).exponential(5 * MS, 2000).astype(np.int64), LossReport()
    delay[1700:] += 30 * MS  # a disk that stalls near the end
    checked_stamps(log, log + delay, "t", none)
    assert none.notes == []
