import numpy as np
import pytest

from experiments.paths import joint_length
from splatctrl_cli.errors import InputError
from splatctrl_cli.planner.path import (
    effector_rates,
    resampled,
    timed,
)
from tests.control.fakes import PlanarArm

PATH = np.array([[0.7, 0.2], [0.9, 2.0], [-0.4, 1.5], [-0.42, 1.5]])
ARM = PlanarArm()


def test_resampling_keeps_waypoints_length_and_spacing() -> None:
    rows = resampled(PATH, 0.05)
    assert joint_length(rows) == pytest.approx(joint_length(PATH))
    assert np.max(np.linalg.norm(np.diff(rows, axis=0), axis=1)) <= 0.05 + 1e-12
    assert all(np.any(np.all(np.abs(rows - q) < 1e-12, axis=1)) for q in PATH)


def test_a_timed_path_keeps_its_limits_and_its_edges() -> None:
    path = timed(PATH, ARM.velocity_limit, 3.0)
    clock = np.linspace(0, path.duration, 20_001)
    position, velocity = path.at(clock)
    assert np.all(np.abs(velocity) <= ARM.velocity_limit + 1e-12)
    acceleration = np.diff(velocity, axis=0) / np.diff(clock)[:, None]
    assert np.max(np.abs(acceleration)) <= 3.0 + 1e-6
    middle = (velocity[1:] + velocity[:-1]) / 2 * np.diff(clock)[:, None]
    np.testing.assert_allclose(np.diff(position, axis=0), middle, atol=1e-6)
    np.testing.assert_allclose(position[[0, -1]], PATH[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(path.at(path.start_time)[0], PATH, atol=1e-12)
    assert joint_length(position) == pytest.approx(joint_length(PATH))
    assert np.max(np.abs(velocity), axis=0) == pytest.approx(np.array([1.5, 1.5]), rel=0.2)  # and it uses them


def test_a_path_of_one_place_or_without_limits_is_refused() -> None:
    with pytest.raises(InputError, match="expected at least 2 waypoints, got 1"):
        timed(PATH[:1], ARM.velocity_limit, 3.0)
    with pytest.raises(InputError, match="limits above 0"):
        timed(PATH, np.zeros(2), 3.0)


def test_a_path_keeps_the_speed_of_a_frame_too() -> None:
    rates = effector_rates(ARM, PATH, "tip", max_linear=0.2, max_angular=0.5)
    path = timed(PATH, ARM.velocity_limit, 7.5, max_rate=rates)
    assert path.duration > timed(PATH, ARM.velocity_limit, 7.5).duration
    twists = np.array(
        [ARM.frame_jacobian(q, "tip") @ v for q, v in zip(*path.at(np.arange(0, path.duration, 0.01)), strict=True)]
    )
    linear, angular = np.linalg.norm(twists[:, :3], axis=1), np.linalg.norm(twists[:, 3:], axis=1)
    assert linear.max() < 0.2 * 1.001 and angular.max() < 0.5 * 1.001
    assert linear.max() > 0.199 or angular.max() > 0.499


def test_an_edge_that_leaves_a_frame_where_it_is_has_no_rate() -> None:
    still = effector_rates(ARM, np.array([[0.1, 0.2], [0.1, 0.2]]), "tip", max_linear=0.2, max_angular=0.5)
    assert still == np.inf
