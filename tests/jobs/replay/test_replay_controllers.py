"""A user's own controller in a replay; waypoints as a file has them, and detours around what is known."""

import json
import shutil
import subprocess
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import Config
from splatctrl_cli.jobs.replay.goal import goal_waypoints
from splatctrl_cli.jobs.replay.known_scene import certified_distance, splat_fields
from splatctrl_cli.jobs.replay.metrics import metric_scales
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import BALL, Desk, splats_of, write_scene
from tests.cli.test_replay_modes import ball_ahead, events, log_motion
from tests.jobs.stage import MOVE, QUARTER, Beside, Stage, decisive, passing
from tests.refused import expect_refusal
from tests.robot.test_fingers import ARM, FRANKA, robot

EXAMPLES = Path(__file__).parents[3] / "docs" / "controllers"
MODULE = """
    import json

    class Recorded:
        def __init__(self, start):
            self.velocities = iter(json.load(open("recorded.json")))

        def step(self, now):
            return next(self.velocities)

    class Constant:
        speed = 0.1

        def __init__(self, start):
            self.num = len(start.joints)

        def step(self, now):
            return [self.speed] + [0.0] * (self.num - 1)

    class Fast(Constant):
        speed = 2.5

    class Raises(Constant):
        def step(self, now):
            if now.stamp_ns >= 300_000_000:
                raise RuntimeError("out of ideas")
            return super().step(now)
    """


@pytest.fixture
def stage(desk: Desk, arm: RobotModel, monkeypatch: pytest.MonkeyPatch) -> Stage:
    (desk.folder / "own.py").write_text(textwrap.dedent(MODULE))
    monkeypatch.chdir(desk.folder)
    return Stage(desk=desk, arm=arm, map_stamps=tuple(i * QUARTER for i in range(16)))


def reason_of(verdict: dict[str, Any], criterion: str = "controller") -> dict[str, Any]:
    (found,) = [reason for reason in verdict["reasons"] if reason["criterion"] == criterion]
    return dict(found)


def alike(a: str, b: str) -> bool:
    try:
        return float(a) == pytest.approx(float(b), abs=1e-5)
    except ValueError:
        return a == b


@pytest.mark.parametrize("mode", ["open-loop", "closed-loop"])
def test_the_recorded_commands_of_ours_make_the_same_steps(stage: Stage, mode: str) -> None:
    desk = stage.desk
    log_motion(desk)
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL, ball_ahead(stage.arm, 0.01))))
    run = ("--scene", str(scene), "-q", "--mode", mode, "--set", "control.max_time=2")
    assert desk.replay(*run, out="ours") == 0
    ours = desk.rows("ours")
    rows = [[float(row[f"v_joint{j}"]) for j in range(1, 8)] for row in ours if row["v_joint1"]]  # of nine digits
    (desk.folder / "recorded.json").write_text(json.dumps(rows))
    assert desk.replay(*run, "--controller", "own:Recorded") == 0
    theirs, metrics, before = desk.rows(), desk.metrics(), desk.metrics("ours")
    assert list(ours[0]) == list(theirs[0]) and {row["rung"] for row in theirs} == {"outside"}
    unlike = {
        name for our, their in zip(ours, theirs, strict=True) for name in our if not alike(our[name], their[name])
    }
    assert unlike <= {"rung", "scale", "slack", "relaxed", "intervening", "multipliers", "residual", "num_rows"}
    assert set(metrics) == set(metric_scales(mode, ("exact", "barrier"), has_truth=False)) == set(before)
    found = [metrics[name] for name in ("min_clearance", "intervention_share", "num_solved")]
    assert found == [pytest.approx(before["min_clearance"], abs=1e-6), None, 0]


