"""The robot that a log describes itself stands in for --urdf, and a model that differs from it is said."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.check import CheckRequest, IngestRequest, check, ingest
from splatctrl_cli.jobs.reconstruct.reconstruct import _robot
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.replay.inputs import open_log
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.report.spaces import robot_of, space_of
from splatctrl_cli.jobs.robot.logged_robot import differs, logged_urdf, urdf_of
from splatctrl_cli.jobs.runs.run_folder import open_run
from splatctrl_cli.recording.capture.capture import is_capture
from splatctrl_cli.recording.container.raw_log import RawMessage
from splatctrl_cli.recording.source import describe, open_source
from splatctrl_cli.robot.urdf import read_urdf
from tests.jobs.bake.baked import Said
from tests.jobs.stage import Stage
from tests.recording.log.make_log import (
    START_NS,
    STORE,
    LogRecipe,
    built,
    encoded,
    make_log,
    messages_of,
    transform,
    write_bag,
    write_raw,
)
from tests.recording.log.make_states import joint_state
from tests.recording.state.test_state_files import lerobot
from tests.refused import expect_refusal
from tests.robot.shapes import written

BALL = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'


def robot(
    *, shift: float = 0.2, upper: float = 1.0, first: str = "joint_a", shape: str = BALL, root: str = "world"
) -> str:
    """Two hinges named as those of `make_log`, in whose world the root is, each link with a ball unless another shape
    is given.
    """
    limit = f'<limit lower="-1" upper="{upper}" velocity="1" effort="1"/>'
    links = "".join(f'<link name="{name}">{shape}</link>' for name in (root, "arm", "tip"))
    return f"""<robot name="r">{links}
