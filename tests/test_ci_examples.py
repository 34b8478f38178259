"""The examples for CI systems are YAML as these read it, name what is there, and their commands run."""

import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml
from junitparser import JUnitXml

from tests.cli.conftest import few_points, short_sample
from tests.cli.here import splatctrl
from tests.quick import unpainted

__all__ = ["few_points", "short_sample", "unpainted"]
ROOT = Path(__file__).parent.parent
CI = ROOT / "docs" / "ci"


def parsed(name: str) -> dict[str, Any]:
    document = yaml.safe_load((CI / name).read_text(encoding="utf-8"))
    assert isinstance(document, dict)
    return document


def gitlab_lines() -> list[str]:
    job = parsed("gitlab.yml")["splatctrl"]
    return [*job["before_script"], *job["script"]]


def test_both_examples_run_the_same_commands() -> None:
    github_lines = [step["run"] for step in parsed("github.yml")["jobs"]["judge"]["steps"] if "run" in step]
    assert [shlex.split(line) for line in github_lines] == [shlex.split(line) for line in gitlab_lines()]


def test_the_github_example_is_a_workflow() -> None:
    workflow = parsed("github.yml")
    assert set(workflow) == {"name", True, "jobs"}, "YAML 1.1 reads the key `on` as true"
    (job,) = workflow["jobs"].values()
    assert set(job) == {"runs-on", "timeout-minutes", "steps"}
    assert all(("run" in step) != ("uses" in step) for step in job["steps"])


def test_the_commands_of_the_examples_run_and_leave_the_reports_that_are_kept(
    short_sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sample_data").symlink_to(short_sample)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GITHUB_ACTIONS", raising=False)
    install, *commands = [shlex.split(line) for line in gitlab_lines()]
    assert install[:2] == ["pip", "install"]
    for program, *words in commands:
        assert program == "splatctrl"
        told = splatctrl(*words)
        assert told.returncode == 0, told.stderr
    artifacts = parsed("gitlab.yml")["splatctrl"]["artifacts"]
    reports = sorted(tmp_path.glob(artifacts["reports"]["junit"]))
    assert len(reports) == len(commands)
    assert all(
        suite.errors == suite.failures == 0 < suite.tests for path in reports for suite in JUnitXml.fromfile(path)
    )
    kept = parsed("github.yml")["jobs"]["judge"]["steps"][-1]["with"]["path"].split()
    assert kept == artifacts["paths"]
    assert all((tmp_path / path).exists() for path in kept)
