"""An audit: one verdict and one page of a recording, and what a second call does again."""

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import load_config
from splatctrl_cli.errors import UsageError, WriteError
from splatctrl_cli.evaluate.verdict import JudgedResult, Outcome, Reason, read_verdict, verdict_of
from splatctrl_cli.files.output import Stopwatch, write_json, write_run
from splatctrl_cli.jobs import audit as module
from splatctrl_cli.jobs.audit import AuditRequest, audit
from splatctrl_cli.jobs.compare.judged_runs import read_judged
from splatctrl_cli.jobs.robot import logged_robot
from splatctrl_cli.recording.source_options import SourceOptions
from tests.jobs.bake.baked import Said
from tests.recording.log.make_log import messages_of, write_raw
from tests.refused import expect_refusal

QUICK = ("scene.max_splats=800", "scene.first_iterations=10", "scene.iterations_per_step=1")
ALL = ("check", "scene", "replay", "report")
BASE = (0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0)


def test_one_call_leads_from_a_log_to_a_verdict_and_its_page(
    small_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = ["--urdf", str(small_recording / "robot.urdf"), "--spheres", str(small_recording / "robot_spheres.yaml")]
    settings = [word for setting in QUICK for word in ("--set", setting)]
    log, out = str(small_recording / "log.mcap"), tmp_path / "out"
    code, told = main(["audit", log, *robot, *settings, "-o", str(out)]), capsys.readouterr().out
    run, page = json.loads((out / "replay" / "run.json").read_text()), (out / "report.html").read_text()
    verdict, sentence = run["verdict"], run["verdict"]["sentence"]
    assert (code, told) == (5, f"{sentence}\n\npage: {out / 'report.html'}\n")
    assert verdict["exit_code"] == 5 and json.loads((out / "run.json").read_text())["verdict"] == verdict
    shared = [f"--set={setting}" for setting in QUICK]
    assert run["arguments"] == [
        *("replay", log, *robot, "-o", str(out / "replay"), *shared, "--scene", str(out / "scene"))
    ], "what makes the same again, and where a page finds scene and robot"
    said = (
        "<h1>audit of small/log.mcap</h1>",
        sentence.split(" (")[0],
        "check: PASSED (log.mcap",
        "<h2>Logged motion</h2>",
    )
    assert sorted(said, key=page.index) == [*said]
    assert 'id="data-replay"' in page and 'id="data-scene"' not in page, "the motion in 3-D"
    assert page.count('<figure class="pair">') == 4, "photo and render of each camera"
    assert main(["compare", str(out), str(out)]) == 0
    compared = read_judged(out).runs
    assert [*compared] == ["replay", "scene"] and compared["replay"].metrics["min_clearance"] is not None
    shutil.rmtree(out / "replay")
    (out / "scene" / "run.json").unlink()
    expect_refusal("a run of audit, which judges nothing", read_judged, out)


@dataclass(kw_only=True)
class Desk:
    """An audit whose steps leave only a verdict, by folder."""

    request: AuditRequest
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    num_runs: int = 0  # as a run's time, no two are alike
    requests: dict[str, Any] = field(default_factory=dict)  # by folder

    def steps_made(self, **changes: Any) -> tuple[str, ...]:
        """Steps that a call with changes makes."""
        return tuple(self.audit(**changes).document["made"])

    def audit(self, **changes: Any) -> JudgedResult:
        return audit(replace(self.request, **changes))

    def write(self, request: Any, command: str) -> None:
        out = request.out
        self.requests[out.name] = request
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        self.num_runs += 1
        outcome = self.outcomes.get(out.name, Outcome.PASSED)
        reason = Reason(criterion="clearance", outcome=outcome, sentence="as told")
        verdict = verdict_of(command, [reason], scope=out.name, passed="safe").as_dict()
        made = {"command": command, "config": {}, "inputs": {}, "metrics": {"num": self.num_runs}, "verdict": verdict}
        write_run(out, stopwatch=Stopwatch(), **made)


@pytest.fixture
def desk(small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    urdf = tmp_path / "arm.urdf"
    urdf.write_text((small_recording / "robot.urdf").read_text())
    log, spheres = small_recording / "log.mcap", small_recording / "robot_spheres.yaml"
    desk = Desk(request=AuditRequest(log=log, urdf=urdf, spheres=spheres, out=tmp_path / "out"))
    checked = verdict_of("check", [Reason(outcome=Outcome.PASSED, sentence="")]).as_dict()
    stand_ins: dict[str, Callable[..., Any]] = {
        "_check": lambda request: write_json(request.out / "check.json", {"verdict": checked, "findings": []}),
        "open_to_train": lambda *_: None,
        "open_scene": lambda *_: None,
        "render_newest": lambda *_: iter(()),
        "reconstruct": lambda request, _: desk.write(request, "reconstruct"),
        "replay": lambda request, _: desk.write(request, "replay"),
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(module, name, stand_in)
    return desk


def test_a_second_call_makes_only_what_its_changes_decide(desk: Desk) -> None:
    """The folder holds one run of each."""
    margin, splats = load_config(None, ["control.margin=0.03"]), load_config(None, ["scene.max_splats=900"])
    of_map, of_goal = ("scene", "replay", "report"), ("closed_loop", "report")
    calls: list[tuple[dict[str, Any], tuple[str, ...]]] = [
        *(({}, ALL), ({}, ()), ({"threads": 3}, ())),
        *(({"config": margin}, ("replay", "report")), ({"config": splats}, of_map), ({}, of_map)),
        *(({"goal_joints": (0.5,) * 7}, of_goal), ({"goal_joints": (0.4,) * 7}, of_goal)),
        *(({"seed": 1}, of_map), ({"seed": 1, "base": BASE}, ALL)),
        *(({"seed": 1, "base": BASE, "locked": {"joint1": 0.1}}, ALL), ({"seed": 1}, ALL)),
        ({"seed": 1, "force": True}, ALL),
    ]
    assert [desk.steps_made(**changes) for changes, _ in calls] == [made for _, made in calls]


def test_options_reach_every_step(desk: Desk) -> None:
    options, pose = SourceOptions(cameras=("cam1",)), (0.4, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0)
    given = {"options": options, "config": load_config(None, ["control.margin=0.03"]), "seed": 3, "threads": 2}
    robot = {"base": BASE, "locked": {"joint1": 0.1}, "packages": (Path("meshes"),)}
    desk.steps_made(**given, **robot, device="cpu", resume=True, goal=pose, frame="hand")
    scene, replay, driven = (desk.requests[name] for name in ("scene", "replay", "closed_loop"))
    expected = {"urdf": desk.request.urdf, "spheres": desk.request.spheres, "device": "cpu", **robot, **given}
    del expected["options"]
    for each in (scene, replay, driven):
        assert {name: getattr(each, name) for name in expected} == expected
    assert scene.resume and replay.options == driven.options == options
    assert replay.scene == driven.scene == desk.request.out / "scene"
    assert (replay.mode, replay.goal, replay.frame) == ("audit", None, None)
    assert (driven.mode, driven.goal, driven.frame, driven.start_time) == ("closed-loop", pose, "hand", "first-map")


def test_another_robot_repeats_every_step(desk: Desk) -> None:
    desk.steps_made()
    desk.request.urdf.write_text(desk.request.urdf.read_text().replace("<robot", "<!-- again --><robot"))
    assert desk.steps_made() == ALL


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("check.json", ("check",)),
        ("scene/run.json", ("scene", "report")),
        ("replay/run.json", ("replay", "report")),
        ("report.html", ("report",)),
    ],
)
def test_a_step_whose_file_was_changed_is_made_again(desk: Desk, name: str, made: tuple[str, ...]) -> None:
    desk.steps_made()
    (desk.request.out / name).write_text("{}")
    assert desk.steps_made() == made


def test_the_verdict_is_the_worse_one_of_logged_and_driven_motion(desk: Desk) -> None:
    goal = (0.5,) * 7
    assert desk.audit(goal_joints=goal).verdict.sentence == "replay: SAFE (replay)"
    for driven, code in ((Outcome.NOT_EVALUABLE, 5), (Outcome.FAILED, 1)):
        desk.outcomes["closed_loop"] = driven
        verdict = desk.audit(goal_joints=goal, force=True).verdict
        assert (verdict.scope, verdict.exit_code) == ("closed_loop", code)
    desk.outcomes["replay"] = Outcome.NOT_EVALUABLE
    assert desk.audit(goal_joints=goal, force=True).verdict.outcome is Outcome.FAILED
    page = (desk.request.out / "report.html").read_text()
    assert page.index("replay: FAILED (closed_loop)") < page.index("Logged motion") < page.index("Driven motion")
    words = json.loads((desk.request.out / "closed_loop" / "run.json").read_text())["arguments"]
    joints = f"--goal-joints={','.join(['0.5'] * 7)}"
    assert words[-5:] == ["--mode", "closed-loop", "--start-time", "first-map", joints]


def test_a_log_without_joints_has_its_map_and_check_alone(desk: Desk, tmp_path: Path) -> None:
    messages = [each for each in messages_of(desk.request.log) if each.topic.name != "/joint_states"]
    result = desk.audit(log=write_raw(tmp_path / "still.mcap", messages), urdf=None, spheres=None)
    assert (result.verdict.exit_code, result.document["made"]) == (5, ["check", "scene", "report"])
    assert result.verdict.sentence == (
        "audit: NOT EVALUABLE (still.mcap): joint states: still.mcap has none, so no motion is judged, only the "
        "recording (check: passed) and its map (reconstruct: safe, scene); record /joint_states"
    )
    assert result.verdict.sentence in result.document["page"].read_text()


def test_a_log_that_names_no_robot_is_refused_at_once(desk: Desk) -> None:
    words = "does not describe the robot; give it with --urdf FILE or --robot NAME"
    expect_refusal(words, desk.audit, urdf=None, error=UsageError)
    assert not desk.request.out.exists()


def test_a_folder_of_something_else_is_not_written_into(desk: Desk) -> None:
    desk.request.out.mkdir()
    (desk.request.out / "mine.txt").touch()
    words = r"out: was not written by splatctrl audit \(no steps.json\); give another --out"
    expect_refusal(words, desk.audit, error=UsageError)
    (desk.request.out / "mine.txt").unlink()
    desk.request.out.rmdir()
    desk.request.out.touch()
    expect_refusal("out: cannot be written: File exists", desk.audit, error=UsageError)


def test_a_page_that_cannot_be_written_fails_last_and_says_how_to_go_on(desk: Desk) -> None:
    page = desk.request.out / "report.html"
    page.mkdir(parents=True)
    (desk.request.out / "steps.json").write_text("{}")
    said = expect_refusal("is a folder, expected a file", desk.audit, error=WriteError)
    assert said.endswith(f"; move {page} away, and run the same command")
    page.rmdir()
    assert desk.steps_made() == ("report",)


def installed(monkeypatch: pytest.MonkeyPatch, files: Iterable[Path]) -> None:
    found = [SimpleNamespace(suffix=path.suffix, stem=path.stem, locate=lambda path=path: path) for path in files]
    packages = [SimpleNamespace(files=found), SimpleNamespace(files=None)]
    monkeypatch.setattr(logged_robot, "distributions", lambda: packages)


def test_a_robot_by_name_is_one_of_an_installed_package(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / name / "arm.urdf" for name in ("a", "b")]
    mixed = [tmp_path / "arm.urdf", tmp_path / "arm.stl", tmp_path / "z1.urdf"]
    installed(monkeypatch, mixed)
    assert desk.steps_made(urdf=None, robot="arm") == ALL
    assert desk.steps_made() == (), "the same robot by its file"
    for name, found, words in (
        ("panda", mixed, "--robot panda: expected one installed URDF of that name, got none; give one of: arm, z1"),
        ("arm", files, f"got 2; give one with --urdf: {files[0]}, {files[1]}"),
        ("arm", [], "got none; pip install example-robot-data"),
    ):
        installed(monkeypatch, found)
        expect_refusal(words, desk.audit, robot=name, error=UsageError)


def test_a_verdict_is_read_as_it_was_written() -> None:
    reason = Reason(criterion="a", outcome=Outcome.FAILED, sentence="b", place=(1.0, 2.0, 3.0), label="contact")
    verdict = verdict_of("replay", [reason], scope="c", notes=["d"], is_damaged=True, counts={"e": 1})
    assert read_verdict(json.loads(json.dumps(verdict.as_dict()))).as_dict() == verdict.as_dict()


def test_progress_names_each_step_by_its_command(desk: Desk) -> None:
    audit(desk.request, heard := Said())
    steps = [line.split(" /")[0] for line in heard.lines]
    assert steps == ["check", "$ splatctrl reconstruct", "$ splatctrl replay", "report"]
    audit(desk.request, again := Said())
    assert again.lines[0] == f"check: as before, {desk.request.out / 'check.json'}"
