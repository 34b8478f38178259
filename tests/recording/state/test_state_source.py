"""Robot logs of every kind as joint states, and what each kind of bad log says."""

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from splatctrl_cli.geometry import pose_at
from splatctrl_cli.recording.log.decoder import JOINT_STATE
from splatctrl_cli.records import Float64, JointState, RecordSource, RgbdFrame
from tests.recording.log.make_log import LogRecipe, built, make_log
from tests.recording.log.make_states import (
    AB,
    FRANKA_ROBOT_STATE,
    FRANKA_STATE,
    NEW_CONTROLLER,
    OLD_CONTROLLER,
    START_NS,
    STEP_NS,
    STORE,
    Message,
    header,
    joint_state,
    opened,
    refusal,
    states,
    states_of,
    store_with,
    write_bag1,
    write_bag2,
    write_mcap,
)

ARM = tuple(f"fr3_joint{i}" for i in range(1, 8))


def ramp(num: int, joints: int = 2) -> Float64:
    """Positions (T, J): joint k moves at (k + 1) rad/s from k."""
    t = np.arange(num) * 1e-9 * STEP_NS
    return np.stack([k + (k + 1) * t for k in range(joints)], axis=1)


def sent(topic: str, kind: str, given: Iterable[dict[str, Any]], store: Any = STORE) -> list[Message]:
    """One message a step, of these fields and a header with its stamp."""
    stamped = ((START_NS + i * STEP_NS, fields) for i, fields in enumerate(given))
    contents = ((stamp, built(kind, store, header=header(store, stamp), **fields)) for stamp, fields in stamped)
    return [Message(log_ns=stamp, topic=topic, type_name=kind, content=content) for stamp, content in contents]


def columns(source: RecordSource, joints: tuple[str, ...]) -> tuple[Float64, Float64]:
    """Positions and velocities (T, J) of joints."""
    order = [source.joint_names.index(name) for name in joints]
    found = states(source)
    return np.array([s.position for s in found])[:, order], np.array([s.velocity for s in found])[:, order]


def test_a_log_without_cameras_gives_its_states_and_says_why_it_has_no_frames(tmp_path: Path) -> None:
    q, v = ramp(30), np.full((30, 2), [1.0, 2.0])
    source = opened(write_mcap(tmp_path / "x.mcap", states_of(q, AB, velocity=v)))
    position, velocity = columns(source, AB)
    assert np.array_equal(position, q) and np.array_equal(velocity, v)
    assert [s.stamp_ns for s in states(source)] == [START_NS + i * STEP_NS for i in range(30)]
    assert ["no camera is used" in note for note in source.loss.notes] == [True]
    kinds = [type(record) for record in opened(make_log(tmp_path / "y.mcap"), ("joint_b", "joint_a")).records()]
    assert (kinds.count(RgbdFrame), kinds.count(JointState)) == (5, 5), "one with cameras gives both"


def test_joints_are_taken_by_name_in_whatever_order_a_message_has_them(tmp_path: Path) -> None:
    q, v = ramp(20), np.full((20, 2), [1.0, 2.0])
    messages = states_of(q, AB, velocity=v)
    turned = joint_state(messages[7].log_ns, ("b", "a"), q[7, ::-1], v[7, ::-1])
    messages[7] = replace(messages[7], content=turned)
    position, velocity = columns(opened(write_mcap(tmp_path / "x.mcap", messages)), AB)
    assert np.array_equal(position, q) and np.array_equal(velocity, v)


def test_joints_of_two_topics_are_brought_together_at_the_stamps_of_one(tmp_path: Path) -> None:
    q = ramp(40)
    late = [START_NS + i * STEP_NS + 3_000_000 for i in range(-1, 40)]
    other = np.array([[1 + 2 * ((s - START_NS) * 1e-9)] for s in late])
    messages = states_of(q[:, :1], ("a",), topic="/arm") + states_of(other, ("b",), topic="/wrist", stamps=late)
    source = opened(write_mcap(tmp_path / "x.mcap", messages))
    position, velocity = columns(source, AB)
    assert len(position) in {39, 40}
    assert position[:, 0] == pytest.approx(position[:, 1] / 2 - 0.5, abs=0.0025)
    assert velocity[5] == pytest.approx([1.0, 2.0], rel=1e-6)
    assert any("interpolated" in note for note in source.loss.notes)


