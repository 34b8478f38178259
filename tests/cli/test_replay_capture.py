"""Replaying a capture says what replaying its log says."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from splatctrl_cli.cli.main import main
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.records import JointState
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.sources.source import open_source
from splatctrl_cli.states.state_source import open_states
from tests.cli.replay_desk import BALL, START, splats_of, write_scene
from tests.logs.make_log import START_NS, LogRecipe, make_log
from tests.logs.make_states import NEW_CONTROLLER, Message, header, joint_state, store_with

pytestmark = pytest.mark.usefixtures("coverage_once", "without_plots")
NUM = 60  # states, every 10 ms
STORE = store_with(control_msgs__JointTrajectoryControllerState=NEW_CONTROLLER)
STATE, CONTROLLER = "sensor_msgs/msg/JointState", "control_msgs/msg/JointTrajectoryControllerState"


def arm_messages() -> list[Message]:
    """An arm whose joints 1 to 4 are in one topic, 5 to 7 in another at other times, and all commands in a third."""
    names = [f"joint{i}" for i in range(1, 8)]
    messages = []
    for i in range(NUM):
        stamp = START_NS + i * 10_000_000
        q = START + 0.3 * np.sin(0.5 * i * 0.01 + np.arange(7))
        messages += [
            Message(log_ns=stamp, topic="/left", type_name=STATE, content=joint_state(stamp, names[:4], q[:4])),
            Message(
                log_ns=stamp + 4_000_000,
                topic="/right",
                type_name=STATE,
                content=joint_state(stamp + 4_000_000, names[4:], q[4:]),
            ),
        ]
        if i % 7 == 0:
            messages.append(
                Message(log_ns=stamp, topic="/left", type_name=STATE, content=joint_state(stamp, ["finger"], [0.0]))
            )
    return messages


def controller_messages() -> list[Message]:
    """A controller that reports all joints, with what it was asked for."""
    names = [f"joint{i}" for i in range(1, 8)]
    point, kind = STORE.types["trajectory_msgs/msg/JointTrajectoryPoint"], STORE.types[CONTROLLER]
    nothing = np.zeros(0)
    since = STORE.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)

    def at(position: Any, velocity: Any = nothing) -> Any:
        return point(
            positions=position,
            velocities=velocity,
            accelerations=nothing,
            effort=nothing,
            time_from_start=since,
        )

    messages = []
    for i in range(NUM):
        stamp = START_NS + i * 10_000_000 + 1_000_000
        q = START + 0.3 * np.sin(0.5 * i * 0.01 + np.arange(7))
        content = kind(
            header=header(STORE, stamp),
            joint_names=names,
            feedback=at(q, 0.01 * q),
            reference=at(q, 0.02 * q),
            **{name: at(nothing) for name in ("error", "output", "desired", "actual")},
        )
        messages.append(Message(log_ns=stamp, topic="/controller", type_name=CONTROLLER, content=content))
    return messages


def log_with(path: Path, messages: Sequence[Message]) -> Path:
    """A log of a camera, with these messages beside its own."""
    plain = make_log(path.with_name("plain.mcap"), LogRecipe(has_joints=False, num_frames=6))
    with plain.open("rb") as source, path.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="tests")
        channels: dict[str, int] = {}

        def add(topic: str, kind: str, text: bytes, log_ns: int, data: bytes) -> None:
            if topic not in channels:
                schema = writer.register_schema(name=kind, encoding="ros2msg", data=text)
                channels[topic] = writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema)
            writer.add_message(channels[topic], log_time=log_ns, publish_time=log_ns, data=data)

        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            add(channel.topic, schema.name, schema.data, message.log_time, message.data)
        for item in messages:
            text, _ = STORE.generate_msgdef(item.type_name, ros_version=2)
            data = bytes(STORE.serialize_cdr(item.content, item.type_name))
            add(item.topic, item.type_name, text.encode(), item.log_ns, data)
        writer.finish()
    return path


def replayed(source: Path, arm_files: list[str], out: Path, *options: str) -> tuple[bytes, dict[str, Any], Any]:
    scene = out.parent / "scene"
    if not scene.exists():
        write_scene(scene, (START_NS, splats_of(BALL)))
    words = ["replay", str(source), *arm_files, "--scene", str(scene), "-o", str(out), "-q", "--max-unknown", "1"]
    assert main([*words, "--report-only", *options]) == 0
    summary = json.loads((out / "summary.json").read_text())
    return (out / "steps.csv").read_bytes(), summary["metrics"], json.loads((out / "states.json").read_text())


@pytest.fixture
def arm_files(sample_data: Path) -> list[str]:
    tabletop = sample_data / "tabletop"
    return ["--urdf", str(tabletop / "robot.urdf"), "--spheres", str(tabletop / "robot_spheres.yaml")]


@pytest.mark.parametrize("kind", ["two-topics", "all", "chosen"])
def test_a_capture_is_replayed_as_its_log(tmp_path: Path, arm_files: list[str], kind: str) -> None:
    messages = arm_messages() + ([] if kind == "two-topics" else controller_messages())
    log, capture = log_with(tmp_path / "log.mcap", messages), tmp_path / "x.capture"
    assert main(["ingest", str(log), "-o", str(capture), "-q"]) == 0
    options = ["--mode", "open-loop", *(["--joint-topic", "/controller"] if kind == "chosen" else [])]
    steps, metrics, states = replayed(log, arm_files, tmp_path / "of_log", *options)
    assert metrics["num_states"] == (NUM - 1 if kind == "two-topics" else NUM)
    again = replayed(capture, arm_files, tmp_path / "of_capture", *options)
    assert again == (steps, metrics, states)
    assert any("interpolated" in note for note in states["loss"]["notes"]) == (kind == "two-topics")


def test_a_topic_that_was_chosen_while_ingesting_is_that_of_the_replay(tmp_path: Path, arm: RobotModel) -> None:
    log, capture = log_with(tmp_path / "log.mcap", [*arm_messages(), *controller_messages()]), tmp_path / "x.capture"
    assert main(["ingest", str(log), "-o", str(capture), "-q", "--joint-topic", "/left"]) == 0
    assert open_states(capture, SourceOptions(), arm.joint_names).joint_names == arm.joint_names[:4]
    chosen = SourceOptions(joint_topic="/controller")
    assert open_states(capture, chosen, arm.joint_names).joint_names == arm.joint_names


def test_a_capture_keeps_commands_and_they_can_be_read_plainly(tmp_path: Path, arm: RobotModel) -> None:
    log, capture = log_with(tmp_path / "log.mcap", controller_messages()), tmp_path / "x.capture"
    assert main(["ingest", str(log), "-o", str(capture), "-q"]) == 0
    for source in (open_states(capture, SourceOptions(), arm.joint_names), open_source(capture)):
        states = [record for record in source.records() if isinstance(record, JointState)]
        assert len(states) == NUM
        for state in states:
            assert state.commanded_velocity is not None
            np.testing.assert_allclose(state.commanded_velocity, 0.02 * state.position)
    kept = np.load(capture / "joint_topics" / "0" / "commanded_velocity.npy")
    assert kept.shape == (NUM, 7)
    assert "commanded_velocity" in np.load(capture / "joints.npz").files
    sums = (capture / "SHA256SUMS").read_text()
    assert "  joint_topics/0/commanded_velocity.npy\n" in sums


def test_a_damaged_topic_is_refused_and_an_old_capture_is_read(
    tmp_path: Path, arm_files: list[str], arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    log, capture = log_with(tmp_path / "log.mcap", controller_messages()), tmp_path / "x.capture"
    assert main(["ingest", str(log), "-o", str(capture), "-q"]) == 0
    file = capture / "joint_topics" / "0" / "position.npy"
    content = file.read_bytes()
    file.write_bytes(content[:-8] + b"\0" * 8)
    assert main(["replay", str(capture), *arm_files, "--scene", str(tmp_path / "scene")]) == 4
    assert "position.npy: missing, or its checksum differs" in capsys.readouterr().err
    old = as_of_old(capture)
    assert replayed(old, arm_files, tmp_path / "out")[1]["num_states"] == NUM
    assert main(["replay", str(old), *arm_files, "--scene", str(tmp_path / "scene"), "--joint-topic", "/x"]) == 4
    assert "--joint-topic does not apply" in capsys.readouterr().err


def as_of_old(capture: Path) -> Path:
    """The capture as it was written before topics were kept."""
    import hashlib
    import shutil

    shutil.rmtree(capture / "joint_topics")
    document = json.loads((capture / "capture.json").read_text())
    del document["joint_topics"]
    (capture / "capture.json").write_text(json.dumps(document))
    states = dict(np.load(capture / "joints.npz"))
    np.savez(capture / "joints.npz", **{name: states[name] for name in ("stamp_ns", "position", "velocity")})
    lines = []
    for line in (capture / "SHA256SUMS").read_text().splitlines():
        name = line[66:]
        if not name.startswith("joint_topics/"):
            lines.append(f"{hashlib.sha256((capture / name).read_bytes()).hexdigest()}  {name}\n")
    (capture / "SHA256SUMS").write_text("".join(lines))
    return capture
