"""What replay says of the states of a log or capture: their kinds, losses and faults, fit to robot and cameras."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import Box, Float64, JointState
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import BALL, START, Desk, splats_of, write_field, write_scene
from tests.recording.log.make_log import LogRecipe, encoded, make_log, messages_of, write_raw
from tests.recording.log.make_states import (
    NEW_CONTROLLER,
    START_NS,
    Message,
    header,
    joint_state,
    states_of,
    store_with,
    write_mcap,
)
from tests.robot.shapes import written

JOINTS = tuple(f"joint{i}" for i in range(1, 8))


def moving(num: int = 30) -> Float64:
    """Postures (T, 7) near START."""
    return np.asarray(START + 0.3 * np.sin(np.linspace(0, 2, num)[:, None] * np.arange(1, 8)))


@pytest.fixture
def scene(desk: Desk) -> str:
    return str(write_scene(desk.folder / "scene", (0, splats_of(BALL))))


def replayed(desk: Desk, scene: str, log: Path, *more: str) -> int:
    arguments = ["replay", str(log), *desk.robot, "--scene", scene, "-o", str(desk.folder / "out"), *more]
    return main([*arguments, "--max-unknown", "1", "--report-only"])


def test_a_log_of_the_robot_alone_is_audited(desk: Desk, scene: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert replayed(desk, scene, write_mcap(desk.folder / "x.mcap", states_of(moving(), JOINTS))) == 0
    said = capsys.readouterr().out
    assert "log: no camera is used" in said and "log: /joint_states: no velocities recorded" in said
    found = desk.json("states.json")
    assert (found["num_states"], found["loss"]["differentiated_velocities"]) == (30, 30)
    assert (found["end_effector_poses"], found["clock_offset"]) == (None, None)


def test_a_state_alone_is_replayed(desk: Desk, scene: str) -> None:
    assert replayed(desk, scene, write_mcap(desk.folder / "x.mcap", states_of(moving(1), JOINTS)), "-q") == 0
    assert len(desk.rows()) == 1


def test_logged_end_effector_poses_are_compared_with_the_robot(
    desk: Desk, scene: str, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    q, link = moving(), arm.frame_names[-1]
    rows = [
        ",".join(repr(float(v)) for v in (i * 0.01, *row, *T[:3, 3], *quat_from_rotation(T[:3, :3])))
        for i, (row, T) in enumerate((row, arm.frame_pose(row, link)) for row in q)
    ]
    names = [f"q{i}" for i in range(7)]
    pose = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    (desk.folder / "run.csv").write_text("\n".join([",".join(["t", *names, *pose]), *rows]))

    def described(joints: Sequence[str]) -> Path:
        table = {"file": "run.csv", "joints": list(joints), "time": "t", "position": names, "pose": pose}
        return written(
            desk.folder, "\n".join(["[states]", *(f"{key} = {table[key]!r}" for key in table)]), "run.toml"
        )

    assert replayed(desk, scene, described(JOINTS)) == 0
    assert f"log: 30 logged end-effector poses agree with {link}: median 0.00 mm" in capsys.readouterr().out
    found = desk.json("states.json")["end_effector_poses"]
    assert found["verdict"] == "agree" and found["difference"]["max_position"] < 1e-9
    assert replayed(desk, scene, described(JOINTS[::-1]), "--force") == 0
    assert "wrong URDF, joint order, or units?" in capsys.readouterr().out


def test_joints_in_degrees_are_refused_in_one_line(
    desk: Desk, scene: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replayed(desk, scene, write_mcap(desk.folder / "x.mcap", states_of(np.degrees(moving()), JOINTS))) == 4
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "would fit as degrees; record radians (REP 103)" in line


def test_a_posture_outside_the_limits_is_an_event_with_its_joint(desk: Desk, scene: str) -> None:
    q = np.repeat(START[None], 10, axis=0)
    q[4:7, 3] = 0.5  # its limit is below 0
    assert replayed(desk, scene, write_mcap(desk.folder / "x.mcap", states_of(q, JOINTS)), "-q") == 0
    assert desk.verdict()["label"] == "limits broken"
    (outside,) = [event for event in desk.json("events.json")["events"] if event["kind"] == "outside-limits"]
    assert (outside["worst_name"], outside["num_states"]) == ("joint4", 3) and outside["worst"] < -0.5


@pytest.mark.parametrize("mode", ["audit", "closed-loop"])
def test_a_grid_without_the_robot_is_refused_by_where_both_are(
    desk: Desk, capsys: pytest.CaptureFixture[str], tmp_path: Path, mode: str
) -> None:
    box = Box(lower=np.array([3.0, 3.0, 0.0]), upper=np.array([3.4, 3.4, 0.4]))
    field = write_field(tmp_path / "field", BALL, box=box, voxel=0.1)
    assert desk.replay("--field", str(field), "-q", "--mode", mode, "--max-unknown", "1") == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert "--field: expected the robot in the grid from (3.00, 3.00, 0.00) to (" in line
    assert "moving spheres outside it, the nearest by 2." in line and "check --base" in line


def test_a_table_whose_clock_jumps_is_refused_in_one_line(
    desk: Desk, scene: str, capsys: pytest.CaptureFixture[str]
) -> None:
    times = 0.001 * np.arange(10)
    times[6:] += 1.7e9
    np.savez(desk.folder / "x.npz", t=times, q=np.repeat(START[None], 10, axis=0))
    text = f'[states]\nfile = "x.npz"\njoints = {list(JOINTS)}\ntime = "t"\nposition = ["q"]\n'
    assert replayed(desk, scene, written(desk.folder, text, "x.toml")) == 4
    *_, line = capsys.readouterr().err.splitlines()
    assert "joint states: mixed clocks: stamps jump by 1700000000 s at state 6 of 10; cut the log there" in line


NUM_STATES = 60  # states, every 10 ms
STORE = store_with(control_msgs__JointTrajectoryControllerState=NEW_CONTROLLER)
STATE, CONTROLLER = "sensor_msgs/msg/JointState", "control_msgs/msg/JointTrajectoryControllerState"


def postures() -> list[tuple[int, Float64]]:
    """Stamps and postures of a motion."""
    return [
        (START_NS + i * 10_000_000, START + 0.3 * np.sin(0.5 * i * 0.01 + np.arange(7))) for i in range(NUM_STATES)
    ]


def arm_messages() -> list[Message]:
    """An arm whose joints 1 to 4 are in one topic, 5 to 7 in another at other times, and all commands in a third."""

    def said(stamp: int, topic: str, names: Sequence[str], q: Sequence[float] | Float64) -> Message:
        return Message(log_ns=stamp, topic=topic, type_name=STATE, content=joint_state(stamp, names, q))

    messages = []
    for i, (stamp, q) in enumerate(postures()):
        messages += [said(stamp, "/left", JOINTS[:4], q[:4]), said(stamp + 4_000_000, "/right", JOINTS[4:], q[4:])]
        messages += [said(stamp, "/left", ["finger"], [0.0])] if i % 7 == 0 else []
    return messages


def controller_messages() -> list[Message]:
    """A controller that reports all joints, with what it was asked for."""
    point, kind = STORE.types["trajectory_msgs/msg/JointTrajectoryPoint"], STORE.types[CONTROLLER]
    since = STORE.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
    nothing = np.zeros(0)

    def at(position: Any, velocity: Any = nothing) -> Any:
        rest = {"accelerations": nothing, "effort": nothing, "time_from_start": since}
        return point(positions=position, velocities=velocity, **rest)

    messages = []
    for stamp, q in postures():
        content = kind(
            header=header(STORE, stamp + 1_000_000),
            joint_names=list(JOINTS),
            feedback=at(q, 0.01 * q),
            reference=at(q, 0.02 * q),
            **{name: at(nothing) for name in ("error", "output", "desired", "actual")},
        )
        messages.append(Message(log_ns=stamp + 1_000_000, topic="/controller", type_name=CONTROLLER, content=content))
    return messages


def log_with(path: Path, messages: Sequence[Message]) -> Path:
    """A log of a camera, with these messages beside its own."""
    plain = make_log(path.with_name("plain.mcap"), LogRecipe(has_joints=False, num_frames=6))
    beside = [encoded(item.log_ns, item.topic, item.content, STORE) for item in messages]
    return write_raw(path, [*messages_of(plain), *beside])


def ingested(folder: Path, messages: Sequence[Message], *options: str) -> tuple[Path, Path]:
    """A log with these messages, and its capture."""
    log, capture = log_with(folder / "log.mcap", messages), folder / "x.capture"
    assert main(["ingest", str(log), "-o", str(capture), "-q", *options]) == 0
    return log, capture


def audited(source: Path, desk: Desk, out: Path, *options: str) -> tuple[bytes, dict[str, Any], Any]:
    scene = out.parent / "scene"
    if not scene.exists():
        write_scene(scene, (START_NS, splats_of(BALL)))
    words = ["replay", str(source), *desk.robot, "--scene", str(scene), "-o", str(out), "-q", "--max-unknown", "1"]
    assert main([*words, "--report-only", *options]) == 0
    summary = json.loads((out / "summary.json").read_text())
    return (out / "steps.csv").read_bytes(), summary["metrics"], json.loads((out / "states.json").read_text())


@pytest.mark.parametrize("kind", ["two-topics", "all", "chosen"])
def test_a_capture_is_replayed_as_its_log(tmp_path: Path, desk: Desk, kind: str) -> None:
    messages = arm_messages() + ([] if kind == "two-topics" else controller_messages())
    log, capture = ingested(tmp_path, messages)
    options = ["--mode", "open-loop", *(["--joint-topic", "/controller"] if kind == "chosen" else [])]
    steps, metrics, states = audited(log, desk, tmp_path / "of_log", *options)
    assert metrics["num_states"] == (NUM_STATES - 1 if kind == "two-topics" else NUM_STATES)
    assert audited(capture, desk, tmp_path / "of_capture", *options) == (steps, metrics, states)
    assert any("interpolated" in note for note in states["loss"]["notes"]) == (kind == "two-topics")


def test_a_topic_that_was_chosen_while_ingesting_is_that_of_the_replay(tmp_path: Path, arm: RobotModel) -> None:
    _, capture = ingested(tmp_path, [*arm_messages(), *controller_messages()], "--joint-topic", "/left")
    assert open_states(capture, SourceOptions(), arm.joint_names).joint_names == arm.joint_names[:4]
    chosen = SourceOptions(joint_topic="/controller")
    assert open_states(capture, chosen, arm.joint_names).joint_names == arm.joint_names


def test_a_capture_keeps_commands_and_they_can_be_read_plainly(tmp_path: Path, arm: RobotModel) -> None:
    _, capture = ingested(tmp_path, controller_messages())
    for source in (open_states(capture, SourceOptions(), arm.joint_names), open_source(capture)):
        states = [record for record in source.records() if isinstance(record, JointState)]
        assert len(states) == NUM_STATES
        commanded, positions = zip(*((state.commanded_velocity, state.position) for state in states), strict=True)
        np.testing.assert_allclose(commanded, 0.02 * np.array(positions))
    assert np.load(capture / "joint_topics" / "0" / "commanded_velocity.npy").shape == (NUM_STATES, 7)
    assert "commanded_velocity" in np.load(capture / "joints.npz").files
    assert "  joint_topics/0/commanded_velocity.npy\n" in (capture / "SHA256SUMS").read_text()


def test_a_damaged_topic_is_refused_and_an_old_capture_is_read(
    tmp_path: Path, desk: Desk, capsys: pytest.CaptureFixture[str]
) -> None:
    _, capture = ingested(tmp_path, controller_messages())
    file = capture / "joint_topics" / "0" / "position.npy"
    file.write_bytes(file.read_bytes()[:-8] + b"\0" * 8)
    scene = [*desk.robot, "--scene", str(tmp_path / "scene")]
    assert main(["replay", str(capture), *scene]) == 4
    assert "position.npy: missing, or its checksum differs" in capsys.readouterr().err
    make_old(capture)
    assert audited(capture, desk, tmp_path / "out")[1]["num_states"] == NUM_STATES
    assert main(["replay", str(capture), *scene, "--joint-topic", "/x"]) == 4
    assert "--joint-topic does not apply" in capsys.readouterr().err


def make_old(capture: Path) -> None:
    """Make the capture one that was written before topics and commands were kept."""
    document = json.loads((capture / "capture.json").read_text())
    del document["joint_topics"]
    (capture / "capture.json").write_text(json.dumps(document))
    states = np.load(capture / "joints.npz")
    np.savez(capture / "joints.npz", **{name: states[name] for name in ("stamp_ns", "position", "velocity")})
    names = [line[66:] for line in (capture / "SHA256SUMS").read_text().splitlines() if "joint_topics/" not in line]
    sums = [f"{hashlib.sha256((capture / name).read_bytes()).hexdigest()}  {name}\n" for name in names]
    (capture / "SHA256SUMS").write_text("".join(sums))
