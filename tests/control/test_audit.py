"""The audit of logged states against known distances."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pytest

from splatctrl_cli.control.audit import DistanceFunction, audit, observed_at
from splatctrl_cli.records import DistanceField, Float64
from tests.control.fakes import Balls, PlanarArm, Plane, far_away


def known(**fields: DistanceField) -> Mapping[str, DistanceFunction]:
    return {name: lambda points, field=field: field.query(points)[0] for name, field in fields.items()}


STAMPS = np.arange(600, dtype=np.int64)


def test_the_clearance_is_that_of_the_nearest_moving_sphere() -> None:
    walls = known(exact=Plane([-1.0, 0, 0], -1.2), half=Plane([-1.0, 0, 0], -1.2, 0.5))
    trace = audit(PlanarArm(), STAMPS[[0, 5]], np.array([[0.0, 0.0], [np.pi / 2, 0.0]]), lambda _: walls)
    np.testing.assert_allclose(trace.clearance["exact"].distance, [1.2 - 0.9 - 0.04, 1.2 - 0.04])
    np.testing.assert_allclose(trace.clearance["half"].distance[0], 0.5 * 0.3 - 0.04)
    assert trace.clearance["exact"].sphere[0] == 4


def test_a_sphere_that_no_joint_moves_does_not_count() -> None:
    trace = audit(PlanarArm(), STAMPS[:1], np.zeros((1, 2)), lambda _: known(exact=Balls([[0.0, 0, 0]], [0.01])))
    assert trace.clearance["exact"].distance[0] == pytest.approx(0.25 - 0.01 - 0.04)


def test_each_state_is_measured_in_the_scene_known_at_its_stamp() -> None:
    before = known(exact=Plane([-1.0, 0, 0], -2.0))
    after = known(exact=Plane([-1.0, 0, 0], -1.5))
    trace = audit(PlanarArm(), STAMPS, np.zeros((600, 2)), lambda stamp: before if stamp < 300 else after)
    np.testing.assert_allclose(trace.clearance["exact"].distance[:300], 1.06)
    np.testing.assert_allclose(trace.clearance["exact"].distance[300:], 0.56)


def test_states_of_one_scene_share_a_query() -> None:
    ball = far_away()
    scene = known(exact=ball)
    audit(PlanarArm(), STAMPS[:200], np.tile([0.0, 0.1], (200, 1)), lambda _: scene)
    assert ball.num_queries == 1


def test_a_field_without_a_distance_gives_nan_and_not_a_guess() -> None:
    def half_known(points: Float64) -> Float64:
        return np.where(points[:, 0] > 0.8, np.nan, 1.0)

    trace = audit(PlanarArm(), STAMPS[:2], np.array([[0.0, 0.0], [np.pi, 0.0]]), lambda _: {"grid": half_known})
    assert np.isnan(trace.clearance["grid"].distance[0])
    assert trace.clearance["grid"].distance[1] == pytest.approx(0.96)


def test_limits_self_clearance_and_unknown_space_are_reported() -> None:
    trace = audit(
        PlanarArm(),
        STAMPS[:2],
        np.array([[2.8, 0.0], [0.0, -2.7]]),
        lambda _: known(exact=far_away()),
        observed=lambda points: (points[:, 0] < 0.3).astype(np.uint8),
    )
    np.testing.assert_allclose(trace.limit_margin, [0.1, -0.1])
    assert trace.limit_joint.tolist() == [0, 1]
    assert trace.self_clearance[1] == pytest.approx(
        np.linalg.norm([0.5 + 0.4 * np.cos(2.7), 0.4 * np.sin(2.7)]) - 0.1
    )
    np.testing.assert_allclose(trace.unknown_share, [0.0, 0.5])


def test_a_point_takes_the_word_of_its_nearest_voxel() -> None:
    seen = np.arange(8, dtype=np.uint8).reshape(2, 2, 2)
    observed = partial(observed_at, seen, np.array([1.0, 1, 1]), 0.1)
    points = np.array([[1.0, 1, 1], [1.04, 1.06, 1.0], [1.1, 1.1, 1.149], [1.1, 1.1, 1.151], [0.9, 1, 1]])
    assert observed(points).tolist() == [0, 2, 7, 0, 0]
