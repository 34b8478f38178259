"""What commands that judge tell CI: --junit, and on GitHub annotations and a summary; and what `compare` says of two
runs.
"""

import ast
import importlib
import json
import shutil
from pathlib import Path
from types import FunctionType
from typing import get_type_hints

import pytest
from junitparser import Error, Failure, JUnitXml, TestSuite

from splatctrl_cli import __version__
from splatctrl_cli.cli import check, demo
from splatctrl_cli.cli.commands import COMMANDS
from splatctrl_cli.evaluate.verdict import JudgedResult, Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.jobs.demo import DemoRequest, Perform
from tests.cli.here import splatctrl
from tests.recording.log.make_log import LogRecipe, make_log

CLI = Path(check.__file__).parent


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_log(tmp_path_factory.mktemp("log") / "log.mcap", LogRecipe(num_frames=12, tf_frames=6))


@pytest.fixture(autouse=True)
def outside_of_github(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY", "GITHUB_WORKSPACE"):
        monkeypatch.delenv(name, raising=False)


def suite_in(path: Path) -> TestSuite:
    (suite,) = JUnitXml.fromfile(str(path))
    return suite


@pytest.fixture
def summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """On GitHub: the file of a job's summary."""
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary.md"))
    return tmp_path / "summary.md"


def test_every_command_that_concludes_takes_junit() -> None:
    """A function concludes if it shows a verdict, directly or through another function of its file."""
    concluding = set()
    for path in CLI.glob("*.py"):
        functions = {
            node.name: node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)
        }
        texts = {name: ast.unparse(node) for name, node in functions.items()}
        shows = {name for name, text in texts.items() if ".show(" in text}
        shows |= {name for name, text in texts.items() if any(f"{other}(" in text for other in shows)}
        concluding |= {f"{path.stem}:{name}" for name in shows if has_a_verdict(path.stem, functions[name])}
    leaves = [leaf for command in COMMANDS.values() for leaf in (command.actions or {"": command}).values()]
    assert {leaf.run for leaf in leaves if leaf.judges} == {leaf.run for leaf in leaves} & concluding
    assert sum(leaf.judges for leaf in leaves) >= 8


def has_a_verdict(module: str, node: ast.FunctionDef) -> bool:
    """It makes a JudgedResult, or calls a job that does."""
    names = {
        each.func.id for each in ast.walk(node) if isinstance(each, ast.Call) and isinstance(each.func, ast.Name)
    }
    found = [getattr(importlib.import_module(f"splatctrl_cli.cli.{module}"), name, None) for name in names]
    returned = [get_type_hints(job).get("return") for job in found if isinstance(job, FunctionType)]
    kinds = [kind for kind in returned if isinstance(kind, type)]
    return "JudgedResult" in names or any(issubclass(kind, JudgedResult) for kind in kinds)


def test_a_verdict_is_a_suite_of_its_recording(log: Path, tmp_path: Path) -> None:
    told = splatctrl("check", log, "--fail-on", "warning", "--junit", tmp_path / "j.xml", "--json")
    suite = suite_in(tmp_path / "j.xml")
    criteria = {reason["criterion"]: reason["outcome"] for reason in json.loads(told.stdout)["verdict"]["reasons"]}
    assert (told.returncode, suite.name) == (1, str(log)) and {case.name for case in suite} == set(criteria)
    failures = {case.name for case in suite if any(isinstance(result, Failure) for result in case.result)}
    assert failures == {name for name, outcome in criteria.items() if outcome == "failed"} != set()
    assert {case.classname for case in suite} == {f"{log}/check"}
    assert {p.name: p.value for p in suite.properties()} == {
        "splatctrl": __version__,
        "command": "check",
        "exit code": "1",
        "label": "failed",
    }
    assert suite.time > 0


@pytest.mark.parametrize(
    ("words", "code", "name", "said"),
    [
        (["check", "{log}", "--quik"], 2, "wrong usage", "did you mean --quick?"),
        (["check", "{log}.missing"], 4, "input unusable", "no such file or folder"),
        (["robot", "check", "--urdf", "{log}"], 4, "input unusable", "log.mcap"),
    ],
)
def test_a_command_that_cannot_run_is_one_error(
    log: Path, tmp_path: Path, words: list[str], code: int, name: str, said: str
) -> None:
    words = [word.format(log=log) for word in words]
    told = splatctrl(*words, "--junit", tmp_path / "j.xml")
    splatctrl(*words, f"--junit={tmp_path / 'same.xml'}")
    assert [case.name for case in suite_in(tmp_path / "same.xml")] == [name]
    (case,) = suite_in(tmp_path / "j.xml")
    (error,) = case.result
    assert (told.returncode, case.name, type(error)) == (code, name, Error) and said in error.message
    assert f"splatctrl: {error.message}\n" == told.stderr


@pytest.mark.parametrize(
    ("raised", "code", "name"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("x"), 70, "internal error"),
        (OSError(28, "No space left on device", "out/a"), 6, "writing failed"),
    ],
)
def test_a_command_that_is_stopped_is_one_error(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raised: BaseException, code: int, name: str
) -> None:
    def stopped(request: object) -> None:
        raise raised

    monkeypatch.setattr(check, "check", stopped)
    told = splatctrl("check", log, "--junit", tmp_path / "j.xml")
    (case,) = suite_in(tmp_path / "j.xml")
    assert (told.returncode, case.name, case.classname) == (code, name, f"{log}/check")
    assert isinstance(case.result[0], Error)