def test_joints_of_alternating_messages_of_one_topic_are_brought_together(tmp_path: Path) -> None:
    q = ramp(40)
    halves = ({"name": (AB[i % 2],), "position": q[i, i % 2 : i % 2 + 1]} for i in range(40))
    source = opened(write_mcap(tmp_path / "x.mcap", sent("/js", JOINT_STATE, halves)))
    position = columns(source, AB)[0]
    assert len(position) == 19  # the first or last of either half has nothing to be interpolated between
    assert position[:, 1] == pytest.approx(1 + 2 * position[:, 0], abs=1e-9)
    assert any("1 of 20 states left out" in note for note in source.loss.notes)


def test_joints_of_topics_that_share_no_time_are_mixed_clocks(tmp_path: Path) -> None:
    early = [i * STEP_NS for i in range(1, 40)]
    messages = states_of(ramp(40)[:, :1], ("a",), topic="/arm")
    messages += states_of(ramp(39)[:, 1:], ("b",), topic="/wrist", stamps=early)
    message = refusal(write_mcap(tmp_path / "x.mcap", messages))
    assert "/arm and /wrist: mixed clocks: at no state of /arm is b known" in message
    assert "use one of: /arm, /wrist" in refusal(tmp_path / "x.mcap", joint_topic="/other")


@pytest.mark.parametrize(
    ("messages", "joints", "noted"),
    [
        (states_of(np.hstack([ramp(20), np.full((20, 1), np.nan)]), (*AB, "finger")), AB, ""),
        (states_of(ramp(20), AB) + states_of(ramp(3, 1), ("finger",), topic="/gripper"), AB, "not from /gripper"),
        (states_of(ramp(20), AB), (*AB, "c"), ""),
    ],
    ids=["NaN of a joint that nobody asked for", "another topic", "a joint that no topic has"],
)
def test_joints_that_nobody_asked_for_or_no_topic_has_do_no_harm(
    tmp_path: Path, messages: list[Message], joints: tuple[str, ...], noted: str
) -> None:
    source = opened(write_mcap(tmp_path / "x.mcap", messages), joints)
    assert (source.joint_names, len(states(source)), source.loss.damaged) == (AB, 20, 0)
    assert noted in "".join(source.loss.notes)


@pytest.mark.parametrize("is_new", [False, True])
def test_controller_states_give_positions_velocities_and_commands(tmp_path: Path, is_new: bool) -> None:
    store = store_with(control_msgs__JointTrajectoryControllerState=NEW_CONTROLLER if is_new else OLD_CONTROLLER)
    kind, q = "control_msgs/msg/JointTrajectoryControllerState", ramp(20)
    measured, wanted = ("feedback", "reference") if is_new else ("actual", "desired")
    motions = (({"positions": p, "velocities": [1.0, 2.0]}, {"positions": p, "velocities": [1.5, 2.5]}) for p in q)
    given = ({"joint_names": AB, measured: motion, wanted: command} for motion, command in motions)
    found = states(opened(write_bag2(tmp_path / "bag", sent("/controller/state", kind, given, store), store)))
    assert (len(found), found[3].position, found[3].velocity) == (20, pytest.approx(q[3]), pytest.approx([1.0, 2.0]))
    assert found[3].commanded_velocity == pytest.approx([1.5, 2.5])


SOME_POSE = pose_at([0.4, -0.1, 0.6], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])


def franka_1(store: Any, q: Float64) -> list[Message]:
    """Robot states without names of joints, the first without a pose."""
    poses = [np.zeros(16), *[SOME_POSE.T] * (len(q) - 1)]  # the 16 numbers of libfranka are columns
    rates = {"dq": np.arange(1.0, 8.0), "dq_d": np.arange(2.0, 9.0)}
    given = ({"q": row, "q_d": row, "O_T_EE": pose, **rates} for row, pose in zip(q, poses, strict=True))
    return sent("/franka_states", "franka_msgs/msg/FrankaState", given, store)


