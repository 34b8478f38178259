"""``splatctrl replay`` against scenes whose distances are known."""

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.bake import bake
from splatctrl_cli.io import source
from splatctrl_cli.io.grid import write_npz
from splatctrl_cli.io.scene_writer import SceneWriter
from splatctrl_cli.records import Box, Float64, JointState, LossReport, OccupancyGrid, Record, SplatSet
from splatctrl_cli.robot.model import RobotModel

SECOND = 1_000_000_000
START = np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.0])
BALL = ((0.75, 0.45, 0.40), 0.05)


@dataclass(kw_only=True)
class FakeSource:
    """A recording of joint states alone."""

    states: Sequence[JointState]
    joint_names: tuple[str, ...] = tuple(f"joint{i}" for i in range(1, 8))
    cameras: tuple[str, ...] = ("cam0",)
    name: str = "fake.mcap"
    has_clock: bool = True
    loss: LossReport = field(default_factory=LossReport)

    def records(self) -> Iterator[Record]:
        yield from self.states

    def digests(self) -> dict[str, str]:
        return {"fake.mcap": "0" * 64}


def logged(end: Float64 = START, num: int = 11, start_ns: int = 0) -> list[JointState]:
    """States at 10 Hz on the straight way from START to `end`."""
    return [
        JointState(stamp_ns=start_ns + i * SECOND // 10, position=START + f * (end - START), velocity=np.zeros(7))
        for i, f in enumerate(np.linspace(0, 1, num))
    ]


def splats_of(*balls: tuple[tuple[float, float, float], float]) -> SplatSet:
    num = len(balls)
    return SplatSet(
        centers=np.array([ball[0] for ball in balls], np.float32),
        radii=np.array([ball[1] for ball in balls], np.float32),
        colors=np.zeros((num, 3), np.float32),
        opacities=np.full(num, 0.9, np.float32),
        labels=np.zeros(num, np.uint8),
        density=np.zeros(num, np.float32),
    )


def grid_seen(is_seen: bool = True) -> OccupancyGrid:
    shape = (40, 40, 40)
    return OccupancyGrid(
        origin=np.array([-1.5, -1.5, -1.0]),
        voxel=0.1,
        log_odds=np.full(shape, -1.0, np.float32),
        num_updates=np.full(shape, int(is_seen), np.uint16),
        entity=np.zeros(shape, np.uint8),
    )


def write_scene(folder: Path, *snapshots: tuple[int, SplatSet], is_seen: bool = True) -> Path:
    folder.mkdir()
    writer = SceneWriter(folder, {"frame": "world"})
    for stamp_ns, splats in snapshots:
        writer.snapshot(stamp_ns, splats, grid_seen(is_seen), grid_seen(is_seen).states(0.3, 0.7))
    writer.finish(*snapshots[-1], grid_seen(is_seen))
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": snapshots[-1][0]}
    (folder / "run.json").write_text(json.dumps({"metrics": metrics}))
    return folder


@pytest.fixture
def arm(sample_data: Path) -> RobotModel:
    return RobotModel.from_urdf(
        sample_data / "tabletop" / "robot.urdf", sample_data / "tabletop" / "robot_spheres.yaml"
    )


@dataclass(kw_only=True)
class Desk:
    """A folder to work in, a source that stands for the log, and the robot's files."""

    folder: Path
    source: FakeSource
    robot: list[str]

    def replay(self, *arguments: str, out: str = "out") -> int:
        log = str(self.folder / "fake.mcap")
        return main(["replay", log, *self.robot, "-o", str(self.folder / out), *arguments])

    def metrics(self, out: str = "out") -> dict[str, Any]:
        metrics: dict[str, Any] = json.loads((self.folder / out / "summary.json").read_text())["metrics"]
        return metrics

    def rows(self, out: str = "out") -> list[dict[str, str]]:
        with (self.folder / out / "steps.csv").open() as stream:
            return list(csv.DictReader(stream))


@pytest.fixture
def desk(tmp_path: Path, sample_data: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    tabletop = sample_data / "tabletop"
    robot = ["--urdf", str(tabletop / "robot.urdf"), "--spheres", str(tabletop / "robot_spheres.yaml")]
    desk = Desk(folder=tmp_path, source=FakeSource(states=logged()), robot=robot)
    monkeypatch.setattr(source, "open_source", lambda path, options=None: desk.source)
    return desk


def clearance(arm: RobotModel, q: Float64, ball: tuple[tuple[float, float, float], float] = BALL) -> float:
    gap = np.linalg.norm(arm.sphere_centers(q) - np.array(ball[0]), axis=1) - arm.sphere_set.radii - ball[1]
    return float(gap[arm.moving_spheres].min())


def test_an_audit_measures_every_logged_state(desk: Desk, arm: RobotModel) -> None:
    desk.source.states = logged(START + 0.3)
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q") == 0
    found = [float(row["clearance_exact"]) for row in desk.rows()]
    np.testing.assert_allclose(found, [clearance(arm, s.position) for s in desk.source.states], atol=1e-6)
    assert desk.metrics()["min_clearance"] == pytest.approx(min(found), abs=1e-8)
    names = {"steps.csv", "events.json", "summary.json", "clearance.png", "run.json"}
    assert {path.name for path in (desk.folder / "out").iterdir()} == names


def test_each_state_is_measured_in_the_newest_snapshot_not_later(desk: Desk, arm: RobotModel) -> None:
    small, large = (BALL[0], 0.02), (BALL[0], 0.08)
    scene = write_scene(
        desk.folder / "scene",
        (SECOND // 4, splats_of(small)),
        (SECOND // 2, splats_of(large)),
        (SECOND, splats_of(BALL)),
    )
    assert desk.replay("--scene", str(scene), "-q") == 0
    rows = desk.rows()
    assert desk.metrics()["num_before_scene"] == 3 and len(rows) == 8
    expected = [clearance(arm, START, ball) for ball in [small] * 2 + [large] * 5 + [BALL]]
    np.testing.assert_allclose([float(row["clearance_exact"]) for row in rows], expected, atol=1e-6)


def test_a_log_that_ends_before_the_scene_is_known_cannot_be_evaluated(
    desk: Desk, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_scene(desk.folder / "scene", (5 * SECOND, splats_of(BALL)), (6 * SECOND, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q") == 5
    assert "all 11 joint states are earlier than the first known scene" in capsys.readouterr().err
    assert not (desk.folder / "out").exists() and not (desk.folder / "out.partial").exists()


def test_a_baked_field_says_nearly_the_same_and_certifies_less(desk: Desk, arm: RobotModel) -> None:
    box = Box(lower=np.array([-0.4, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.2]))
    (desk.folder / "field").mkdir()
    grid = bake(splats_of(BALL), box, replace(FieldConfig(), voxel=0.04), occupancy=grid_seen(), threads=1)
    write_npz(desk.folder / "field" / "field.npz", grid)
    assert desk.replay("--field", str(desk.folder / "field"), "-q") == 0
    row = desk.rows()[0]
    assert float(row["clearance_exact"]) == pytest.approx(clearance(arm, START), abs=2e-3)
    assert float(row["clearance_certified"]) <= clearance(arm, START) + 1e-6


def test_a_path_that_leaves_known_space_is_not_evaluated(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    box = Box(lower=np.array([-0.4, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.2]))
    seen = grid_seen()
    seen.num_updates[:, :, 15:] = 0  # above half a metre
    config = FieldConfig(voxel=0.04, unknown="nan")
    (desk.folder / "field").mkdir()
    write_npz(desk.folder / "field" / "field.npz", bake(splats_of(BALL), box, config, occupancy=seen, threads=1))
    assert desk.replay("--field", str(desk.folder / "field"), "-q", "--max-unknown", "1") == 5
    assert "the path leaves known space: at 11 of 11 states" in capsys.readouterr().err
    assert desk.metrics()["num_without_distance"] == 11
    assert {row["clearance_barrier"] for row in desk.rows()} == {""}
    driven = ("--field", str(desk.folder / "field"), "-q", "--max-unknown", "1", "--mode", "closed-loop")
    assert desk.replay(*driven, out="driven") == 5
    assert "the field has no distance there" in capsys.readouterr().err


def test_unknown_space_is_said_after_the_outputs_are_written(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)), is_seen=False)
    assert desk.replay("--scene", str(scene), "-q", "--require", "min_clearance>=9") == 5
    assert "100.0 % of the sphere centres lie in space no camera ever saw" in capsys.readouterr().err
    assert desk.metrics()["unknown_share"] == 1.0
    assert desk.replay("--scene", str(scene), "-q", "--max-unknown", "1", out="again") == 0


def test_a_closed_loop_reaches_the_logged_end_and_gates_on_it(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    end = START + np.array([0.5, 0.1, 0, 0, 0, 0, 0])
    desk.source.states = logged(end)
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    gates = ["--require", "goal_reached>=1", "--require", "num_hold<=0", "--require", "min_barrier_clearance>=0.019"]
    assert desk.replay("--scene", str(scene), "-q", "--json", "--mode", "closed-loop", *gates) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["goal_reached"] == 1 and printed["position_error"] <= 0.01
    rows = desk.rows()
    assert printed["num_steps"] == len(rows) == printed["num_solved"] + printed["num_relaxed"]
    assert all(float(row["residual"]) <= 1e-5 for row in rows)
    gate = ["--require", "min_clearance>=5"]
    assert desk.replay("--scene", str(scene), "-q", "--mode", "closed-loop", *gate, out="gated") == 1
    assert (desk.folder / "gated" / "steps.csv").read_bytes() == (desk.folder / "out" / "steps.csv").read_bytes()


def test_a_posture_can_be_the_goal(desk: Desk) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    goal = "--goal-joints=" + ",".join(str(v) for v in START + 0.1)
    assert desk.replay("--scene", str(scene), "-q", "--mode", "closed-loop", goal) == 0
    assert desk.metrics()["goal_reached"] == 1


def test_the_truth_is_reported_beside_the_scene(
    desk: Desk, sample_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    tabletop = sample_data / "tabletop"
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    out = desk.folder / "out"
    truth = ["--truth", str(tabletop / "truth.json")]
    log = str(tabletop / "log.mcap")
    assert main(["replay", log, *desk.robot, "--scene", str(scene), "-o", str(out), "-q", *truth]) == 0
    metrics = desk.metrics()
    recorded = json.loads((tabletop / "truth.json").read_text())["clearance"]["min"]
    assert metrics["min_clearance_true"] == pytest.approx(recorded, abs=1e-5)
    assert metrics["truth_num_compared_exact"] > 0
    assert metrics["truth_largest_over_exact"] > 0.05  # the scene of this test lacks the table


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--mode", "closed-loop", "--goal", "9,0,0,0,0,0,1"], 4, "goal: expected within"),
        (["--mode", "closed-loop", "--goal-joints", "0,0"], 4, "--goal-joints: expected 7 joints"),
        (["--mode", "closed-loop", "--start-time", "60"], 4, "give an earlier --start-time"),
        (["--mode", "closed-loop", "--set", "control.period=0"], 2, "control.period"),
        (["--mode", "closed-loop", "--frame", "nose"], 4, "no frame 'nose'"),
        (["--set", "control.perod=1"], 2, "did you mean control.period"),
        (["--lock", "joint7"], 2, "--lock joint7: expected JOINT=VALUE"),
        (["--lock", "nose=0"], 4, "no joint 'nose' to lock"),
        (["--truth", "nowhere.json"], 4, "nowhere.json"),
        (["--require", "clearence>=1"], 2, "unknown metric"),
    ],
)
def test_bad_input_is_one_line_with_its_code(
    desk: Desk, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q", *arguments) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (desk.folder / "out.partial").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "one of the arguments --field --scene is required"),
        (["--scene", "x", "--goal", "1,2,3"], "expected 7 numbers"),
        (["--scene", "x", "--goal", "0,0,1,0,0,0,2"], "unit quaternion"),
        (["--scene", "x", "--goal-joints", "a,b"], "expected numbers"),
        (["--scene", "x", "--base", "nan,0,0,0,0,0,1"], "finite"),
    ],
)
def test_usage_is_refused_before_anything_is_read(
    desk: Desk, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert desk.replay(*arguments) == 2
    assert words in capsys.readouterr().err


def test_a_start_in_collision_names_the_sphere(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    center = arm.sphere_centers(START)[-1]
    scene = write_scene(desk.folder / "scene", (0, splats_of((tuple(center), 0.01))))
    assert desk.replay("--scene", str(scene), "-q", "--mode", "closed-loop") == 5
    assert "got sphere hand[" in capsys.readouterr().err


def test_logs_that_do_not_fit_are_refused(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = str(write_scene(desk.folder / "scene", (0, splats_of(BALL))))
    desk.source = FakeSource(states=[], joint_names=())
    assert desk.replay("--scene", scene) == 4
    assert "expected joint states, got none" in capsys.readouterr().err
    desk.source = FakeSource(states=logged(), joint_names=tuple("abcdefg"))
    assert desk.replay("--scene", scene) == 4
    assert "joints not in the log: joint1" in capsys.readouterr().err
    desk.source = FakeSource(states=logged()[::-1])
    assert desk.replay("--scene", scene) == 4
    assert "expected a stamp not before" in capsys.readouterr().err
    desk.source = FakeSource(states=logged(), loss=LossReport(damaged=2))
    assert desk.replay("--scene", scene, "-q") == 3


def test_an_existing_output_is_kept_without_force(desk: Desk) -> None:
    scene = str(write_scene(desk.folder / "scene", (0, splats_of(BALL))))
    assert desk.replay("--scene", scene, "-q") == 0
    assert desk.replay("--scene", scene, "-q") == 2
    assert desk.replay("--scene", scene, "-q", "--force") == 0
