"""Velocity and acceleration limits, judged from positions."""

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import ENCODER, MOTION_WINDOW
from splatctrl_cli.control.motion_limits import MotionLimits
from splatctrl_cli.records import Float64
from tests.reference.intervals import velocity_shares

LIMIT = np.array([2.0, 1.0])


def at_rate(hz: float, seconds: float = 1.0) -> NDArray[np.int64]:
    return np.round(np.arange(0, seconds, 1 / hz) * 1e9).astype(np.int64)


def straight(stamps: NDArray[np.int64], speed: Float64) -> Float64:
    return np.asarray(stamps[:, None] * 1e-9 * speed)


@pytest.mark.parametrize("hz", [10.0, 100.0, 1000.0])
def test_five_percent_too_fast_is_found_and_the_limit_itself_is_kept(hz: float) -> None:
    stamps = at_rate(hz)
    strain = MotionLimits(LIMIT, None).add(stamps, straight(stamps, np.array([2.1, 0.5])))
    assert 1.01 < strain.velocity.max() < 1.05 + 1e-9
    assert (strain.velocity_joint[strain.velocity > 1] == 0).all()
    assert MotionLimits(LIMIT, None).add(stamps, straight(stamps, LIMIT)).velocity.max() <= 1


@pytest.mark.parametrize("speed", [0.0, 0.95])
def test_an_encoders_noise_is_not_taken_for_speed(speed: float) -> None:
    stamps = at_rate(1000)
    noise = np.random.default_rng(0).uniform(-ENCODER, ENCODER, (len(stamps), 2))
    found = MotionLimits(LIMIT, np.array([20.0, 20.0])).add(stamps, straight(stamps, speed * LIMIT) + noise)
    assert found.velocity.max() <= 0.95 + 1e-9
    assert found.acceleration.max() == 0


def test_a_joint_that_jumps_by_pi_for_a_moment_is_too_fast() -> None:
    stamps = at_rate(50)
    positions = np.zeros((len(stamps), 2))
    positions[20:25, 1] = np.pi  # 0.1 s
    found = MotionLimits(LIMIT, None).add(stamps, positions)
    assert found.velocity.max() > 100
    assert found.velocity_joint[found.velocity > 100].tolist() == [1, 1]
    assert np.flatnonzero(found.velocity > 100).tolist() == [20, 25]


def test_shares_are_those_of_the_reference() -> None:
    generator = np.random.default_rng(1)
    stamps = np.cumsum(generator.integers(1, 60, 120)).astype(np.int64) * 1_000_000
    positions = np.cumsum(generator.normal(0, 0.05, (120, 2)), axis=0)
    found = MotionLimits(LIMIT, None).add(stamps, positions)
    np.testing.assert_allclose(
        found.velocity, velocity_shares(stamps, positions, LIMIT, MOTION_WINDOW, ENCODER), rtol=1e-12
    )


def test_an_acceleration_is_found_by_its_size() -> None:
    stamps = at_rate(200)
    positions = np.zeros((len(stamps), 2))
    positions[:, 1] = 0.5 * 6.0 * (stamps * 1e-9) ** 2
    found = MotionLimits(np.array([9.0, 9.0]), np.array([5.0, 5.0])).add(stamps, positions)
    assert found.acceleration.max() == pytest.approx(6.0 / 5.0 - 4 * ENCODER / MOTION_WINDOW**2 / 5.0, rel=1e-6)
    assert (found.acceleration_joint[found.acceleration > 0] == 1).all()
    assert (MotionLimits(np.array([9.0, 9.0]), None).add(stamps, positions).acceleration == 0).all()


@pytest.mark.parametrize("size", [1, 2, 7, 64])
@pytest.mark.parametrize("kind", ["dense", "ragged", "gap"])
def test_blocks_of_any_size_give_the_same(size: int, kind: str) -> None:
    generator = np.random.default_rng(2)
    steps = {"dense": np.full(150, 2), "ragged": generator.integers(1, 90, 150), "gap": np.full(150, 20)}[kind]
    if kind == "gap":
        steps[[30, 31, 64, 100]] = 1000, 30, 400, 170
    stamps = np.cumsum(steps).astype(np.int64) * 1_000_000
    positions = np.cumsum(generator.normal(0, 0.05, (150, 2)), axis=0)
    whole = MotionLimits(LIMIT, LIMIT).add(stamps, positions)
    limits = MotionLimits(LIMIT, LIMIT)
    parts = [limits.add(stamps[k : k + size], positions[k : k + size]) for k in range(0, 150, size)]
    for column in ("velocity", "acceleration", "velocity_joint", "acceleration_joint"):
        joined = np.concatenate([getattr(part, column) for part in parts])
        np.testing.assert_allclose(joined, getattr(whole, column), rtol=1e-9, atol=1e-9)


def test_states_kept_between_blocks_do_not_grow() -> None:
    limits, stamps = MotionLimits(LIMIT, LIMIT), at_rate(1000, 5.0)
    for k in range(0, 5000, 500):
        limits.add(stamps[k : k + 500], np.zeros((500, 2)))
    assert len(limits._stamps) < 200