def test_a_report_replaces_a_report_and_nothing_else(log: Path, tmp_path: Path) -> None:
    for _ in range(2):
        assert splatctrl("check", log, "--junit", tmp_path / "j.xml").returncode == 0
    before = log.read_bytes()
    told = splatctrl("check", log, "--junit", log)
    assert (told.returncode, log.read_bytes()) == (2, before)
    assert told.stderr == f"splatctrl: {log}: would replace the input {log}; give another --junit\n"


def test_a_report_inside_the_output_is_refused(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    told = splatctrl("reconstruct", log, "-o", out, "--junit", out / "j.xml")
    assert (told.returncode, out.exists()) == (2, False)
    assert "j.xml: is in --out, which appears whole; put it next to that folder" in told.stderr


def test_on_github_a_command_annotates_and_sums_up_and_its_json_is_whole(
    log: Path, summary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GITHUB_WORKSPACE", str(log.parent))
    told = splatctrl("check", log, "--fail-on", "warning", "--json")
    assert json.loads(told.stdout)["exit_code"] == told.returncode == 1
    assert "\n::error file=log.mcap,title=" in told.stderr
    assert "criteria passed, " in summary.read_text()
    told = splatctrl("check", log, "--quik")
    assert told.stderr.splitlines()[1].startswith("::error title=check%3A wrong usage (error)::check: unrecognized")
    assert "did you mean --quick?" in summary.read_text()
    assert splatctrl("info", log, "--quik").stderr.count("\n") == 1, "it judges nothing"


def test_a_demo_tells_of_itself_and_not_of_its_steps(
    log: Path, tmp_path: Path, summary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Reason(criterion="replay", outcome=Outcome.PASSED, sentence="expected 'failed', got 'failed'")

    def one_step(request: DemoRequest, perform: Perform, progress: object) -> Verdict:
        assert perform(["check", str(log), "--fail-on", "warning"], request.out) == "failed"
        return verdict_of("demo", [whole])

    monkeypatch.setattr(demo, "demo", one_step)
    told = splatctrl("demo", "-o", tmp_path / "out", "--junit", tmp_path / "j.xml")
    assert (told.returncode, "::error" in told.stderr, summary.read_text().count("###")) == (0, False, 1)
    assert [case.name for case in suite_in(tmp_path / "j.xml")] == ["replay"]


def test_a_summary_that_cannot_be_written_is_said_and_changes_nothing(log: Path, summary: Path) -> None:
    summary.mkdir()
    told = splatctrl("check", log)
    assert (told.returncode, "GITHUB_STEP_SUMMARY: cannot be written" in told.stderr) == (0, True)


@pytest.fixture
def audits(older: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A replay, and a worse one."""
    shutil.copytree(older / "audit", tmp_path / "worse")
    run = json.loads((tmp_path / "worse" / "run.json").read_text())
    run["metrics"] |= {"min_clearance": 0.001, "min_self_clearance": 0.06, "num_states": 7}
    run["config"]["control"]["margin"] = 0.03
    (tmp_path / "worse" / "run.json").write_text(json.dumps(run))
    return older / "audit", tmp_path / "worse"


def test_a_regression_exits_with_1_and_is_a_failure_in_junit(audits: tuple[Path, Path], tmp_path: Path) -> None:
    told = splatctrl("compare", *audits, "--junit", tmp_path / "j.xml")
    assert told.returncode == 1 and told.stdout.startswith("compare: REGRESSION (")
    words = "min_clearance: from 0.0158572 to 0.001 m in worse (0.0149 worse, allowed 0.001) at 0.92 s"
    assert words in told.stdout
    lines = {line.split()[0]: line for line in told.stdout.splitlines()[4:] if line}
    assert "0.92 s, state 46, hand[11] near unrepresented voxel" in lines["min_clearance"]
    assert "better" in lines["min_self_clearance"] and "num_states" not in lines
    assert lines["control.margin"].split() == ["control.margin", "0.02", "0.03"]
    suite = suite_in(tmp_path / "j.xml")
    assert [case.name for case in suite if isinstance((case.result or [None])[0], Failure)] == ["min_clearance"]


def test_what_is_better_or_the_same_exits_with_0(audits: tuple[Path, Path]) -> None:
    old, worse = audits
    told = splatctrl("compare", old, old)
    assert (told.returncode, told.stderr) == (0, "")
    assert "no figure changed by more than its tolerance" in told.stdout
    told = splatctrl("compare", worse, old, "-v")
    assert told.returncode == 1, "the self-clearance is smaller again"
    assert "num_states" in told.stdout


def test_a_baseline_is_written_and_compared_with(audits: tuple[Path, Path], tmp_path: Path) -> None:
    old, worse = audits
    file = tmp_path / "base.toml"
    told = splatctrl("compare", old, "--update-baseline", file)
    assert (told.returncode, f"wrote {file}" in told.stdout) == (0, True)
    told = splatctrl("compare", worse, "--against", file, "--json")
    answer = json.loads(told.stdout)
    assert (told.returncode, answer["exit_code"], answer["metrics"]["num_worse"]) == (1, 1, 1)
    one = answer["figures"][0]
    assert (one["metric"], one["change"], one["where"]["state"]) == ("min_clearance", "worse", 46)
    told = splatctrl("compare", old, "--update-baseline", old / "run.json")
    assert (told.returncode, "would replace the input" in told.stderr) == (2, False)
    assert "exists, and is no baseline; give another --update-baseline" in told.stderr


@pytest.mark.parametrize(("words", "code"), [(["audit"], 2), (["audit", "scene"], 4), (["audit", "gone"], 4)])
def test_what_cannot_be_compared_is_refused_in_one_line(
    audits: tuple[Path, Path], words: list[str], code: int
) -> None:
    told = splatctrl("compare", *[audits[0].parent / word for word in words])
    assert (told.returncode, told.stdout, told.stderr.count("\n")) == (code, "", 1)
