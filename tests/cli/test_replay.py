"""``splatctrl replay`` against scenes whose distances are known: states, goals, detours, twists, pictures."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.records import LossReport, Record
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import (
    BALL,
    SECOND,
    START,
    Desk,
    FakeSource,
    clearance,
    grid_seen,
    logged,
    scene_of,
    splats_of,
    write_field,
    write_scene,
)
from tests.evaluate.test_worst_frames import frame
from tests.recording.log.make_states import START_NS, states_of, write_mcap
from tests.recording.state.test_state_tables import stamped
from tests.robot.shapes import written


@pytest.mark.usefixtures("painted")
def test_an_audit_measures_every_logged_state(desk: Desk, arm: RobotModel) -> None:
    desk.source.states = logged(START + 0.3)
    assert desk.replay(*scene_of(desk, BALL), "-q") == 0
    found = [float(row["clearance_exact"]) for row in desk.rows()]
    np.testing.assert_allclose(found, [clearance(arm, s.position) for s in desk.source.states], atol=1e-6)
    assert desk.metrics()["min_clearance"] == pytest.approx(min(found), abs=1e-8)
    names = {"steps.csv", "events.json", "summary.json", "clearance.png", "run.json", "states.json", "evidence.png"}
    assert {path.name for path in (desk.folder / "out").iterdir()} == names


@pytest.mark.parametrize("start", [(), ("--start-time", "first-map"), ("--start-time", "0.5")])
def test_states_and_a_scene_on_clocks_that_do_not_overlap_are_said_as_such(
    desk: Desk, capsys: pytest.CaptureFixture[str], start: tuple[str, ...]
) -> None:
    epoch = 1_700_000_000 * SECOND
    scene = write_scene(desk.folder / "scene", (epoch, splats_of(BALL)), (epoch + SECOND, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q", *start) == 5
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "all 11 joint states are earlier than the first known scene" in line
    assert not [*desk.folder.glob("out*")]
    assert "joint states from 0.00 to 1.00 s and a scene from 1700000000.00 to 1700000001.00 s are on" in line
    assert "clocks that do not overlap; record both by one clock" in line


def test_a_baked_field_says_nearly_the_same_and_certifies_less(desk: Desk, arm: RobotModel) -> None:
    assert desk.replay("--field", str(write_field(desk.folder / "field", BALL, voxel=0.04)), "-q") == 0
    exact, certified = (float(desk.rows()[0][f"clearance_{name}"]) for name in ("exact", "certified"))
    assert exact == pytest.approx(clearance(arm, START), abs=2e-3) and certified <= clearance(arm, START) + 1e-6


def test_a_path_that_leaves_known_space_is_not_evaluated(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    seen = grid_seen()
    seen.num_updates[:, :, 15:] = 0  # above half a metre
    field = write_field(desk.folder / "field", BALL, seen=seen, voxel=0.04, unknown="nan")
    known = ("--field", str(field), "-q", "--max-unknown", "1")
    assert desk.replay(*known, is_judged=True) == 5
    assert "the path leaves known space: at 11 of 11 states a sphere is" in capsys.readouterr().out
    assert desk.metrics()["num_without_distance"] == 11
    assert {row["clearance_barrier"] for row in desk.rows()} == {""}
    assert desk.replay(*known, "--mode", "closed-loop", out="driven") == 5
    assert "the field has no distance there" in capsys.readouterr().err


def test_a_closed_loop_reaches_the_logged_end_and_gates_on_it(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    desk.source.states = logged(START + np.array([0.5, 0.1, 0, 0, 0, 0, 0]))
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    gates = ["--require", "goal_reached>=1", "--require", "num_hold<=0", "--require", "min_barrier_clearance>=0.019"]
    assert desk.replay("--scene", str(scene), "-q", "--json", "--mode", "closed-loop", *gates) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["goal_reached"] == 1 and printed["position_error"] <= 0.01
    rows = desk.rows()
    assert printed["num_steps"] == len(rows) == printed["num_solved"] + printed["num_relaxed"]
    assert all(float(row["residual"]) <= 1e-5 for row in rows)


def test_the_truth_is_reported_beside_the_scene_and_how_the_clocks_of_frames_and_states_agree(
    desk: Desk, sample_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tabletop, out = sample_data / "tabletop", desk.folder / "out"
    truth = ["--truth", str(tabletop / "truth.json"), "--worst-frames", "0"]  # asks for no frame
    robot = ["--urdf", str(tabletop / "robot.urdf"), "--spheres", str(tabletop / "robot_spheres.yaml")]
    words = ["replay", str(tabletop / "log.mcap"), *robot, *scene_of(desk, BALL), "-o", str(out), *truth]
    assert main([*words, "--cameras", "cam0"]) == 5
    recorded = json.loads((tabletop / "truth.json").read_text())["clearance"]["min"]
    assert desk.metrics()["min_clearance_true"] == pytest.approx(recorded, abs=1e-5)
    assert desk.metrics()["truth_num_compared_exact"] > 0
    assert desk.metrics()["truth_largest_over_exact"] > 0.05  # the scene of this test lacks the table
    assert "log: clocks of cameras and robot: frames are stamped" in capsys.readouterr().out
    assert abs(desk.json("states.json")["clock_offset"]["offset_s"]) < 0.06


@pytest.mark.parametrize(
    ("source", "code", "said"),
    [
        (FakeSource(states=[], joint_names=()), 4, "expected joint states, got none"),
        (FakeSource(states=logged(), joint_names=tuple("abcdefg")), 4, "joints not in the log: joint1"),
        (FakeSource(states=logged()[::-1]), 4, "expected a stamp not before"),
        (
            FakeSource(states=logged(), loss=LossReport(damaged=2)),
            3,
            "SAFE, proven, part of the recording is damaged and left out (logged",
        ),
    ],
)
def test_logs_that_do_not_fit_are_refused(
    desk: Desk, source: FakeSource, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    desk.source = source
    assert desk.replay(*scene_of(desk, BALL), "-q") == code
    assert said in "".join(capsys.readouterr())


def test_a_start_in_collision_names_the_sphere(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    center = arm.sphere_centers(START)[-1]
    assert desk.replay(*scene_of(desk, (tuple(center), 0.01)), "-q", "--mode", "closed-loop") == 5
    assert "got sphere hand[" in capsys.readouterr().err


def test_fingers_that_the_log_does_not_move_are_locked_with_a_note(
    desk: Desk, capsys: pytest.CaptureFixture[str]
) -> None:
    fingers = "".join(
        f'<link name="{side}"/><joint name="{side}" type="prismatic"><parent link="hand"/><child link="{side}"/>'
        '<axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="1" effort="1"/></joint>'
        for side in ("left", "right")
    )
    text = Path(desk.robot[1]).read_text().replace("</robot>", f"{fingers}</robot>")
    desk.robot[1] = str(written(desk.folder, text, "with_hand.urdf"))
    assert desk.replay(*scene_of(desk, BALL)) == 0
    warned = [line for line in capsys.readouterr().err.splitlines() if "fingers" in line]
    assert warned == [
        "warning: fingers without logged states are locked halfway: left = 0.02, right = 0.02; "
        "--lock sets other values"
    ]
    assert not {"q_left", "q_right"} & set(desk.rows()[0])


GOAL = np.array([0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 1.6])
WALL = tuple(((x, 0.0, z), 0.04) for x in np.arange(0.3, 0.85, 0.05) for z in np.arange(0.05, 0.5, 0.05))


def test_a_way_is_planned_where_the_controller_stalls(desk: Desk) -> None:
    desk.source.states = logged(GOAL)
    options = (*scene_of(desk, *WALL), "--mode", "closed-loop", "--set", "control.solver=daqp")
    assert desk.replay(*options, "--set", "control.max_detours=2", "--require", "goal_reached>=1") == 0
    metrics = desk.metrics()
    assert len(desk.json("events.json")["detours"]) == metrics["num_detours"] >= 1
    assert metrics["stalled"] == 0 and metrics["min_clearance_barrier"] >= 0.0199


NUM_STATES = 41  # states, every 10 ms
TWIST = [0.0, -0.1, 0.05, 0.0, 0.0, 0.0]


def twisted(desk: Desk, *options: str, frame: str = "link0", out: str = "out") -> int:
    """A replay of an arm that stands still in the log, while somebody asked it to move for 0.2 s."""
    twists = [stamped(TWIST, START_NS + i * 50_000_000, frame) for i in range(5)]
    still = states_of(np.tile(START, (NUM_STATES, 1)), desk.source.joint_names)
    log = write_mcap(desk.folder / f"{out}.mcap", [*still, *twists])
    scene = desk.folder / "scene"
    if not scene.exists():
        write_scene(scene, (START_NS, splats_of(BALL)))
    known = ["--scene", str(scene), "-o", str(desk.folder / out), "-q"]
    return main(
        ["replay", str(log), *desk.robot, *known, "--set", "control.twist_timeout=0.1", "--report-only", *options]
    )


def test_a_driven_arm_does_what_the_log_asked_for(desk: Desk, arm: RobotModel) -> None:
    assert twisted(desk, "--twist-topic", "/cmd", "--mode", "closed-loop") == 0
    q = np.array([[float(row[f"q_{name}"]) for name in arm.joint_names] for row in desk.rows()])
    first, last = (arm.frame_pose(row, arm.frame_names[-1])[:3, 3] for row in q[[0, -1]])
    np.testing.assert_allclose(last - first, 0.31 * np.array(TWIST[:3]), atol=2e-3)  # 0.2 s, the time-out, one step
    metrics = desk.metrics()
    assert (metrics["num_steps"], metrics["goal_reached"]) == (NUM_STATES, 0)
    assert (metrics["twist_share"], metrics["twist_share_capped"]) == (pytest.approx(31 / NUM_STATES), 0)
    assert metrics["max_twist_error_linear"] < 5e-3
    assert desk.json("summary.json")["about"]["outcome"] == "log-ended"


def test_open_loop_says_how_the_command_misses_a_twist(desk: Desk) -> None:
    assert twisted(desk, "--twist-topic", "/cmd", "--mode", "open-loop", "--require", "twist_share>=0.7") == 0
    assert desk.metrics()["mean_velocity_difference"] > 0.05 > desk.metrics()["mean_twist_error_linear"]
    fast = ["--set", "control.max_linear_speed=0.05"]
    assert twisted(desk, "--twist-topic", "/cmd", "--mode", "open-loop", *fast, out="fast") == 0
    assert desk.metrics("fast")["twist_share_capped"] == 1


@pytest.mark.parametrize(
    ("options", "frame", "code", "said"),
    [
        (["/cmd"], "odom", 4, "got frame 'odom'; give --twist-frame"),
        (["/cmd", "--twist-frame", "world"], "odom", 0, ""),
        (["/no"], "link0", 4, "topics with twists: /cmd"),
    ],
)
def test_twists_that_cannot_be_used_are_said(
    desk: Desk, options: list[str], frame: str, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twisted(desk, "--mode", "open-loop", "--twist-topic", *options, frame=frame) == code
    assert said in capsys.readouterr().err


@dataclass(kw_only=True)
class FilmedSource(FakeSource):
    """A recording of an arm with a camera above it."""

    def records(self) -> Iterator[Record]:
        yield from sorted([*self.states, *(frame(k * SECOND // 5) for k in range(6))], key=lambda r: r.stamp_ns)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("worst_*")}


def test_a_replay_shows_its_worst_moments(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    desk.source = FilmedSource(states=logged(START + 0.3))
    scene = scene_of(desk, BALL)
    for mode in ("audit", "closed-loop"):
        assert desk.replay(*scene, "--mode", mode, "--set", "control.max_time=0.5", out=mode) == 0
        assert names(desk.folder / mode) >= {"worst_1.png"}
    assert desk.replay(*scene, "--worst-frames", "0", out="none") == 0
    capsys.readouterr()
    desk.source = FakeSource(states=logged(START + 0.3))
    assert desk.replay(*scene, out="unseen") == 0
    assert "worst frames: no camera image at or before 1 of 1 moments" in capsys.readouterr().out
    assert not names(desk.folder / "none") | names(desk.folder / "unseen")