@pytest.mark.parametrize("mode", ["open-loop", "closed-loop"])
def test_the_commands_of_the_log_are_judged_as_a_controllers(
    stage: Stage, mode: str, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = [k / 10 * MOVE for k in range(11)]
    stage.states = [replace(state, commanded_velocity=v) for state, v in zip(passing(), commands, strict=True)]
    run = ("--controller", "recorded", "--set", "control.max_time=0.5")
    _, verdict = stage.judged(*run, mode=mode)
    assert ", controller recorded" in verdict["scope"]
    for row in stage.desk.rows()[:40]:
        assert float(row["v_joint1"]) == pytest.approx(commands[min(int(float(row["time_s"]) * 10 + 1e-6), 10)][0])
    stage.states = passing()
    assert stage.judged(*run, mode=mode, scene=stage.desk.folder / "scene")[0] == 4
    assert "the log has no commanded velocities; name their columns" in capsys.readouterr().err


def test_a_controller_that_is_good_is_safe_and_named(stage: Stage) -> None:
    shutil.copy(EXAMPLES / "reach.py", stage.desk.folder)
    stage.states = passing(0.1 * MOVE)
    options = ("--controller", "reach:Reach", "--controller-twice")
    verdict = stage.expect(0, {}, *options, mode="closed-loop", label="safe")
    num, reason = stage.desk.metrics()["num_steps"], reason_of(verdict)
    assert (reason["sentence"], reason["count"]) == (f"all {num} steps answered", num)
    assert f"{num} states, controller reach:Reach" in verdict["sentence"]
    assert stage.desk.json("summary.json")["about"]["controller"] == "reach:Reach"


def test_a_motion_of_its_own_is_judged_by_every_criterion(stage: Stage) -> None:
    stage.states = passing(0.4 * MOVE)
    stage.balls = [*stage.balls, Beside(0.005)]
    code, verdict = stage.judged("--controller", "own:Constant", "--set", "control.max_time=4", mode="closed-loop")
    assert code == 1 and {"clearance", "goal"} <= set(decisive(verdict))
    assert {event["kind"] for event in events(stage.desk)} >= {"below-margin", "row-broken"}


@pytest.mark.parametrize("mode", ["open-loop", "closed-loop"])
def test_commands_above_the_velocity_limits_fail(stage: Stage, mode: str) -> None:
    fast = ("--controller", "own:Fast", "--set", "control.max_time=0.2")
    code, verdict = stage.judged(*fast, mode=mode)
    assert (code, decisive(verdict)["velocity limits"]) == (1, "failed")
    reason = reason_of(verdict, "velocity limits")
    assert reason["value"] == pytest.approx(2.5 / 2.175, abs=1e-3) and "joint1" in reason["sentence"]


@pytest.mark.parametrize(("mode", "answers", "states"), [("open-loop", 3, 11), ("closed-loop", 30, 31)])
def test_one_that_fails_on_the_way_is_named_and_judged_until_then(
    stage: Stage, mode: str, answers: int, states: int
) -> None:
    code, verdict = stage.judged("--controller", "own:Raises", mode=mode)
    assert (code, verdict["label"], len(stage.desk.rows())) == (1, "controller failed", states)
    reason = reason_of(verdict)
    assert reason["sentence"] == f"crashed: exit status 1: RuntimeError: out of ideas; after {answers} answers,"
    assert (reason["time_s"], reason["count"]) == (pytest.approx(0.3), answers + 1)
    assert not any("max_detours" in reason["remedy"] for reason in verdict["reasons"])
    assert "answers, at 0.30 s" in verdict["sentence"]


def test_one_that_fails_at_once_is_still_judged(stage: Stage) -> None:
    code, verdict = stage.judged(
        "--controller-command", "sh -c 'read a; echo {\\\"protocol\\\":1}'", mode="closed-loop"
    )
    assert (code, verdict["label"], len(stage.desk.rows())) == (1, "controller failed", 1)
    assert "ended: exit status 0; after 0 answers, at 0.00 s" in verdict["sentence"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--controller", "own:Nobody"), 4, "own:Nobody: at the start: crashed: exit status 1: module own ("),
        (("--controller-command", "./nobody 3"), 4, "./nobody 3: cannot be started: No such file or directory"),
        (("--controller", "own"), 2, "--controller: expected module:Class, got 'own'"),
        (("--controller-command", "it 'there"), 2, "No closing quotation; close the quotes"),
        (("--controller-command", " "), 2, "expected a program and its arguments, got nothing"),
        (("--controller", "own:Fast", "--controller-command", "x"), 2, "not allowed with argument --controller"),
        (("--controller", "own:Fast", "--mode", "audit"), 2, "expected --mode open-loop or closed-loop"),
        (("--controller-twice",), 2, "expected a controller"),
        (("--controller-step-limit", "3"), 2, "expected a controller"),
    ],
)
def test_what_cannot_be_meant_or_started_is_refused(
    stage: Stage, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], code: int, words: str
) -> None:
    assert stage.judged(*arguments, mode="closed-loop")[0] == code
    assert words in capsys.readouterr().err
    assert not (stage.desk.folder / "out").exists()


