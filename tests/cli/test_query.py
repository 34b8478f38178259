"""``splatctrl query``: where answers and figures go."""

import json
from pathlib import Path

import pytest

from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.query.query import TITLES
from tests.cli.here import splatctrl
from tests.cli.replay_desk import BALL, splats_of

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_ply(tmp_path / "splats.ply", splats_of(BALL), {})
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,2\n0,0,3\n")
    return tmp_path


def test_without_an_output_the_answers_are_stdout_and_the_figures_stderr(folder: Path) -> None:
    done = splatctrl("query", folder / "splats.ply", folder / "points.csv")
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and lines[0] == ",".join(TITLES) and len(lines) == 3
    assert "min distance" in done.stderr and "wrote" not in done.stderr


def test_points_come_from_stdin(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (folder / "points.csv").open() as stream:
        monkeypatch.setattr("sys.stdin", stream)
        done = splatctrl("query", folder / "splats.ply", "-", "--json")
    assert (json.loads(done.stdout)["num_points"], done.stderr) == (2, "")


def test_json_has_the_figures_of_what_is_written(folder: Path) -> None:
    out = folder / "answers.csv"
    done = splatctrl("query", folder / "splats.ply", folder / "points.csv", "-o", out, "--json")
    found = json.loads(done.stdout)
    assert found["out"] == str(out) and found["source"] == "scene" and found["notes"] == []
    least = min(float(row.split(",")[4]) for row in out.read_text().splitlines()[1:])
    assert found["min_distance"] == pytest.approx(least, abs=1e-6)


def test_a_table_with_a_wrong_line_prints_nothing(folder: Path) -> None:
    (folder / "points.csv").write_text("0,0,2\n" * 40_000 + "0,0\n")
    done = splatctrl("query", folder / "splats.ply", folder / "points.csv", "-q")
    assert (done.returncode, done.stdout) == (4, "") and "line 40001: expected 3 columns, got 2" in done.stderr


def test_the_page_lists_the_columns() -> None:
    page = (ROOT / "docs" / "field.md").read_text(encoding="utf-8")
    section = page.partition("## Ask it about points")[2].partition("\n## ")[0]
    assert [title for title in TITLES if f"`{title}`" not in section] == []
