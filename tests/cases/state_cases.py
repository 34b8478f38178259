"""Joint states of other drivers: what a robot is taken to have done."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.recording.log.decoder import JOINT_STATE
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from tests.cases.case import Case, Run, expect_result
from tests.recording.log.make_log import START_NS, built, encoded, header, write_raw
from tests.refused import expect_refusal

PERIOD_NS = 20_000_000

State = tuple[int, str, Sequence[str], Float64, Float64]  # stamp [ns], topic, names, positions, velocities

ARM = ("shoulder", "elbow")


def urdf(joints: Sequence[tuple[str, str, str]]) -> str:
    """A chain of joints: name, type, and what else stands in the element."""
    links = "".join(
        f'<link name="l{i}"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>'
        for i in range(len(joints) + 1)
    )
    limit = '<limit lower="-3" upper="3" velocity="2" effort="9"/>'
    chain = "".join(
        f'<joint name="{name}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/><axis xyz="0 0 1"/>'
        f'<origin xyz="0.3 0 0"/>{limit}{more}</joint>'
        for i, (name, kind, more) in enumerate(joints)
    )
    return f'<robot name="r">{links}{chain}</robot>'


def log(states: Iterator[State], joints: Sequence[tuple[str, str, str]] = ()) -> Callable[[Path], None]:
    """Writes log.mcap and r.urdf."""
    kept = sorted(states, key=lambda state: state[0])

    def make(folder: Path) -> None:
        messages = []
        for stamp, topic, names, position, velocity in kept:
            content = built(JOINT_STATE, header=header(stamp), name=names, position=position, velocity=velocity)
            messages.append(encoded(stamp, topic, content))
        write_raw(folder / "log.mcap", messages)
        (folder / "r.urdf").write_text(urdf(joints or [(name, "revolute", "") for name in ARM]), encoding="utf-8")

    return make


def each(
    num: int, topic: str, names: Sequence[str], q: Callable[[float], Sequence[float]], late_ns: int = 0
) -> Iterator[State]:
    """States of positions by seconds, without velocities."""
    for i in range(num):
        stamp = START_NS + i * PERIOD_NS + late_ns
        yield stamp, topic, names, np.array(q(i * PERIOD_NS * 1e-9), dtype=np.float64), np.zeros(0)


def read(folder: Path, topic: str | None = None, name: str = "*.mcap") -> tuple[RobotModel, StateColumns, list[str]]:
    """The robot, its states in its own order, and what was noted."""
    path = sorted(folder.glob(name))[-1]
    model = RobotModel.from_urdf(next(folder.glob("*.urdf")))
    source = open_states(path, SourceOptions(joint_topic=topic), model.joint_names)
    model = model.moved_by(source.joint_names)
    return model, source.states.convert_joints(*model.joint_columns(source.joint_names)), list(source.loss.notes)


def checked(folder: Path, run: Run, *words: str) -> None:
    """`check` says this of the joint states."""
    robot = ["--urdf", *folder.glob("*.urdf")]
    result = run(["check", sorted(folder.glob("*.mcap"))[-1], *(robot if len(robot) > 1 else ())])
    assert all(word in result.text for word in words), result.text


def two_robots(folder: Path, out: Path, run: Run) -> None:
    """Refused with both topics; each can be chosen, and gives other positions."""
    path = sorted(folder.glob("*a-and-b.mcap"))[-1]
    topics = [f"/robot_{name}/joint_states" for name in "ab"]
    expect_result(run, ["check", path], *(f"--joint-topic {topic}" for topic in topics), code=1)
    names = [f"joint{i}" for i in range(1, 8)]
    expect_refusal("both have joint1", open_states, path, SourceOptions(), names)
    a, b = (open_states(path, SourceOptions(joint_topic=topic), names).states for topic in topics)
    assert np.abs(a.position[:40] - b.position[:40]).max() > 0.1


def arms(a: str, b: str, apart: float, num_b: int = 100) -> Callable[[Path], None]:
    """Two topics with seven joints each."""
    names = [f"joint{i}" for i in range(1, 8)]

    def make(folder: Path) -> None:
        one = each(100, a, names, lambda t: [0.3 * t] * 7)
        two = each(num_b, b, names, lambda t: [0.3 * t + apart] * 7, late_ns=3_000_000)
        log(iter([*one, *two]))(folder)
        (folder / "log.mcap").rename(folder / "a-and-b.mcap")

    return make


def taken_from(topic: str) -> Callable[[Path, Path, Run], None]:
    """Not refused; this topic is taken, and the other one named."""

    def examine(folder: Path, out: Path, run: Run) -> None:
        source = open_states(next(folder.glob("*.mcap")), SourceOptions(), [f"joint{i}" for i in range(1, 8)])
        assert len(source.states) and any(f"taken from {topic}, not from" in note for note in source.loss.notes)

    return examine


def both_fingers(folder: Path, out: Path, run: Run) -> None:
    """The joint that the log lacks follows its leader."""
    model, states, _ = read(folder)
    leader, follower = (model.joint_names.index(f"{side}finger_joint") for side in ("", "right_"))
    mimic = next(joint.mimic for joint in model.urdf.joints if joint.name == "right_finger_joint")
    q, v = states.position[: len(states)], states.velocity[: len(states)]
    assert np.ptp(q[:, leader]) > 0.1
    np.testing.assert_allclose(q[:, follower], mimic[1] * q[:, leader] + mimic[2], atol=1e-12)
    np.testing.assert_allclose(v[:, follower], mimic[1] * v[:, leader], atol=1e-9)
    assert "--lock" not in run(["check", next(folder.glob("*.mcap")), "--urdf", next(folder.glob("*.urdf"))]).text


def runs_on(folder: Path, out: Path, run: Run) -> None:
    """A joint that turns at 0.5 rad/s is not faster where its position is counted from the other end."""
    _, states, notes = read(folder, name="*wrap*.mcap")
    assert np.abs(np.diff(states.position[: len(states)][:, 0])).max() < 0.05
    assert np.abs(states.velocity[: len(states)][:, 0]).max() < 0.6
    assert any("whole turn" in note for note in notes)
    checked(folder, run, "whole turn")


def turns(first: float, low: float, speed: float) -> Callable[[Path], None]:
    """A continuous joint from `first` on, its position counted from `low` on."""

    def q(t: float) -> Sequence[float]:
        return [low + (first + speed * t - low) % (2 * np.pi), 0.1 * t]

    def make(folder: Path) -> None:
        log(each(100, "/joint_states", ARM, q), [("shoulder", "continuous", ""), ("elbow", "revolute", "")])(folder)
        (folder / "log.mcap").rename(folder / "wrapped.mcap")

    return make


def positions_used(folder: Path, out: Path, run: Run) -> None:
    """Velocities of another number than names are left out, with a note; positions are used."""
    path, urdfs = next(folder.glob("*.mcap")), next(folder.glob("*.urdf"))
    result = run(["check", path, "--urdf", urdfs])
    assert "names with 2 velocities, which are not used" in result.text and "damaged" not in result.text
    assert "cannot start, or would be wrong: replay" not in result.text
    assert len(read(folder)[1]) == 100


def not_evaluable(folder: Path, out: Path, run: Run) -> None:
    """Two publishers are named, by `check` and to whoever asks for the robot's states."""
    checked(
        folder,
        run,
        "two publishers take turns",
        "cannot start, or would be wrong: replay",
    )
    model = RobotModel.from_urdf(next(folder.glob("*.urdf")))
    expect_refusal(
        "two publishers take turns",
        lambda: open_states(next(folder.glob("*.mcap")), SourceOptions(), model.joint_names),
        error=NotEvaluableError,
    )


