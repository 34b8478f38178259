"""The golden runs: what their table covers, and what their digests leave out."""

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.test_docs import commands_on
from tools.golden.__main__ import Case, ordered, read_cases, run_case
from tools.golden.digest import of_json, stamps, written

ROOT = Path(__file__).parent.parent.parent


@pytest.mark.parametrize("page", ["README.md", "docs/start.md"])
def test_every_command_of_the_first_pages_is_run(page: str) -> None:
    shown = [shlex.split(line.removesuffix(" -v"), comments=True) for line in commands_on(ROOT / page)]
    run = [shlex.split(case.run) for case in read_cases().values()]
    assert len(shown) >= 9
    assert [command for command in shown if command not in run] == []


def test_a_case_runs_after_all_that_it_needs() -> None:
    cases = read_cases()
    order = ordered(cases, ["readme-replay", "replay-field"])
    assert order == ["readme-ingest", "readme-reconstruct", "readme-replay", "readme-sdf-bake", "replay-field"]
    assert set(ordered(cases, [])) == set(cases)


def test_no_command_of_a_case_uses_avx512(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = []
    chosen = "import os; from numpy.lib.introspect import opt_func_info as loops; print(os.environ['OPENCV_IPP'], *{"
    chosen += "used for kinds in loops().values() for kind in kinds.values() for used in kind['current'].split()})"
    started = subprocess.run

    def answered(command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        said.append(set(started([sys.executable, "-c", chosen], **options).stdout.split()))
        return subprocess.CompletedProcess(command, 0, "{}", "")

    monkeypatch.setattr(subprocess, "run", answered)
    run_case("any", Case(run="info log.mcap", before="info log.mcap"), tmp_path, {})
    assert len(said) == 2
    assert all("avx2" in used and not used & {"X86_V4", "AVX512_ICL", "AVX512_SPR"} for used in said), said


def test_times_and_places_do_not_change_a_digest() -> None:
    def answer(seconds: float, folder: str, clearance: float = 0.1) -> str:
        parts = {
            "seconds": seconds,
            "files": [f"{folder}/scene"],
            "nested": {"seconds": seconds, "clearance": clearance},
        }
        return of_json(json.dumps(parts), {folder: "SCRATCH"})

    assert answer(1.0, "/tmp/a") == answer(2.0, "/tmp/longer")
    assert answer(1.0, "/tmp/a") != answer(1.0, "/tmp/a", clearance=0.2)


def test_only_new_and_changed_files_are_artefacts(tmp_path: Path) -> None:
    for name in ("kept.csv", "changed.csv"):
        (tmp_path / name).write_text("1")
    before = stamps(tmp_path)
    (tmp_path / "changed.csv").write_text("12")
    (tmp_path / "run.json").write_text('{"metrics": {"a": 1}, "seconds": {"fit": 1}}')
    assert list(written(tmp_path, before, {})) == ["changed.csv", "run.json:metrics"]