<joint name="{first}" type="revolute"><parent link="{root}"/><child link="arm"/><axis xyz="0 1 0"/>{limit}</joint>
<joint name="joint_b" type="revolute"><parent link="arm"/><child link="tip"/><origin xyz="0 0 {shift}"/>
<axis xyz="0 1 0"/>{limit}</joint></robot>"""


def described(text: str, topic: str = "/robot_description", *, ros: int = 2) -> RawMessage:
    store = STORE if ros == 2 else get_typestore(Stores.ROS1_NOETIC)
    return encoded(START_NS, topic, store.types["std_msgs/msg/String"](data=text), store, ros=ros)


def as_parameter(text: str, kind: int = 4) -> RawMessage:
    """As a node says it when it starts (rcl_interfaces)."""
    T: Any = STORE.types
    fields: dict[str, Any] = {
        **{"type": kind, "bool_value": False, "integer_value": 0, "double_value": 0.0, "string_value": text},
        **dict.fromkeys(["integer_array_value"], np.zeros(0, np.int64)),
        **{"byte_array_value": np.zeros(0, np.uint8), "double_array_value": np.zeros(0)},
        **{"bool_array_value": np.zeros(0, bool), "string_array_value": []},
    }
    value = T["rcl_interfaces/msg/ParameterValue"](**fields)
    event = T["rcl_interfaces/msg/ParameterEvent"](
        stamp=T["builtin_interfaces/msg/Time"](sec=1, nanosec=0),
        node="/robot_state_publisher",
        new_parameters=[T["rcl_interfaces/msg/Parameter"](name="robot_description", value=value)],
        changed_parameters=[],
        deleted_parameters=[],
    )
    return encoded(START_NS, "/parameter_events", event)


def log_with(path: Path, *messages: RawMessage, **recipe: Any) -> Path:
    """The log of `make_log` behind these messages."""
    return write_raw(path, [*messages, *messages_of(make_log(path.with_name("plain.mcap"), LogRecipe(**recipe)))])


@pytest.mark.parametrize("kind", ["topic", "namespace", "parameter", "ROS 1"])
def test_a_log_that_describes_its_robot_needs_no_urdf(tmp_path: Path, kind: str) -> None:
    if kind == "ROS 1":
        store = get_typestore(Stores.ROS1_NOETIC)
        state = joint_state(START_NS, ("joint_a", "joint_b"), (0.0, 0.1), store=store)
        messages = [described(robot(), ros=1), encoded(START_NS, "/joint_states", state, store, ros=1)]
        path = write_bag(tmp_path / "run.bag", messages, store)
    else:
        topic = "/left/robot_description" if kind == "namespace" else "/robot_description"
        message = as_parameter(robot()) if kind == "parameter" else described(robot(), topic)
        path = log_with(tmp_path / "run.mcap", message)
    assert logged_urdf([path]).text == robot()
    assert open_log(ReplayRequest(log=path, out=tmp_path / "out"))[0].joint_names == ("joint_a", "joint_b")


def test_what_holds_states_and_is_no_log_is_replayed_with_the_urdf_that_is_given(tmp_path: Path) -> None:
    names = ("joint_a", "joint_b")
    columns = 'joints = ["joint_a", "joint_b"]\nposition = ["a", "b"]\ntime = "t"\n'
    written(tmp_path, "t,a,b\n0,0.1,0.2\n0.01,0.1,0.2\n", "x.csv")
    table, urdf = written(tmp_path, f'[states]\nfile = "x.csv"\n{columns}', "x.toml"), written(tmp_path, robot())
    for path in (table, lerobot(tmp_path / "set", 3, num_episodes=1, names={"motors": list(names)})):
        request = ReplayRequest(log=path, out=tmp_path / "out", urdf=urdf)
        assert open_log(request)[0].joint_names == names


@pytest.mark.parametrize(
    ("option", "given"),
    [
        ("base", {"base": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}),
        ("lock", {"locked": {"joint_a": 0.0}}),
        ("packages", {"packages": (Path("meshes"),)}),
        ("spheres", {"spheres": Path("s.yaml")}),
        ("self-model", {"self_model": Path("self.npz")}),
    ],
)
def test_an_option_of_the_robot_without_one_is_refused(option: str, given: dict[str, Any], tmp_path: Path) -> None:
    path = log_with(tmp_path / "run.mcap")
    request = ReconstructRequest(source=open_source(path), out=tmp_path / "out", recording=path)
    assert _robot(request, Said()) is None
    words = f"^--{option}: needs the robot; give --urdf as well"
    expect_refusal(words, _robot, replace(request, **given), Said(), error=UsageError)


def test_a_log_that_does_not_exist_is_named_before_its_robot(tmp_path: Path) -> None:
    request = ReplayRequest(log=tmp_path / "none.mcap", out=tmp_path / "out")
    expect_refusal("none.mcap: no such file or folder; check the path", open_log, request)


def test_a_robot_that_is_said_twice_is_one(tmp_path: Path) -> None:
    twice = log_with(tmp_path / "twice.mcap", described(robot(), "/a/robot_description"), described(robot()))
    assert logged_urdf([twice]) is not None


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        (
            (as_parameter(robot(), kind=3), described(robot(), "/chatter")),
            "does not describe the robot; give it with",
        ),
        (
            (described(robot(), "/a/robot_description"), described(robot(shift=0.5), "/b/robot_description")),
            "2 robots, of /a/robot_description, /b/robot_description; give one of them",
        ),
        ((described("<robot"),), "/robot_description: expected a URDF, got broken XML"),
    ],
    ids=["none", "two", "no URDF"],
)
def test_a_log_without_one_readable_robot_is_refused(
    tmp_path: Path, messages: tuple[RawMessage, ...], words: str
) -> None:
    path = log_with(tmp_path / "run.mcap", *messages)
    expect_refusal(
        f"run.mcap.*{words}", open_log, ReplayRequest(log=path, out=tmp_path / "out"), error=(InputError, UsageError)
    )
    if "broken" in words:
        assert "its robot_description cannot be read" in differs(read_urdf(written(tmp_path, robot())), [path])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (robot(), ""),
        (robot(shape='<visual><geometry><sphere radius="1"/></geometry></visual>').replace("\n", "\n  "), ""),
        (robot(shift=0.21), "link tip is 10.0 mm and 0.0 degrees elsewhere in"),
        (robot(upper=0.9), "joint joint_a: lower, upper and fastest are -1, 1, 1 in"),
        (robot(first="joint_c"), "has no joint joint_a"),
        (robot().replace('<axis xyz="0 1 0"/>', '<axis xyz="0 0 1"/>', 1), "degrees elsewhere in"),
    ],
    ids=["the same", "other shapes", "a link moved", "a limit", "a joint", "an axis"],
)
def test_a_model_of_the_command_line_that_differs_as_a_mechanism_is_said(
    tmp_path: Path, changed: str, words: str
) -> None:
    path, file, said = log_with(tmp_path / "run.mcap", described(changed)), written(tmp_path, robot()), Said()
    found = urdf_of(file, [path], said)
    assert found.path == file
    if not words:
        assert said.lines == []
        return
    remedy = "leave --urdf out to take the log's own, or correct the file"
    assert re.fullmatch(f"warning: .*{re.escape(words)}.*{remedy}", said.lines[0])
    findings = check(CheckRequest(paths=(path,), urdf=file))[0].findings
    assert [finding.what for finding in findings if finding.code == "robot-model"] == [differs(found, [path])]


MESH = '<collision><geometry><mesh filename="package://r/a.stl"/></geometry></collision>'


@pytest.mark.parametrize(
    ("text", "recipe", "words"),
    [
        (robot(), {}, ""),
        (robot(shape=MESH), {}, "mesh package://r/a.stl was not found; give the folder that holds its package"),
        (robot(root="base"), {}, "the poses are in the frame 'world', and tf has no frame of its root 'base'"),
        (robot(), {"has_joints": False}, "expected joint states, got none"),
    ],
    ids=["it can", "no meshes", "elsewhere", "no states"],
)
def test_a_reconstruction_leaves_the_robot_of_the_log_out_where_it_can(
    tmp_path: Path, text: str, recipe: dict[str, bool], words: str
) -> None:
    path, said = log_with(tmp_path / "run.mcap", described(text), **recipe), Said()
    request = ReconstructRequest(source=open_source(path), out=tmp_path / "scene", recording=path)
    assert (_robot(request, said) is None) == bool(words)
    start = "warning: the robot stays in the map: " if words else f"the robot is the log's own: {path}/robot_desc"
    assert said.lines[0].startswith(start) and words in said.lines[0]


def test_a_robot_of_the_log_that_is_asked_for_is_used_or_refused(tmp_path: Path) -> None:
    spheres = written(tmp_path, "collision_spheres:\n  tip:\n  - center: [0, 0, 0]\n    radius: 0.1\n", "s.yaml")
    path = log_with(tmp_path / "run.mcap", described(robot(shape=MESH)))
    request = ReconstructRequest(source=open_source(path), out=tmp_path / "out", recording=path, spheres=spheres)
    assert _robot(request, Said()).sphere_set.links == ("tip",)
    other = log_with(tmp_path / "other.mcap", described(robot(root="base")))
    expect_refusal(
        r"give --world-frame base, or --base with its pose",
        _robot,
        replace(request, source=open_source(other), recording=other),
        Said(),
    )


def test_a_replay_says_where_it_places_the_robot_of_the_log(tmp_path: Path) -> None:
    path = log_with(tmp_path / "run.mcap", described(robot(root="base")))
    request, said = ReplayRequest(log=path, out=tmp_path / "out"), Said()
    open_log(request, said)
    assert "placed at the origin: the poses are in the frame 'world'" in said.lines[0]
    for given in ({"base": (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)}, {"urdf": written(tmp_path, robot(root="base"))}):
        open_log(replace(request, **given), told := Said())
        assert told.lines == []


PLACE = transform_from([0.3, -0.2, 0.8], [0.0, 0.0, 0.6, 0.8])


def log_on_a_stand(path: Path, *places: tuple[float, float, float]) -> Path:
    """The log of `make_log` whose tf has the robot's root `base` at each of these places in turn."""
    edges = [transform(START_NS + k, "world", "base", place, (0.0, 0.0, 0.6, 0.8)) for k, place in enumerate(places)]
    tf = [encoded(START_NS, "/tf", built("tf2_msgs/msg/TFMessage", transforms=[edge])) for edge in edges]
    return log_with(path, described(robot(root="base")), *tf)