def test_a_ros_1_franka_state_without_names_is_taken_by_the_numbers_of_its_joints(tmp_path: Path) -> None:
    store, q = get_typestore(Stores.ROS1_NOETIC), ramp(20, 7)
    store.register(get_types_from_msg(FRANKA_STATE, "franka_msgs/msg/FrankaState"))
    source = opened(write_bag1(tmp_path / "x.bag", franka_1(store, q), store), ARM)
    found = states(source)
    assert (source.joint_names, found[0].T_base_ee) == (ARM, None)
    assert found[4].position == pytest.approx(q[4])
    assert found[4].velocity == pytest.approx(np.arange(1.0, 8.0))
    assert found[4].commanded_velocity == pytest.approx(np.arange(2.0, 9.0))
    assert found[4].T_base_ee == pytest.approx(SOME_POSE)
    for said in ("joint1 is fr3_joint1", "1 of 20 states have no valid end-effector pose"):
        assert any(said in note for note in source.loss.notes)


def test_fingers_of_another_topic_join_a_franka_state_without_names(tmp_path: Path) -> None:
    store, q = store_with(franka_msgs__FrankaState=FRANKA_STATE), ramp(20, 7)
    fingers = ("fr3_finger_joint1", "fr3_finger_joint2")
    gripper = states_of(np.full((20, 2), 0.04), fingers, topic="/gripper")
    source = opened(write_mcap(tmp_path / "x.mcap", franka_1(store, q) + gripper, store), (*ARM, *fingers))
    assert (source.joint_names, states(source)[5].position) == ((*ARM, *fingers), pytest.approx([*q[5], 0.04, 0.04]))


def franka_2(num: int) -> tuple[Any, list[Message]]:
    store, half = store_with(franka_msgs__FrankaRobotState=FRANKA_ROBOT_STATE), float(np.sqrt(0.5))
    pose = {"position": {"x": 0.4, "y": -0.1, "z": 0.6}, "orientation": {"z": half, "w": half}}
    given = (
        {
            "measured_joint_state": {"name": ARM, "position": row, "velocity": np.arange(1.0, 8.0)},
            "desired_joint_state": {"name": ARM, "position": row, "velocity": np.arange(2.0, 9.0)},
            "o_t_ee": {"pose": pose},
        }
        for row in ramp(num, 7)
    )
    return store, sent("/robot_state", "franka_msgs/msg/FrankaRobotState", given, store)


def test_a_franka_robot_state_of_ros_2_is_preferred_because_it_has_poses(tmp_path: Path) -> None:
    store, messages = franka_2(20)
    log = write_mcap(tmp_path / "x.mcap", messages + states_of(ramp(20, 7) + 0.01, ARM), store)
    found = states(opened(log, ARM))
    assert found[2].position == pytest.approx(ramp(20, 7)[2])
    assert found[2].commanded_velocity == pytest.approx(np.arange(2.0, 9.0))
    assert found[2].T_base_ee == pytest.approx(SOME_POSE)
    chosen = states(opened(log, ARM, joint_topic="/joint_states"))
    assert chosen[2].position == pytest.approx(ramp(20, 7)[2] + 0.01)


def test_a_type_that_the_log_does_not_define_is_said_and_is_no_damage(tmp_path: Path) -> None:
    store, messages = franka_2(5)
    bag = next(write_bag2(tmp_path / "bag", messages + states_of(ramp(20, 7), ARM), store).glob("*.db3"))
    with closing(sqlite3.connect(bag)) as base, base:
        base.execute("DELETE FROM message_definitions")
    source = opened(bag, ARM)
    assert (len(states(source)), source.loss.damaged) == (20, 0)
    assert any("no definition of franka_msgs/msg/FrankaRobotState" in note for note in source.loss.notes)


