"""Commanded twists from every kind of log and from tables."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.recording.state.twists import read_twists
from tests.recording.log.make_states import (
    START_NS,
    STORE,
    Message,
    header,
    states_of,
    write_bag1,
    write_bag2,
    write_mcap,
)

STAMPED, PLAIN = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
VALUES = [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [1.0, 0.0, 0.0, 0.0, 0.0, -1.0]]


def twist(values: list[float], store: Any = STORE) -> Any:
    vector = store.types["geometry_msgs/msg/Vector3"]
    linear, angular = (vector(x=x, y=y, z=z) for x, y, z in (values[:3], values[3:]))
    return store.types[PLAIN](linear=linear, angular=angular)


def stamped(values: list[float], stamp_ns: int, frame: str = "base", store: Any = STORE) -> Message:
    content = store.types[STAMPED](header=header(store, stamp_ns, frame), twist=twist(values, store))
    return Message(log_ns=START_NS + 7, topic="/cmd", type_name=STAMPED, content=content)


def of_log(store: Any = STORE) -> list[Message]:
    """The second of the twists first, as a slow disk may write them."""
    return [stamped(VALUES[1], START_NS + 50, store=store), stamped(VALUES[0], START_NS, store=store)]


@pytest.mark.parametrize("kind", ["mcap", "bag2", "bag1"])
def test_stamped_twists_of_any_log_come_by_their_own_stamps(tmp_path: Path, kind: str) -> None:
    if kind == "bag1":
        store = get_typestore(Stores.ROS1_NOETIC)
        path = write_bag1(tmp_path / "log.bag", of_log(store), store)
    else:
        path = write_mcap(tmp_path / "log.mcap", of_log()) if kind == "mcap" else write_bag2(tmp_path / "b", of_log())
    found = read_twists(path, "/cmd")
    assert found.frame == "base" and found.stamp_ns.tolist() == [START_NS, START_NS + 50]
    np.testing.assert_array_equal(found.twist, VALUES)


def test_twists_without_a_header_come_by_the_time_of_logging(tmp_path: Path) -> None:
    messages = [
        Message(log_ns=START_NS + i, topic="/cmd", type_name=PLAIN, content=twist(values))
        for i, values in enumerate([*VALUES, [np.nan] * 6])
    ]
    found = read_twists(write_mcap(tmp_path / "log.mcap", messages), "/cmd")
    assert found.frame == "" and found.stamp_ns.tolist() == [START_NS, START_NS + 1]
    assert found.notes == ("stamps are the times of logging", "1 twists with NaN or infinity: left out")


def test_what_is_no_topic_of_twists_is_said(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "log.mcap", [*of_log(), *states_of(np.zeros((1, 2)), ("a", "b"))])
    with pytest.raises(InputError, match=r"got sensor_msgs/msg/JointState; topics with twists: /cmd"):
        read_twists(path, "/joint_states")
    with pytest.raises(InputError, match="got no message"):
        read_twists(path, "/else")
    mixed = write_mcap(tmp_path / "mixed.mcap", [*of_log(), stamped(VALUES[0], START_NS + 60, "tool")])
    with pytest.raises(InputError, match="in one frame, got base, tool"):
        read_twists(mixed, "/cmd")


def test_a_table_beside_that_of_the_states_holds_twists(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,a,vx,vy,vz,wx,wy,wz\n0,0.0,.1,.2,.3,.4,.5,.6\n50,0.1,1,0,0,0,0,-1\n")
    states = '[states]\nfile = "run.csv"\njoints = ["a"]\ntime = "t"\ntime_unit = "ns"\nposition = ["a"]\n'
    twists = '[twists]\nfile = "run.csv"\ntime = "t"\ntime_unit = "ns"\nlinear = ["vx", "vy", "vz"]\n'
    path = tmp_path / "run.toml"
    path.write_text(states + twists + 'angular = ["wx", "wy", "wz"]\nframe = "tip"\n')
    found = read_twists(path, "twists")
    assert found.frame == "tip" and found.stamp_ns.tolist() == [0, 50]
    np.testing.assert_array_equal(found.twist, VALUES)
    assert len(list(open_states(path, SourceOptions(), ("a",)).records())) == 2
    path.write_text(states + twists + 'angular = ["wx"]\n')
    with pytest.raises(InputError, match="angular of 3 columns"):
        read_twists(path, "twists")
    path.write_text(states)
    with pytest.raises(InputError, match=r"expected a table \[twists\]"):
        read_twists(path, "twists")
