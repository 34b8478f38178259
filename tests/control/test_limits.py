"""Joint limits: what braking needs, accelerations, and velocities by position, in a box that is never empty; and how
near a motion comes to them.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig, load_config
from splatctrl_cli.config.fixed import ENCODER, MOTION_WINDOW
from splatctrl_cli.control.goals import LoggedMotion
from splatctrl_cli.control.replay import OpenLoopTask, ReplayTask, closed_loop, open_loop
from splatctrl_cli.control.terms import FR3_JOINTS, JointLimits, MotionLimits, braking_speed, fr3_limits
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Float64, Index, Stamps
from tests.control.fakes import PlanarArm, far_away
from tests.reference.control import braking_room, fr3_velocity_range
from tests.reference.intervals import velocity_shares
from tests.refused import expect_refusal
from tests.robot.shapes import written

NAMES = tuple(f"fr3_joint{number}" for number in range(1, 8))
CONFIG = ControlConfig()
LIMITED = ControlConfig(max_acceleration=2.0, solver="daqp")
MOVING = np.array([0.4, -0.3])


@pytest.mark.parametrize(("gain", "acceleration"), [(10.0, 2.0), (10.0, 10.0), (50.0, 5.0), (100.0, 3.0), (1.0, 7.0)])
def test_after_a_step_at_the_braking_speed_braking_is_enough(gain: float, acceleration: float) -> None:
    """It is the speed whose room there is, and the linear one outside the bound or without a limit to braking."""
    room, decelerations = np.geomspace(1e-6, 4.0, 500), np.full(500, acceleration)
    speed = braking_speed(room, gain, decelerations, 0.01)
    np.testing.assert_allclose([braking_room(v, gain, acceleration, 0.01) for v in speed], room, rtol=1e-9)
    assert np.all(np.diff(speed) > 0) and np.all(speed <= gain * room + 1e-12)
    later = braking_speed(room - 0.01 * speed, gain, decelerations, 0.01)
    assert np.all(later >= speed - acceleration * 0.01 - 1e-12) and np.all(room - 0.01 * speed >= -1e-15)
    np.testing.assert_array_equal(braking_speed(room, gain, np.full(500, np.inf), 0.01), gain * room)
    np.testing.assert_array_equal(braking_speed(np.array([-0.3, 0.0]), gain, np.ones(2), 0.01), [gain * -0.3, 0.0])


def limits(acceleration: float, **changes: float) -> JointLimits:
    return JointLimits.of(PlanarArm(), replace(CONFIG, max_acceleration=acceleration, **changes))


@pytest.mark.parametrize("acceleration", [0.3, 2.0, 20.0])
def test_the_merged_box_is_never_empty_wherever_the_arm_is_and_however_it_moved(acceleration: float) -> None:
    box, free, random = limits(acceleration), limits(0.0), np.random.default_rng(0)
    for _ in range(500):
        q, last = random.uniform(-4.0, 4.0, 2), random.uniform(-9.0, 9.0, 2)
        (lowest, highest), allowed = box.box(q, last), box.box(q)
        assert np.all(lowest <= highest)
        assert np.all(lowest >= allowed[0]) and np.all(highest <= allowed[1])  # velocity and position come first
        assert np.all(allowed[0] <= allowed[1]) and np.all(np.abs(np.concatenate(allowed)) <= 1.5)
        change = 0.01 * acceleration
        can = np.minimum(allowed[1], last + change) >= np.maximum(allowed[0], last - change)
        assert np.all(np.abs(np.where(can, [lowest - last, highest - last], 0.0)) <= change + 1e-12)
        assert np.all(np.where((q > box.lower) & (q < box.upper), allowed[1] <= free.box(q)[1], True))


@pytest.mark.parametrize(("acceleration", "gain"), [(0.5, 10.0), (5.0, 10.0), (2.0, 100.0)])
def test_from_a_state_that_the_box_led_to_the_acceleration_never_gives_way(acceleration: float, gain: float) -> None:
    """First to a corner of the limits, then at random."""
    box, random = limits(acceleration, barrier_gain=gain), np.random.default_rng(1)
    q, last, corner = np.zeros(2), np.zeros(2), np.array([True, False])
    for step in range(3000):
        lowest, highest = box.box(q, last)
        wish = np.where(random.random(2) < 0.5 if step > 1500 else corner, highest, lowest)
        assert np.all(np.abs(wish - last) <= 0.01 * acceleration + 1e-9)
        q, last = q + 0.01 * wish, wish
        assert np.all(q <= box.upper + 1e-9) and np.all(q >= box.lower - 1e-9)
        if step == 1500:
            np.testing.assert_allclose(q, [box.upper[0], box.lower[1]], atol=1e-3)


def test_no_last_velocity_means_that_no_acceleration_counts() -> None:
    np.testing.assert_array_equal(limits(2.0).box(np.zeros(2)), [[-1.5, -1.5], [1.5, 1.5]])
    np.testing.assert_array_equal([limits(2.0).rest(None), limits(0.0).rest(np.ones(2))], 0.0)
    slowed = [limits(2.0).rest(np.array(last)) for last in ([1.0, -0.01], [0.01, -1.0])]
    np.testing.assert_allclose(slowed, [[0.98, 0.0], [0.0, -0.98]])


def test_accelerations_come_for_all_joints_or_one_by_one(tmp_path: Path) -> None:
    config = load_config(written(tmp_path, "[control]\nmax_acceleration = [1.0, 2]\n", "config.toml"), []).control
    found = JointLimits.of(PlanarArm(), config).acceleration
    assert (config.max_acceleration, np.asarray(found).tolist()) == ((1.0, 2.0), [1.0, 2.0])
    assert limits(0.0).acceleration is None


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (-1.0, "0 or 0.01 to 1000 rad/s"),
        ((1.0, 0.0), "0 or 0.01 to 1000 rad/s"),
        ((1.0, 2.0, 3.0), "one for each joint, got 3"),
    ],
)
def test_an_acceleration_that_cannot_be_is_refused(value: float | tuple[float, ...], words: str) -> None:
    expect_refusal(words, limits, value, error=UsageError)


def test_the_fr3_limits_are_those_that_are_published() -> None:
    """They are continuous, and zero lies between them."""
    limit, random, order = fr3_limits(NAMES), np.random.default_rng(2), [3, 0]
    most, offset, slope, lower, upper = np.array(FR3_JOINTS).T
    for q in random.uniform(lower - 0.1, upper + 0.1, (300, 7)):
        np.testing.assert_allclose(limit(q), fr3_velocity_range(q), atol=1e-12)
    np.testing.assert_allclose(fr3_limits([NAMES[j] for j in order])(q[order])[1], limit(q)[1][order])
    for share in np.linspace(-0.05, 1.05, 2001):
        q = lower + share * (upper - lower)
        lowest, highest = limit(q)
        assert np.all(lowest <= 0) and np.all(highest >= 0) and np.all(highest <= most)
        assert np.all(np.abs(limit(q + 1e-6)[1] - highest) <= 1e-6 * slope / (2 * offset) + 1e-12)


def test_the_fr3_limits_are_merged_with_those_of_the_urdf() -> None:
    by_position = fr3_limits(NAMES[:2])
    lower, upper, near = np.array([-2.7, -1.0]), np.array([2.7, 1.0]), np.array([2.68, 0.9])
    merged = JointLimits(
        lower=lower, upper=upper, velocity=np.array([1.0, 9.0]), gain=100.0, period=0.01, by_position=by_position
    )
    np.testing.assert_allclose(merged.box(np.zeros(2))[1], [1.0, 2.62])
    np.testing.assert_allclose(merged.box(near)[1], np.minimum(by_position(near)[1], [1.0, 9.0]))
    for sign in (1, -1):
        lowest, highest = merged.box(sign * np.array([3.0, 2.0]))
        assert np.all(lowest <= highest) and np.all(np.sign(highest + lowest) == -sign)


@pytest.mark.parametrize("names", [("elbow",), ("fr3_joint1", "fr3_finger_joint1")])
def test_joints_that_the_fr3_does_not_have_are_named(names: tuple[str, ...]) -> None:
    expect_refusal("got " + ", ".join(names), fr3_limits, names, error=UsageError)


def steady(num: int, every_ns: int) -> LoggedMotion:
    """States of a steady motion."""
    stamps = np.arange(num, dtype=np.int64) * every_ns
    return LoggedMotion(stamp_ns=stamps, position=0.3 + straight(stamps, MOVING), velocity=np.tile(MOVING, (num, 1)))


def test_a_closed_loop_starts_at_rest_and_an_anchor_at_the_logged_velocity() -> None:
    arm, config, motion = PlanarArm(), replace(LIMITED, max_time=1.0), steady(20, 100_000_000)
    task = ReplayTask(
        start=motion.position[0],
        T_world_goal=arm.frame_pose(np.array([1.2, 0.9]), "tip"),
        frame="tip",
        anchors=motion,
        anchor_period=0.5,
    )
    trace = closed_loop(arm, config, task, lambda stamp: far_away())
    velocity = np.array([step.velocity for step in trace.steps])
    assert np.abs(velocity[0]).max() <= 0.02 + 1e-9
    (anchor,) = trace.anchored
    assert np.abs(velocity[anchor] - MOVING).max() <= 0.02 + 1e-9 < np.abs(velocity[anchor - 1] - MOVING).max()
    change = np.abs(np.diff(velocity, axis=0)).max(axis=1)
    assert np.all(np.delete(change, anchor - 1) <= 0.02 + 1e-9)


def test_open_loop_counts_accelerations_from_the_logged_velocity() -> None:
    arm, has_distance = PlanarArm(), np.ones(2, dtype=np.bool_)
    task = OpenLoopTask(frame="tip", T_world_goal=arm.frame_pose(np.array([-0.9, 1.4]), "tip"))
    trace = open_loop(arm, LIMITED, steady(2, 10_000_000), task, lambda _: far_away(), has_distance=has_distance)
    np.testing.assert_allclose(np.abs(trace["dv"]).max(axis=1), 0.02, atol=1e-9)


LIMIT = np.array([2.0, 1.0])


def at_rate(hz: float, seconds: float = 1.0) -> Index:
    return np.round(np.arange(0, seconds, 1 / hz) * 1e9).astype(np.int64)


def straight(stamps: Stamps, speed: Float64) -> Float64:
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
    assert found.velocity.max() <= 0.95 + 1e-9 and found.acceleration.max() == 0


def test_a_joint_that_jumps_by_pi_for_a_moment_is_too_fast() -> None:
    positions = np.zeros((50, 2))
    positions[20:25, 1] = np.pi  # 0.1 s
    found = MotionLimits(LIMIT, None).add(at_rate(50), positions)
    (states,) = np.nonzero(found.velocity > 100)
    assert (states.tolist(), found.velocity_joint[states].tolist()) == ([20, 25], [1, 1])


def test_shares_are_those_of_the_reference() -> None:
    generator = np.random.default_rng(1)
    stamps = np.cumsum(generator.integers(1, 60, 120)).astype(np.int64) * 1_000_000
    positions = np.cumsum(generator.normal(0, 0.05, (120, 2)), axis=0)
    expected = velocity_shares(stamps, positions, LIMIT, MOTION_WINDOW, ENCODER)
    np.testing.assert_allclose(MotionLimits(LIMIT, None).add(stamps, positions).velocity, expected, rtol=1e-12)


def test_an_acceleration_is_found_by_its_size() -> None:
    stamps, fast = at_rate(200), np.array([9.0, 9.0])
    positions = np.stack([np.zeros(200), 0.5 * 6.0 * (stamps * 1e-9) ** 2], axis=1)
    found = MotionLimits(fast, np.array([5.0, 5.0])).add(stamps, positions)
    assert found.acceleration.max() == pytest.approx(6.0 / 5.0 - 4 * ENCODER / MOTION_WINDOW**2 / 5.0, rel=1e-6)
    assert (found.acceleration_joint[found.acceleration > 0] == 1).all()
    assert (MotionLimits(fast, None).add(stamps, positions).acceleration == 0).all()


@pytest.mark.parametrize("size", [1, 2, 7, 64])
@pytest.mark.parametrize("kind", ["dense", "ragged", "gap"])
def test_blocks_of_any_size_give_the_same(size: int, kind: str) -> None:
    """And states that are kept between blocks do not grow."""
    generator = np.random.default_rng(2)
    steps = {"dense": np.full(150, 2), "ragged": generator.integers(1, 90, 150), "gap": np.full(150, 20)}[kind]
    if kind == "gap":
        steps[[30, 31, 64, 100]] = 1000, 30, 400, 170
    stamps = np.cumsum(steps).astype(np.int64) * 1_000_000
    positions = np.cumsum(generator.normal(0, 0.05, (150, 2)), axis=0)
    whole, limits = MotionLimits(LIMIT, LIMIT).add(stamps, positions), MotionLimits(LIMIT, LIMIT)
    parts = [limits.add(stamps[k : k + size], positions[k : k + size]) for k in range(0, 150, size)]
    for column in ("velocity", "acceleration", "velocity_joint", "acceleration_joint"):
        joined = np.concatenate([getattr(part, column) for part in parts])
        np.testing.assert_allclose(joined, getattr(whole, column), rtol=1e-9, atol=1e-9)
    for later in np.split(stamps[-1] + 1 + at_rate(1000, 5.0), 10):
        limits.add(later, np.zeros((500, 2)))
    assert len(limits._stamps) < 200