def mixed(*streams: Iterator[State]) -> Callable[[Path], None]:
    """States of several publishers on one topic."""
    return log(iter([state for stream in streams for state in stream]))


def renamed(words: str) -> Callable[[Path, Path, Run], None]:
    """Joints under a prefix are the robot's, which is said."""

    def examine(folder: Path, out: Path, run: Run) -> None:
        _, states, notes = read(folder)
        assert states.position[99] == pytest.approx([0.99 * 0.6, -0.99 * 0.6], abs=0.02)
        assert any(words in note for note in notes), notes

    return examine


def normalised(folder: Path, out: Path, run: Run) -> None:
    """Numbers of LeRobot are not called degrees to be converted by a factor."""
    result = run(["check", folder / "log.mcap"])
    assert "LeRobot's numbers are -100 to 100" in result.text and "unit =" not in result.text


def asks_for_urdf(folder: Path, out: Path, run: Run) -> None:
    """Two arms under prefixes fit one robot: nothing is guessed, and --lock is no remedy."""
    model = RobotModel.from_urdf(folder / "r.urdf")
    source = open_states(folder / "log.mcap", SourceOptions(), model.joint_names)
    expect_refusal(r"left_shoulder.*; give the URDF of the robot", model.joint_columns, source.joint_names)


def swing(t: float) -> Sequence[float]:
    return [0.3 * t, -0.3 * t]