def test_the_examples_drive_alike(stage: Stage) -> None:
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler (c++): docs/controllers/reach.cpp is not tried")
    program, source = stage.desk.folder / "reach", EXAMPLES / "reach.cpp"
    subprocess.run([compiler, "-std=c++17", "-Wall", "-Wextra", "-Werror", "-o", program, source], check=True)
    shutil.copy(EXAMPLES / "reach.py", stage.desk.folder)
    log_motion(stage.desk, 0.4 * MOVE)
    stage.states = stage.desk.source.states
    stage.balls = [*stage.balls, Beside(0.03)]
    scene = stage.scene()
    in_cpp, in_python = ("--controller-command", "./reach"), ("--controller", "reach:Reach")
    for mode, more in (("closed-loop", ["--controller-twice"]), ("open-loop", [])):
        codes = [stage.judged(*in_python, mode=mode, scene=scene)[0]]
        python = stage.desk.rows()
        codes.append(stage.judged(*in_cpp, *more, mode=mode, scene=scene)[0])
        assert_same_commands(stage.desk.rows(), python)
        if mode == "closed-loop":
            assert codes == [0, 0] and float(python[-1]["position_error"]) < 0.01
    assert float(python[0]["v_joint1"]) > 0.1  # it goes along with the log


def assert_same_commands(a: list[dict[str, str]], b: list[dict[str, str]]) -> None:
    assert len(a) == len(b)
    for name in (f"v_joint{j}" for j in range(1, 8)):
        assert [float(row[name]) for row in a] == pytest.approx([float(row[name]) for row in b], abs=1e-6)


END = np.array([0.01, 0.02, 0.03, 0.04])  # of shoulder, wrist and two fingers


def goal(folder: Path, moved: list[str], *values: float) -> Float64:
    urdf = robot(folder, *ARM, *FRANKA)
    spheres = SphereSet(links=("l",), centers=np.zeros((1, 3)), radii=np.full(1, 0.01))
    model = RobotModel.from_urdf(urdf, spheres).moved_by(moved)
    request = ReplayRequest(log=urdf, urdf=urdf, out=urdf, mode="closed-loop", goal_joints=values)
    (waypoint,) = goal_waypoints(request, model, "hand", END[: model.num_joints])
    assert waypoint.T_world_goal.tolist() == model.frame_pose(waypoint.posture, "hand").tolist()
    return waypoint.posture


def test_fingers_take_no_value_or_the_logged_one_or_their_own(
    tmp_path: Path,
) -> None:
    arm = ["shoulder", "wrist"]
    assert goal(tmp_path, arm, 0.03, 0.04).tolist() == [0.03, 0.04]
    expect_refusal(
        r"--goal-joints: expected 2 joints \(shoulder, wrist\), got shape \(4,\)", goal, tmp_path, arm, 0, 0, 0, 0
    )
    moved = [*arm, "left", "right"]
    assert goal(tmp_path, moved, 0.03, 0.04).tolist() == [0.03, 0.04, 0.03, 0.04]
    assert goal(tmp_path, moved, 0.03, 0.04, 0.0, 0.01).tolist() == [0.03, 0.04, 0.0, 0.01]


def test_what_is_planned_in_never_exceeds_the_exact_distance_and_the_kernel_field_is_no_proof() -> None:
    """Beside and between splats of many sizes: certified <= the exact distance in float64 everywhere, which is
    1-Lipschitz; the controller's own field is steeper than that somewhere, so nothing follows from its samples.
    """
    steepest = 0.0
    for seed in range(12):
        random = np.random.default_rng(seed)
        centers = random.uniform(-1.5, 1.5, (200, 3)).astype(np.float32)
        centers[100:] = centers[0] + random.normal(size=(100, 3)) * 0.03
        radii = random.uniform(0.002, 0.02, 200).astype(np.float32)
        fields = splat_fields(splats_of(*zip(map(tuple, centers), map(float, radii), strict=True)), Config(), 1)  # type: ignore[arg-type]
        near, far = centers[100:] + random.normal(size=(100, 3)) * 0.02, random.uniform(-3, 3, (500, 3))
        points = np.concatenate([far, near, centers.astype(float)])
        gap = np.linalg.norm(points[:, None] - centers.astype(np.float64), axis=2) - radii.astype(np.float64)
        certified = certified_distance(fields)(points)
        assert np.all(certified < gap.min(axis=1)) and np.all(certified > gap.min(axis=1) - 3e-5)
        near = points + random.normal(size=points.shape) * 2e-3
        change = np.abs(fields.barrier.query(near)[0] - fields.barrier.query(points)[0])
        steepest = max(steepest, float(np.max(change / np.linalg.norm(near - points, axis=1))))
    assert steepest > 1.2