def test_a_planned_trajectory_alone_is_taken_as_motion(tmp_path: Path) -> None:
    kind = "trajectory_msgs/msg/JointTrajectory"
    points = [
        {"positions": row, "velocities": [1.0, 2.0], "time_from_start": {"nanosec": i * STEP_NS}}
        for i, row in enumerate(ramp(20))
    ]
    content = built(kind, header=header(STORE, 0), joint_names=AB, points=points)
    plan = Message(log_ns=START_NS, topic="/plan", type_name=kind, content=content)
    for options in ({}, {"stamps": "log"}):
        found = states(opened(write_mcap(tmp_path / "x.mcap", [plan]), **options))
        assert [s.stamp_ns for s in found] == [START_NS + i * STEP_NS for i in range(20)]
        assert found[3].position == pytest.approx(ramp(20)[3])


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([], "the log holds no messages"),
        (states_of(np.zeros((4, 0)), ()), "expected joint states, got none"),
        (states_of(np.full((3, 2), np.nan), AB), "expected joint states, got none"),
    ],
    ids=["nothing", "states without joints", "positions that are all NaN"],
)
def test_a_log_without_a_state_that_can_be_used_is_refused(
    tmp_path: Path, messages: list[Message], words: str
) -> None:
    assert words in refusal(write_mcap(tmp_path / "x.mcap", messages))
    message = refusal(make_log(tmp_path / "y.mcap", LogRecipe(has_joints=False, has_depth=False)))
    image = "/cam0/color/image_raw/compressed (sensor_msgs/msg/CompressedImage)"
    assert "expected joint states, got none" in message and image in message


def test_nan_positions_are_damage_and_nan_velocities_are_differences(tmp_path: Path) -> None:
    q, v = ramp(30), np.full((30, 2), [1.0, 2.0])
    q[4, 1], v[9, 0] = np.nan, np.nan
    source = opened(write_mcap(tmp_path / "x.mcap", states_of(q, AB, velocity=v)))
    assert columns(source, AB)[1] == pytest.approx(np.full((29, 2), [1.0, 2.0]))
    assert (source.loss.damaged, source.loss.differentiated_velocities) == (1, 1)
    assert any("velocities of a are missing or NaN in 1 states" in note for note in source.loss.notes)
    alone = opened(write_mcap(tmp_path / "y.mcap", states_of(ramp(1), AB)))
    velocity = states(alone)[0].velocity.tolist()
    assert (velocity, alone.loss.differentiated_velocities) == ([0, 0], 1), "a state alone stands still"


def test_stamps_that_go_back_or_repeat_or_pause_are_sorted_and_counted(tmp_path: Path) -> None:
    stamps = [START_NS + i * STEP_NS + (2_000_000_000 if i >= 15 else 0) for i in range(20)]
    stamps[5], stamps[6] = stamps[6], stamps[5]
    stamps[11] = stamps[10]
    q = np.stack([np.array([(s - START_NS) * 1e-9 for s in stamps])] * 2, axis=1)
    q[11] += 0.5
    source = opened(write_mcap(tmp_path / "x.mcap", states_of(q, AB, stamps=stamps)))
    found, loss = states(source), source.loss
    assert [s.stamp_ns for s in found] == sorted(set(stamps))
    assert all(s.position[0] == pytest.approx((s.stamp_ns - START_NS) * 1e-9) for s in found)
    assert (loss.unsorted_states, loss.duplicate_states, loss.state_gaps) == (1, 1, 1)
    for said in ("1 of them with other positions", "the longest 2.010 s"):
        assert any(said in note for note in loss.notes)


def test_a_real_log_gives_its_states_and_tells_a_velocity_that_nobody_filled(real_data: Path) -> None:
    joints = ("wrist_joint", "gripper_joint")
    source = opened(real_data / "rosbag2_mcap_sensor_msgs" / "rosbag2_2025_09_10-13_03_56_0.mcap", joints)
    assert (source.joint_names, len(states(source)), source.loss.damaged) == (joints, 15, 0)
    assert any("velocities of gripper_joint are zero throughout" in note for note in source.loss.notes)