FINGERS = (
    ("shoulder", "revolute", ""),
    ("finger_joint", "prismatic", ""),
    ("right_finger_joint", "prismatic", '<mimic joint="finger_joint" multiplier="-0.5" offset="0.01"/>'),
)

LEFT = (("left_shoulder", "revolute", ""), ("left_elbow", "revolute", ""))

BOTH = ("left_shoulder", "left_elbow", "right_shoulder", "right_elbow")

LEADER = ("shoulder", "finger_joint")

CASES: tuple[Case, ...] = (
    Case(
        name="03-two-robots-same-joints", make=arms("/robot_a/joint_states", "/robot_b/joint_states", 0.6),
        examine=two_robots, has_shared=True,
    ),
    Case(
        name="more-messages-decide-nothing",
        make=arms("/robot_a/joint_states", "/robot_b/joint_states", 0.6, num_b=40), examine=two_robots,
    ),
    Case(
        name="the-same-states-again", make=arms("/joint_states", "/relayed/joint_states", 0.001),
        examine=taken_from("/joint_states"),
    ),
    Case(
        name="commands-are-no-rival", make=arms("/arm/joint_states", "/arm/joint_commands", 0.3),
        examine=taken_from("/arm/joint_states"),
    ),
    Case(
        name="05-mimic-leader-only",
        make=log(each(100, "/joint_states", LEADER, lambda t: [0.3 * t, 0.1 * t]), FINGERS), examine=both_fingers,
        has_shared=True,
    ),
    Case(name="06-continuous-wrap", make=turns(2.6, -np.pi, 0.5), examine=runs_on, has_shared=True),
    Case(name="wrap-from-zero-to-two-pi", make=turns(5.8, 0.0, 0.5), examine=runs_on),
    Case(name="wrap-backwards", make=turns(-2.6, -np.pi, -0.5), examine=runs_on),
    Case(
        name="32-jointstate-velocity-length",
        make=log(
            (stamp, topic, names, q, np.ones(2))
            for stamp, topic, names, q, _ in each(100, "/joint_states", (*ARM, "a", "b"), lambda t: [*swing(t), 0, 0])
        ),
        examine=positions_used, has_shared=True,
    ),
    Case(
        name="39-two-publishers-joint-states",
        make=mixed(
            each(100, "/joint_states", ARM, lambda t: [0.5 + t, -0.5]),
            each(50, "/joint_states", ARM, lambda t: [0, 0], late_ns=7_000_000),
        ),
        examine=not_evaluable, has_shared=True,
    ),
    Case(
        name="two-publishers-of-one-rate",
        make=mixed(
            each(100, "/joint_states", ARM, lambda t: [0.5 + t, -0.5]),
            each(100, "/joint_states", ARM, lambda t: [0.2, 0.4], late_ns=9_000_000),
        ),
        examine=not_evaluable,
    ),
    Case(
        name="prefix-in-the-log", make=log(each(100, "/joint_states", ("ur_shoulder", "ur_elbow"), swing)),
        examine=renamed("joint names differ by a prefix: ur_shoulder is shoulder"),
    ),
    Case(
        name="prefix-in-the-urdf",
        make=log(each(100, "/joint_states", ARM, swing), LEFT),
        examine=renamed("joint names differ by a prefix: shoulder is left_shoulder"),
    ),
    Case(
        name="normalised-by-lerobot",
        make=log(each(100, "/joint_states", ("shoulder.pos", "elbow.pos"), lambda t: [-90 + 80 * t, 90 - 80 * t])),
        examine=normalised,
    ),
    Case(
        name="two-prefixes-in-the-log",
        make=log(
            each(100, "/joint_states", BOTH, lambda t: [t] * 4)
        ),
        examine=asks_for_urdf,
    ),
)  # fmt: skip
