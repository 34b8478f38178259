"""``splatctrl compare`` as a person and CI meet it."""

import json
import shutil
import zipfile
from pathlib import Path

import pytest
from junitparser import Failure, JUnitXml

from tests.cli.here import splatctrl

OLDER = Path(__file__).parents[1] / "data" / "older.zip"


@pytest.fixture
def audits(tmp_path: Path) -> tuple[Path, Path]:
    """A replay, and a worse one."""
    with zipfile.ZipFile(OLDER) as archive:
        archive.extractall(tmp_path)
    shutil.copytree(tmp_path / "audit", tmp_path / "worse")
    run = json.loads((tmp_path / "worse" / "run.json").read_text())
    run["metrics"] |= {"min_clearance": 0.001, "min_self_clearance": 0.06, "num_states": 7}
    run["config"]["control"]["margin"] = 0.03
    (tmp_path / "worse" / "run.json").write_text(json.dumps(run))
    return tmp_path / "audit", tmp_path / "worse"


def test_a_regression_exits_with_1_and_is_a_failure_in_junit(audits: tuple[Path, Path], tmp_path: Path) -> None:
    told = splatctrl("compare", *audits, "--junit", tmp_path / "j.xml")
    assert told.returncode == 1
    assert told.stdout.startswith("compare: REGRESSION (")
    assert "min_clearance: worse went from 0.0158572 to 0.001 m, 0.0149 worse, allowed 0.001 at 0.92 s" in told.stdout
    lines = {line.split()[0]: line for line in told.stdout.splitlines()[4:] if line}
    assert "0.92 s, state 46, hand[11] near unrepresented voxel" in lines["min_clearance"]
    assert "better" in lines["min_self_clearance"]
    assert "num_states" not in lines
    assert lines["control.margin"].split() == ["control.margin", "0.02", "0.03"]
    (suite,) = JUnitXml.fromfile(str(tmp_path / "j.xml"))
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
