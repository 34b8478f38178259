"""``splatctrl reconstruct --resume``: whatever stops a run, its rest ends in the same bytes; how far a run is."""

import ast
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import splatctrl_cli
from splatctrl_cli.cli.main import main
from splatctrl_cli.config import SceneConfig
from splatctrl_cli.formats.scene import scene_writer
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.jobs.reconstruct import reconstruction
from splatctrl_cli.jobs.reconstruct.kept_maps import KeptMaps
from splatctrl_cli.jobs.running import progress
from splatctrl_cli.jobs.running.progress import Wait, duration
from splatctrl_cli.scene.fitter import SceneFitter
from tests.jobs.bake.baked import Said
from tests.jobs.stage import contents, failing
from tests.robot.shapes import written

pytestmark = pytest.mark.usefixtures("unchecked")

DTU = Path(__file__).parents[3] / "sample_data" / "dtu"
FAST = [
    *("--max-splats", "400", "--set", "scene.first_iterations=20", "--set", "scene.iterations_per_step=4"),
    *("--set", "scene.refine_iterations=30", "--set", "scene.checkpoint_period=0"),
    *("--set", "occupancy.voxel=0.04", "-q"),
]


@pytest.fixture(scope="module")
def whole(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What a run that is left alone gives, by input."""
    found = {}
    for kind in ("log", "dtu"):
        out = tmp_path_factory.mktemp("whole") / kind
        assert main(command(recording, kind, out)) == 0
        found[kind] = contents(out)
    return found


def command(recording: Path, kind: str, out: Path) -> list[str]:
    robot = ["--urdf", str(recording / "robot.urdf"), "--spheres", str(recording / "robot_spheres.yaml")]
    given = {
        "log": [str(recording / "log.mcap"), "--cameras", "cam0,cam1", *robot],
        "dtu": ["--dtu", str(DTU), "--holdout", "2,3,4,5,6,7"],
    }
    return ["reconstruct", *given[kind], "-o", str(out), *FAST]


PLACES = [
    *(("log", "savez", 1, False), ("log", "savez", 7, True), ("log", "write_states", 5, True)),
    *(("log", "write_occupancy", 1, True), ("dtu", "savez", 4, True), ("dtu", "write_ply", 1, True)),
]


@pytest.mark.parametrize(("kind", "name", "when", "has_checkpoint"), PLACES)
def test_a_run_stopped_while_it_writes_goes_on_to_the_same_bytes(
    recording: Path,
    whole: dict[str, dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
    name: str,
    when: int,
    has_checkpoint: bool,
) -> None:
    given = command(recording, kind, tmp_path / "scene")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_writer, name, failing(getattr(scene_writer, name), when, KeyboardInterrupt()))
        assert main(given) == 130
    (line,) = capsys.readouterr().err.splitlines()
    assert ("scene.partial is kept" in line) == has_checkpoint
    assert not (tmp_path / "scene").exists()
    assert main([*given, "--resume"]) == 0
    assert contents(tmp_path / "scene") == whole[kind]
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_a_budget_left_at_its_default_grows_to_what_the_first_frames_show(
    recording: Path, whole: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A default of 200 was left alone; four times as many at most. A stopped run keeps it; what is asked for, too."""
    assert whole["log"]["run.json"]["config"]["scene"]["max_splats"] == 400
    monkeypatch.setattr(reconstruction, "SceneConfig", lambda: SceneConfig(max_splats=200))
    given = [*command(recording, "log", tmp_path / "scene"), "--max-splats", "200"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_writer, "savez", failing(scene_writer.savez, 2, KeyboardInterrupt()))
        assert main(given) == 130
    assert main([*given, "--resume"]) == 0
    assert json.loads((tmp_path / "scene" / "run.json").read_text())["config"]["scene"]["max_splats"] == 800
    assert main([*command(recording, "log", tmp_path / "whole"), "--max-splats", "200"]) == 0
    assert contents(tmp_path / "scene") == contents(tmp_path / "whole")


def test_a_full_disk_is_exit_code_6_and_what_was_written_goes_on(
    recording: Path, whole: dict[str, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = command(recording, "log", tmp_path / "scene")
    full = OSError(28, "No space left on device", str(tmp_path / "scene.partial" / "snapshots" / "000003.ply"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_writer, "write_ply", failing(scene_writer.write_ply, 4, full))
        assert main(given) == 6
    (line,) = capsys.readouterr().err.splitlines()
    assert "000003.ply: writing failed: No space left" in line and "--resume" in line
    assert main([*given, "--resume"]) == 0
    assert contents(tmp_path / "scene") == whole["log"]


def test_a_file_size_limit_is_a_full_disk_too(recording: Path, tmp_path: Path) -> None:
    limited = "import resource, sys; sys.dont_write_bytecode = True; "
    limited += "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)); "
    limited += "from splatctrl_cli.cli.main import main; sys.exit(main(sys.argv[1:]))"
    words = [sys.executable, "-B", "-c", limited, *command(recording, "log", tmp_path / "scene")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (6, 1)
    assert "writing failed: File too large" in done.stderr
    assert not list(tmp_path.iterdir())  # no checkpoint was whole


# Kills itself within the time step that follows a number of audited ones: from outside, a quick run may end before.
KILLED = """
import os, signal, sys
from pathlib import Path
from splatctrl_cli.cli.main import main
from splatctrl_cli.scene.fitter import SceneFitter
audit, num_rows, number, step = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), SceneFitter.step
def killed(*given):
    row = step(*given)
    if audit.is_file() and audit.read_bytes().count(b"\\n") >= num_rows:
        os.kill(os.getpid(), number)
    return row
SceneFitter.step = killed
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(sys.argv[4:]))
"""


def test_a_killed_process_goes_on_to_the_same_bytes_with_another_number_of_threads(
    recording: Path, whole: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    given = command(recording, "log", tmp_path / "scene")
    audit = str(tmp_path / "scene.partial" / "audit.jsonl")
    for threads, num_rows, number in (("1", 2, signal.SIGKILL), ("4", 4, signal.SIGINT)):
        words = [sys.executable, "-c", KILLED, audit, str(num_rows), str(int(number)), *given]
        done = subprocess.run(
            [*words, "--resume", "--threads", threads], capture_output=True, text=True, check=False, timeout=120
        )
        assert done.returncode == (130 if number == signal.SIGINT else -number), done.stderr
        assert not (tmp_path / "scene").exists()
    assert main([*given, "--resume"]) == 0
    assert contents(tmp_path / "scene") == whole["log"]


@pytest.fixture(scope="module")
def stopped(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that stopped in its fourth time step."""
    out = tmp_path_factory.mktemp("stopped") / "scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SceneFitter, "step", failing(SceneFitter.step, 4, KeyboardInterrupt()))
        assert main(command(recording, "log", out)) == 130
    return out.with_name("scene.partial")


@pytest.fixture
def interrupted(recording: Path, stopped: Path, tmp_path: Path) -> list[str]:
    """The command of that run, its folder copied."""
    shutil.copytree(stopped, tmp_path / "scene.partial")
    return command(recording, "log", tmp_path / "scene")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (["--set", "scene.lr_color=0.02"], "scene.lr_color was 0.01, is 0.02"),
        (["--set", "scene.checkpoint_period=1"], "scene.checkpoint_period was 0.0, is 1.0"),
        (["--seed", "3"], "--seed was 0, is 3"),
        (["--cameras", "cam0"], "--cameras was cam0,cam1, is cam0"),
        (["--box=-1,-1,-1,1,1,1"], "--box was not given"),
        (["VERSION"], "splatctrl was"),
        (["LOG"], "sha256 of log.mcap was"),
        (["URDF"], "--urdf was"),
    ],
)
def test_a_run_goes_on_only_as_what_it_was(
    recording: Path,
    interrupted: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    changed: list[str],
    said: str,
) -> None:
    partial, given = tmp_path / "scene.partial", list(interrupted)
    before = {p: p.read_bytes() for p in partial.rglob("*") if p.is_file()}
    if changed == ["VERSION"]:
        monkeypatch.setattr("splatctrl_cli.jobs.running.device.__version__", "99")
    elif changed == ["URDF"]:
        given[given.index("--urdf") + 1] = str(written(tmp_path, (recording / "robot.urdf").read_text() + "\n"))
    elif changed == ["LOG"]:
        few = ["--duration", "0.6", "--width", "32", "--height", "24"]
        assert main(["simulate", "-o", str(tmp_path / "b"), *few]) == 0
        given[1] = str(tmp_path / "b" / "log.mcap")
    else:
        given += changed
    capsys.readouterr()
    assert main([*given, "--resume"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert before == {p: p.read_bytes() for p in partial.rglob("*") if p.is_file()}


def test_without_resume_a_run_starts_over_and_says_so(
    interrupted: list[str], whole: dict[str, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main([word for word in interrupted if word != "-q"]) == 0
    assert "an interrupted run is replaced" in capsys.readouterr().err
    assert contents(tmp_path / "scene") == whole["log"]


def test_resume_without_anything_to_go_on_from_starts_at_the_beginning(
    recording: Path, whole: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    given = command(recording, "dtu", tmp_path / "scene")
    assert main([*given, "--resume"]) == 0
    assert contents(tmp_path / "scene") == whole["dtu"]
    assert main([*given, "--resume"]) == 2  # it is whole: nothing is replaced without --force


@pytest.mark.parametrize(
    ("settings", "news", "taken"),
    [
        (["scene.snapshot_every=2"], [], [0, 2, 4]),
        (["scene.snapshot_period=0.5"], [], [0, 3, 5]),
        (["scene.snapshot_every=3", "scene.snapshot_period=0.3"], [], [0, 3]),
        (["scene.snapshot_every=3"], [4, 5], [0, 3, 4, 5]),
    ],
)
def test_snapshots_are_taken_by_count_by_time_and_of_new_obstacles(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    settings: list[str],
    news: list[int],
    taken: list[int],
) -> None:
    """news: steps with a new obstacle."""
    monkeypatch.setattr(KeptMaps, "shows_news", lambda _, fitter: fitter.num_steps - 1 in news)
    given = [word for setting in settings for word in ("--set", setting)]
    assert main([*command(recording, "log", tmp_path / "scene"), "--cameras", "cam0", *given]) == 0
    scene = open_scene(tmp_path / "scene")
    stamps = [json.loads(line)["stamp_ns"] for line in (scene.path / "audit.jsonl").read_text().splitlines()]
    assert (len(stamps), [s.stamp_ns for s in scene.snapshots]) == (6, [stamps[k] for k in taken])


@pytest.mark.parametrize(
    ("num", "steps", "num_lines", "first", "last"),
    [
        (300, [0.5] * 300, 16, "20 of 300 iterations, about 2 min left", "300 of 300 iterations"),
        (60, [180.0, 5.0, 5.0], 3, "1 of 60 iterations", "3 of 60 iterations, about 5 min left"),
        (3, [0.0] * 5, 1, "", ""),
    ],
    ids=["long", "a first step that prepares the others", "short"],
)
def test_a_wait_is_announced_and_says_how_long_it_still_is(
    monkeypatch: pytest.MonkeyPatch, num: int, steps: list[float], num_lines: int, first: str, last: str
) -> None:
    now, said = [0.0], Said()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    wait = Wait(said, "fits views", "iterations", num).announce()
    for seconds in steps:
        now[0] += seconds
        wait.step()
    assert (len(said.lines), said.lines[0]) == (num_lines, f"fits views: {num} iterations")
    assert said.lines[1:2] + said.lines[-1:] == [f"fits views: {words}" for words in (first, last)] or not first


def test_a_wait_of_unknown_length_tells_what_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    now, said = [0.0], Said()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    wait = Wait(said, "scores cam3", "views").announce()
    now[0] = 11.0
    wait.at(7)
    assert said.lines == ["scores cam3", "scores cam3: 7 views"]


@pytest.mark.parametrize(("seconds", "said"), [(0.2, "1 s"), (40, "40 s"), (340, "6 min"), (5000, "1 h 23 min")])
def test_durations_are_said_as_a_person_does(seconds: float, said: str) -> None:
    assert duration(seconds) == said


def warnings_in(path: Path) -> list[tuple[str, str]]:
    """The constant text of each f-string or string in a file that is a warning line."""
    texts, source = [], path.read_text(encoding="utf-8")
    nodes = [*ast.walk(ast.parse(source))] if "warning: " in source else []
    within = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in (node for node in nodes if id(node) not in within):
        parts = node.values if isinstance(node, ast.JoinedStr) else [node] if isinstance(node, ast.Constant) else []
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in parts)
        if "warning: " in text and text != "warning: {}":
            texts.append((path.name, text))
    return texts


def test_every_warning_has_a_remedy() -> None:
    found = [text for path in sorted(Path(splatctrl_cli.__file__).parent.rglob("*.py")) for text in warnings_in(path)]
    assert len(found) > 6
    assert [text for text in found if ";" not in text[1] and not text[1].endswith("{}")] == []