@pytest.mark.parametrize("kind", ["log", "capture"])
def test_the_robot_stands_where_tf_has_its_root(tmp_path: Path, kind: str) -> None:
    path, urdf = log_on_a_stand(tmp_path / "run.mcap", (0.3, -0.2, 0.8)), written(tmp_path, robot(root="base"))
    if kind == "capture":
        ingest(IngestRequest(paths=(path,), out=tmp_path / "run.capture"))
        path = tmp_path / "run.capture"
    request, said = ReplayRequest(log=path, out=tmp_path / "out"), Said()
    for given in ({}, {"urdf": urdf}):
        assert open_log(replace(request, **given), said)[0].T_world_base == pytest.approx(PLACE, abs=1e-9)
    assert not any("placed" in line for line in said.lines)
    mapped = ReconstructRequest(source=open_source(path), out=tmp_path / "scene", recording=path)
    assert _robot(mapped, Said()).T_world_base == pytest.approx(PLACE, abs=1e-9)
    checked = check(CheckRequest(paths=(path,), urdf=urdf))[0]
    assert not checked.obstacles("replay")
    given = open_log(replace(request, base=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))[0]
    assert given.T_world_base == pytest.approx(transform_from([1, 0, 0], [0, 0, 0, 1])), "--base overrides tf"


