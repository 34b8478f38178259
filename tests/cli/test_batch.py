"""``splatctrl batch`` as a person and a CI job use it."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import xunitparserx
from junitparser import JUnitXml

from splatctrl_cli.cli import batch
from splatctrl_cli.cli.main import main
from splatctrl_cli.jobs.batch import run, task
from tests.recording.log.make_log import LogRecipe, make_log

SUITE = """
name = "two logs"
[[recordings]]
name = "good"
paths = ["good.mcap"]
[[recordings]]
paths = ["damaged.mcap"]
[recordings.jobs.info]
expect = "exit 4"
[jobs.info]
[jobs.ingest]
cameras = ["cam0"]
"""


@pytest.fixture(scope="module", autouse=True)
def one_runner() -> Iterator[None]:
    """The nodes of all batches run in one runner, which imports the commands once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "_local", SimpleNamespace())
        patch.setattr(run, "stop_runners", lambda: None)
        yield
    task.stop_runners()


def run_batch(*words: object, code: int = 0) -> None:
    """Run one in a single worker, and expect its exit code."""
    assert main(["batch", *map(str, words), "--workers", "1"]) == code


def states_in(out: Path) -> dict[str, str]:
    """The state of each node that a batch wrote."""
    return {node["id"]: node["state"] for node in json.loads((out / "batch.json").read_text())["nodes"]}


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    """The file of the suite, with its two logs."""
    make_log(tmp_path / "good.mcap", LogRecipe(num_frames=3))
    (tmp_path / "damaged.mcap").write_bytes(b"not a log")
    (tmp_path / "nightly.toml").write_text(SUITE)
    return tmp_path / "nightly.toml"


def test_a_suite_runs_once_tells_what_was_not_expected_and_lists_it(
    suite: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "nightly.out"

    def said(*words: str, code: int) -> tuple[str, str]:
        assert main(["batch", str(suite), *words]) == code
        return capsys.readouterr()

    planned, _ = said("--dry-run", code=0)
    assert [line.split()[:3] for line in planned.splitlines()[2:6]] == [
        [f"{name}/{job}", "to", "do"] for name in ("damaged", "good") for job in ("info", "ingest")
    ]
    assert f"splatctrl ingest --cameras=cam0 --out={out}/good/ingest.capture" in planned
    assert not (out / "good").exists()
    printed, told = said("--workers", "1", code=1)
    assert printed.startswith("batch: ERROR (4 nodes of 2 recordings): damaged/ingest: exit 4, an error")
    assert "[4/4]" in told and "see damaged/ingest.log" in printed
    assert (out / "good/ingest.capture/capture.json").is_file()
    printed, _ = said("--json", "--workers", "1", "-q", code=1)
    found = json.loads(printed)
    assert (found["kept"], found["exit_code"], found["verdict"]["label"]) == (3, 1, "error")
    assert {node["id"]: node["state"] for node in found["nodes"]} == {
        "good/info": "done",
        "good/ingest": "done",
        "damaged/info": "done",
        "damaged/ingest": "error",
    }
    document = json.loads((out / "batch.json").read_text())
    assert (document["format"], document["version"], len(document["nodes"])) == ("splatctrl-batch", 1, 4)
    listed, _ = said("--failed", code=0)
    assert "damaged/ingest" in listed and "good" not in listed
    listed, _ = said("--where", "state=done", "--where", "job=ingest", "--csv", str(tmp_path / "runs.csv"), code=0)
    assert listed.count("good/ingest") == 2  # the node and its log
    assert (tmp_path / "runs.csv").read_text().count("\n") == 2
    assert main(["batch", str(out), "--list"]) == 0
    capsys.readouterr()
    listed, _ = said("--shard", "2/2", "--list", code=0)
    assert [line.split()[0] for line in listed.splitlines()[2:]] == ["good/info", "good/ingest"], "of the shard"
    listed, _ = said("--where", "state=lost", code=0)
    assert listed == "no such runs\n"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["."], 4, ".: is a folder; give the suite's file, or --list with it"),
        (["missing.toml"], 4, "missing.toml: cannot be read"),
        (["--shard", "3/2"], 2, "expected I/N with I from 1 to N, got '3/2'"),
        (["--shard", "5/9"], 2, "has none of the 2 recordings; give fewer shards"),
        (["--list"], 4, "has no ledger.sqlite; run the batch first"),
        (["--dask", "tcp://127.0.0.1:1"], 2, "--dask"),
    ],
)
def test_what_cannot_run_is_said_in_a_line(
    suite: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    code: int,
    said: str,
) -> None:
    monkeypatch.setattr("splatctrl_cli.jobs.batch.batch.CONNECT_S", 0.5)
    place = [] if words[0].endswith((".toml", ".")) else [str(suite)]
    assert main(["batch", *place, *words]) == code
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_ci_is_told_a_suite_for_each_recording(suite: Path, tmp_path: Path) -> None:
    junit = tmp_path / "nightly.xml"
    suite.write_text(SUITE + "[jobs.scene]\ncommand = 'reconstruct'\nurdf = 'missing.urdf'\n")
    (tmp_path / "missing.urdf").touch()
    assert main(["batch", str(suite), "--junit", str(junit), "-q", "--workers", "1"]) == 1
    found = {each.name: {case.classname: case for case in each} for each in JUnitXml.fromfile(str(junit))}
    assert set(found) == {"good", "damaged"}
    assert {name: [type(result).__name__ for result in case.result] for name, case in found["damaged"].items()} == {
        "damaged/info": [],
        "damaged/ingest": ["Error"],
        "damaged/scene": ["Skipped"],
    }
    assert found["good"]["good/ingest"].is_passed and found["good"]["good/ingest"].time > 0.0
    assert "missing.urdf" in found["good"]["good/scene"].result[0].text
    assert xunitparserx.parse(str(junit))[0].properties["batch"] == "two logs"


