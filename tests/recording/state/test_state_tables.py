"""Logs of libfranka, tables of states that a TOML file describes, and twists that somebody commanded."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.geometry import pose_at
from splatctrl_cli.recording.state.state_source import read_twists
from splatctrl_cli.records import Float64
from tests.recording.log.make_log import built, by_axis
from tests.recording.log.make_states import (
    START_NS,
    STORE,
    Message,
    header,
    opened,
    refusal,
    states,
    states_of,
    write_bag1,
    write_bag2,
    write_mcap,
)
from tests.refused import expect_refusal

ARM = tuple(f"panda_joint{i}" for i in range(1, 8))


def block(name: str, num: int = 7, separator: str = ", ") -> str:
    return separator.join(f"{name}[{i}]" for i in range(num))


def libfranka_log(path: Path, *, is_new: bool = False, is_commanded: bool = True) -> Path:
    """As libfranka writes it: before 0.14 with a column `sent commands` without values, q_d and dq_d twice."""
    of_state, of_command, gap = ("state.", "cmd.", ",") if is_new else ("", "", ", ")
    names = ("q", "q_d", "dq", "dq_d", "tau_J", "tau_ext_hat_filtered")
    sent = (("q_d", 7), ("dq_d", 7), ("O_T_EE_d", 16), ("O_dP_EE_d", 6), ("tau_J_d", 7))
    columns = [block(f"{of_state}{name}", 7, gap) for name in names]
    columns += [] if is_new else ["sent commands"]
    columns += [block(f"{of_command}{name}", num, gap) for name, num in sent]
    lines = [",".join(["time,success_rate" if is_new else "duration, success rate", *columns])]
    command = values(np.zeros(7), np.full(7, 0.5 * is_commanded), np.zeros(16 + 6 + 7))
    for i in range(20):
        measured = values(q_at(i), q_at(i), np.arange(1.0, 8), np.full(7, 0.25), np.zeros(14))
        lines.append(f"{5000 + i},1,{measured},{'' if is_new else ','}{command}")
    path.write_text("\n".join(lines) + "\n")
    return path


def values(*rows: Float64) -> str:
    return ",".join(",".join(f"{v:.17g}" for v in row) for row in rows)


def q_at(i: int) -> Float64:
    return np.arange(7) * 0.1 + 0.001 * i * np.arange(1, 8)


@pytest.mark.parametrize(("is_new", "is_commanded"), [(False, True), (True, True), (False, False)])
def test_libfranka_logs_of_both_kinds_are_read(tmp_path: Path, is_new: bool, is_commanded: bool) -> None:
    source = opened(libfranka_log(tmp_path / "x.csv", is_new=is_new, is_commanded=is_commanded), ARM)
    found = states(source)
    stamps = [(5000 + i) * 1_000_000 for i in range(20)]
    assert (source.joint_names, [s.stamp_ns for s in found]) == (ARM, stamps)
    assert [*found[3].position, *found[3].velocity] == pytest.approx([*q_at(3), *range(1, 8)])
    wanted = 0.5 if is_commanded else 0.25  # without a command the desired velocity stands for it
    assert found[3].commanded_velocity == pytest.approx(np.full(7, wanted))
    assert any("since it was switched on" in note for note in source.loss.notes)


POSE = pose_at([0.4, -0.1, 0.6], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])


def test_an_end_effector_pose_that_a_program_added_is_read_by_columns(tmp_path: Path) -> None:
    rows = [f"{i},1,{values(q_at(i), POSE.T.ravel())}" for i in range(5)]
    head = f"duration, success rate, {block('q')},{block('O_T_EE', 16)}"
    (tmp_path / "x.csv").write_text("\n".join([head, *rows]))
    assert states(opened(tmp_path / "x.csv", ARM))[2].T_base_ee == pytest.approx(POSE)


def test_a_csv_of_no_known_kind_asks_for_a_description_and_a_cut_line_is_named(tmp_path: Path) -> None:
    path = libfranka_log(tmp_path / "x.csv")
    for text, said in (
        (path.read_text()[:-100], f"{path}:21: expected"),
        ("time,success_rate,q[0]\n", "expected joint states, got none"),
        ("t,j1\n0,1\n", "expected libfranka's columns.*describe the columns in a .toml"),
    ):
        path.write_text(text)
        expect_refusal(said, opened, path, has_remedy=True)


DESCRIPTION: dict[str, Any] = {
    "file": "run.csv",
    "joints": ["a", "b"],
    "time": "t",
    "position": ["qa", "qb"],
    "unit": "deg",
    "time_unit": "ms",
}


def described(folder: Path, **changes: Any) -> Path:
    table = {key: value for key, value in {**DESCRIPTION, **changes}.items() if value is not None}
    path = folder / "run.toml"
    path.write_text("[states]\n" + "\n".join(f"{key} = {value!r}" for key, value in table.items()))
    return path


def csv_run(folder: Path) -> Path:
    """20 states at 100 Hz in degrees; qa rises by 10 deg/s, qb falls; the end effector at x = i, turned about z."""
    half = np.sqrt(0.5)
    rows = [f"{10 * i},{0.1 * i},{-0.1 * i},10,-10,{i},0,0.5,0,0,{half:.17g},{half:.17g}" for i in range(20)]
    path = folder / "run.csv"
    path.write_text("\n".join(["t,qa,qb,va,vb,x,y,z,qx,qy,qz,qw", *rows]))
    return path


def test_degrees_milliseconds_and_an_epoch_become_radians_and_nanoseconds(tmp_path: Path) -> None:
    csv_run(tmp_path)
    epoch, poses = 1_700_000_000_123_456_789, ["x", "y", "z", "qx", "qy", "qz", "qw"]
    said = {"velocity": ["va", "vb"], "commanded_velocity": ["vb", "va"], "epoch_ns": epoch}
    found = states(described(tmp_path, **said, pose=poses, pose_frame="world"))
    assert [s.stamp_ns for s in found] == [epoch + 10_000_000 * i for i in range(20)]
    motion = [*found[7].position, *found[7].velocity, *found[7].commanded_velocity]
    assert motion == pytest.approx(np.radians([0.7, -0.7, 10, -10, -10, 10]))
    assert found[7].T_base_ee is None
    assert found[7].T_world_ee[:3] == pytest.approx(np.array([[0, -1, 0, 7], [1, 0, 0, 0], [0, 0, 1, 0.5]]))
    source = opened(described(tmp_path))
    assert states(source)[0].velocity == pytest.approx(np.radians([10, -10])), "differences where not described"
    assert source.loss.differentiated_velocities == 20
    (tmp_path / "run.csv").write_text("t,qa,qb\n1700000000123456789,0,0\n1700000000133456791,0,0\n")
    stamps = [s.stamp_ns for s in states(described(tmp_path, time_unit="ns"))]
    assert stamps == [1700000000123456789, 1700000000133456791], "nanoseconds keep every digit"


def test_npz_arrays_give_their_columns(tmp_path: Path) -> None:
    q = np.linspace(0, 1, 40).reshape(20, 2)
    np.savez(tmp_path / "run.npz", t=np.arange(20) * 0.01, q=q, T=np.broadcast_to(POSE, (20, 4, 4)))
    path = described(tmp_path, file="run.npz", position=["q"], unit="rad", time_unit="s", pose=["T"])
    found = states(path)
    assert [s.stamp_ns for s in found] == [10_000_000 * i for i in range(20)]
    assert np.array_equal([s.position for s in found], q)
    assert found[5].T_base_ee == pytest.approx(POSE)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"unit": "degrees"}, "states.unit: expected one of rad, deg, got 'degrees'"),
        ({"time_unit": "min"}, "states.time_unit: expected one of s, ms, us, ns"),
        ({"positions": ["qa"]}, "unknown key states.positions; did you mean states.position?"),
        ({"position": None}, "states.position is missing"),
        ({"position": ["qa"]}, "states.position: expected 2 columns of 20 states, got (1, 20)"),
        ({"position": ["qa", "qc"]}, "no column 'qc'; columns there: t, qa, qb"),
        ({"file": "none.csv"}, "none.csv: no such file"),
        ({"pose": ["x", "y", "z"]}, "states.pose: expected 7 or 16 columns"),
        ({"joints": ["a", "a"]}, "states.joints: expected names, each once"),
    ],
)
def test_a_wrong_description_names_the_key(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    csv_run(tmp_path)
    assert said in refusal(described(tmp_path, **changes))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("0,0,0\n10,zero,0\n", "run.csv:3: column qa: expected a number, got 'zero'"),
        ("0,0,0\nnan,0,0\n", "run.csv:3: column t: expected a number, got 'nan'"),
        ("\n0,0,0\n\n10,zero,0\n", "run.csv:5: column qa: expected a number, got 'zero'"),
    ],
)
def test_a_cell_that_is_no_number_is_named(tmp_path: Path, rows: str, said: str) -> None:
    (tmp_path / "run.csv").write_text(f"t,qa,qb\n{rows}")
    assert said in refusal(described(tmp_path))


def test_an_npz_without_the_array_lists_those_there(tmp_path: Path) -> None:
    for t, name, said in (
        (np.arange(3.0), "angles", "'angles': expected an array of numbers, got none; arrays there: t, q"),
        (np.array([0.0, np.nan, 1.0]), "q", "t: expected times, got NaN, NaT"),
        (np.array([0, "NaT", 2], "datetime64[ns]"), "q", "t: expected times, got NaN, NaT"),
        (np.zeros(0), "q", "q: expected rows, got none; record it again"),
    ):
        np.savez(tmp_path / "run.npz", t=t, q=np.zeros((len(t), 2)))
        assert said in refusal(described(tmp_path, file="run.npz", position=[name]))
    (tmp_path / "run.npz").write_bytes(b"PK no")
    assert "cannot be read as NPZ" in refusal(tmp_path / "run.toml")


STAMPED, PLAIN = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"

VALUES = [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [1.0, 0.0, 0.0, 0.0, 0.0, -1.0]]


def twist(values: list[float], store: Any = STORE) -> Any:
    return built(PLAIN, store, linear=by_axis(values[:3]), angular=by_axis(values[3:]))


@pytest.mark.parametrize("kind", ["mcap", "bag2", "bag1", "plain"])
def test_twists_of_any_log_come_by_their_own_stamps_or_the_time_of_logging(tmp_path: Path, kind: str) -> None:
    if kind == "bag1":
        store = get_typestore(Stores.ROS1_NOETIC)
        path = write_bag1(tmp_path / "log.bag", of_log(store), store)
    elif kind == "plain":
        rows = enumerate([*VALUES, [np.nan] * 6])
        sent = [Message(log_ns=START_NS + 50 * i, topic="/cmd", type_name=PLAIN, content=twist(v)) for i, v in rows]
        path = write_mcap(tmp_path / "log.mcap", sent)
    else:
        path = write_mcap(tmp_path / "log.mcap", of_log()) if kind == "mcap" else write_bag2(tmp_path / "b", of_log())
    found = read_twists(path, "/cmd")
    np.testing.assert_array_equal(found.twist, VALUES)
    assert found.stamp_ns.tolist() == [START_NS, START_NS + 50]
    notes = ("stamps are the times of logging", "1 twists with NaN or infinity: left out")
    assert (found.frame, found.notes) == (("", notes) if kind == "plain" else ("base", ()))


def stamped(values: list[float], stamp_ns: int, frame: str = "base", store: Any = STORE) -> Message:
    content = store.types[STAMPED](header=header(store, stamp_ns, frame), twist=twist(values, store))
    return Message(log_ns=START_NS + 7, topic="/cmd", type_name=STAMPED, content=content)


def of_log(store: Any = STORE) -> list[Message]:
    """The second of the twists first, as a slow disk may write them."""
    return [stamped(VALUES[1], START_NS + 50, store=store), stamped(VALUES[0], START_NS, store=store)]


def test_what_is_no_topic_of_twists_is_said(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "log.mcap", [*of_log(), *states_of(np.zeros((1, 2)), ("a", "b"))])
    expect_refusal(r"got sensor_msgs/msg/JointState; topics with twists: /cmd", read_twists, path, "/joint_states")
    expect_refusal("got no message", read_twists, path, "/else")
    mixed = write_mcap(tmp_path / "mixed.mcap", [*of_log(), stamped(VALUES[0], START_NS + 60, "tool")])
    expect_refusal("in one frame, got base, tool", read_twists, mixed, "/cmd")


def test_a_table_beside_that_of_the_states_holds_twists(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,a,vx,vy,vz,wx,wy,wz\n0,0.0,.1,.2,.3,.4,.5,.6\n50,0.1,1,0,0,0,0,-1\n")
    table = '[states]\nfile = "run.csv"\njoints = ["a"]\ntime = "t"\ntime_unit = "ns"\nposition = ["a"]\n'
    twists = '[twists]\nfile = "run.csv"\ntime = "t"\ntime_unit = "ns"\nlinear = ["vx", "vy", "vz"]\n'
    path = tmp_path / "run.toml"
    path.write_text(table + twists + 'angular = ["wx", "wy", "wz"]\nframe = "tip"\n')
    found = read_twists(path, "twists")
    assert (found.frame, found.stamp_ns.tolist()) == ("tip", [0, 50])
    np.testing.assert_array_equal(found.twist, VALUES)
    assert len(states(opened(path, ("a",)))) == 2
    for rest, said in ((twists + 'angular = ["wx"]\n', "angular of 3 columns"), ("", "expected a table [twists]")):
        path.write_text(table + rest)
        expect_refusal(said, read_twists, path, "twists")