def test_a_robot_that_tf_moves_is_refused_unless_its_place_is_given(tmp_path: Path) -> None:
    path = log_on_a_stand(tmp_path / "run.mcap", (0.3, -0.2, 0.8), (0.31, -0.2, 0.8))
    request = ReplayRequest(log=path, out=tmp_path / "out")
    expect_refusal("tf moves 'base', the robot's root.*give --world-frame base, or --base", open_log, request)
    urdf = written(tmp_path, robot(root="base"))
    found = check(CheckRequest(paths=(path,), urdf=urdf))[0].obstacles("replay")
    assert ["tf moves 'base'" in text for text in found] == [True, True]
    assert open_log(replace(request, base=(0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0)))[0].base_position[2] == 0.8


def test_a_replay_keeps_the_robot_of_its_log_for_who_looks_at_it(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    urdf, spheres = stage.desk.robot[1], stage.desk.robot[3]
    names = tuple(f"joint{i}" for i in range(1, 8))
    states = [encoded(s.stamp_ns, "/joint_states", joint_state(s.stamp_ns, names, s.position)) for s in stage.states]
    log = write_raw(stage.desk.folder / "x.mcap", [described(Path(urdf).read_text()), *states])
    out = stage.desk.folder / "out"
    words = ["replay", str(log), "--spheres", spheres, "--scene", str(stage.scene()), "-o", str(out), "-q"]
    words += ["--base=0,0,0.002,0,0,0,1"]
    monkeypatch.setattr(sys, "argv", ["splatctrl", *words])
    assert main(words) == 0
    assert (out / "robot_description.urdf").read_text() == Path(urdf).read_text()
    log.unlink()
    run = open_run(out)
    assert robot_of(run, run.states).base_position == pytest.approx([0, 0, 0.002])
    assert space_of(out).motion is not None


def test_a_capture_keeps_the_description(tmp_path: Path) -> None:
    path = log_with(tmp_path / "run.mcap", described(robot()))
    assert describe(path).facts["robot_description"] == ["/robot_description"]
    capture = ingest(IngestRequest(paths=(path,), out=tmp_path / "run.capture")).out
    assert is_capture(capture)
    assert (capture / "robot_description.urdf").read_text() == logged_urdf([capture]).text == robot()
    (capture / "robot_description.urdf").write_text(robot(shift=0.3))
    expect_refusal("its checksum differs from SHA256SUMS", logged_urdf, [capture])