@pytest.mark.parametrize(("expect", "code", "num_errors"), [("passed", 3, 2), ("exit 3", 0, 0)])
def test_a_log_that_was_cut_is_named_in_the_table_the_sentence_the_page_and_junit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], expect: str, code: int, num_errors: int
) -> None:
    """Every job ends as expected, so nothing else would say why the exit code is 3."""
    whole, suite, junit = make_log(tmp_path / "whole.mcap", LogRecipe(num_frames=20)), "suite.toml", "found.xml"
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[: whole.stat().st_size // 3])
    jobs = "".join(f"[jobs.{job}]\nexpect = '{expect}'\n" for job in ("check", "ingest"))
    (tmp_path / suite).write_text(f"[[recordings]]\npaths = ['cut.mcap']\n{jobs}")
    assert main(["batch", str(tmp_path / suite), "--junit", str(tmp_path / junit), "-q", "--workers", "1"]) == code
    printed, _ = capsys.readouterr()
    assert ("AS EXPECTED, part of the recording is damaged and left out (2 nodes" in printed) is (code == 3)
    assert ("; damaged: cut" in printed) is (code == 3)
    assert [line.split() for line in printed.splitlines() if line.startswith("cut")] == [
        ["cut", "passed,", "damaged", "done,", "damaged"]
    ]
    cases = [case for each in JUnitXml.fromfile(str(tmp_path / junit)) for case in each]
    errors = [case.result[0].message for case in cases if not case.is_passed]
    assert errors == ["part of the recording is damaged and left out (exit code 3); splatctrl check says which"] * (
        num_errors
    )
    assert main(["report", str(tmp_path / "suite.out"), "-o", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    assert "all 2 jobs as expected; part of the recording is damaged and left out: cut" in page
    assert "passed, damaged" in page and "done, damaged" in page


def test_what_a_page_reads_is_the_suite_as_it_is(
    suite: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def states(text: str, code: int) -> dict[str, str]:
        suite.write_text(text)
        run_batch(suite, "-q", code=code)
        capsys.readouterr()
        return states_in(tmp_path / "nightly.out")

    assert list(states(SUITE, 1)) == ["damaged/info", "damaged/ingest", "good/info", "good/ingest"]
    expected = SUITE.replace("[jobs.info]\n", "[recordings.jobs.ingest]\nexpect = 'exit 4'\n[jobs.info]\n")
    assert set(states(expected, 0).values()) == {"done"}, "the last run is judged by what is expected now"
    assert main(["batch", str(suite), "--failed", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["nodes"] == []
    jobs = SUITE[SUITE.index("[jobs.info]") :]
    fewer = states(f'[[recordings]]\nname = "good"\npaths = ["good.mcap"]\n{jobs}', 0)
    assert fewer == {"good/info": "done", "good/ingest": "done"}, "what is no longer in the suite is not told"


def test_nodes_that_an_interrupted_batch_did_not_come_to_are_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    suite, out = tmp_path / "nightly.toml", tmp_path / "nightly.out"
    make_log(tmp_path / "good.mcap", LogRecipe(num_frames=20))
    jobs = "[jobs.info]\n[jobs.check]\nquick = 3\n[jobs.look]\ncommand = 'check'\nquick = 3\n"
    suite.write_text(f'[[recordings]]\npaths = ["good.mcap"]\n{jobs}')
    run_batch(suite, "-q")
    suite.write_text(suite.read_text().replace("quick = 3", "quick = 4"))

    def interrupted(console: object, line: str) -> None:
        if "good/check" in line:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("splatctrl_cli.cli.common.Console.log", interrupted)
        run_batch(suite, code=130)
    assert "interrupted; run the same command again to continue" in capsys.readouterr().err
    assert [*states_in(out).values()] == ["done", "done", "to do"]
    assert main(["report", str(out), "-o", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    assert "1 of 3 jobs not as expected; first good/look: has not run since" in page


def test_many_recordings_are_printed_where_they_are_not_as_expected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "MOST_ROWS", 2)
    for number in range(3):
        (tmp_path / f"bag{number}.bag").write_bytes(b"not a log")
    suite = tmp_path / "bags.toml"
    own = '[[recordings]]\nname = "odd"\npaths = ["bag0.bag"]\njobs.info.expect = "passed"\n'
    suite.write_text(f'[[recordings]]\npaths = ["*.bag"]\n{own}[jobs.info]\nexpect = "exit 4"\n')
    run_batch(suite, "-q", code=1)
    rows = capsys.readouterr().out.splitlines()
    assert [rows[2].split(), rows[4].split()] == [["recording", "info"], ["odd", "ERROR"]]
    assert rows[5] == "3 recordings as expected; -v prints them, too"
    assert main(["batch", str(suite), "-q", "-v"]) == 1
    assert capsys.readouterr().out.count("exit 4\n") == 3
