"""``splatctrl export``: what it refuses, and what it prints."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.records import Label
from splatctrl_cli.splat_files.splats import read_ply, write_ply
from tests.cli import here
from tests.jobs.export_scene import ball, written


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return written(tmp_path / "scene", ball())


def run(*arguments: object) -> int:
    return main(["export", *map(str, arguments)])


def test_json_has_what_was_written_and_how_it_looks(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run(scene, "-o", out, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["file"] == str(out)
    assert result["bytes"] == out.stat().st_size
    assert result["num_views_compared"] == 4
    assert result["largest_pixel_difference"] <= 3 / 255


def test_labels_choose_splats(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run(scene / "splats.ply", "--labels", "object,human", "-o", out) == 0
    assert set(read_ply(out)[0].labels) == {Label.OBJECT, Label.HUMAN}
    assert "267 splats, 133 left out by label" in capsys.readouterr().out


def test_what_a_format_has_no_room_for_is_said(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bright = ball()
    bright.colors[:7] = 1.8
    write_ply(scene / "splats.ply", bright, {})
    assert run(scene, "-o", scene.parent / "out.splat") == 0
    said = capsys.readouterr().out
    assert "not kept: labels" in said
    assert "7 splats have a size or colour beyond the format's range: put at its edge" in said


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["none"], 4, "none: no such scene"),
        (["empty"], 4, "empty: has no splats.ply"),
        (["scene", "--labels", "cat"], 2, "unknown label 'cat'; known here: object, robot, human"),
        (["scene", "-o", "scene/splats.ply", "--force"], 2, "is the input itself"),
        (["scene", "-o", "out.stl"], 2, "out.stl: expected a suffix of .ply, .splat, .spz, .glb, .usda, .usdc"),
        (["scene", "-o", "out.spz", "--layout", "full"], 2, "--layout full: out.spz is no PLY"),
        (["notes.txt"], 4, "notes.txt: expected a suffix of .ply, .splat, .spz"),
        (["scene", "-o", "taken.ply"], 2, "taken.ply: already exists; give --force"),
        (["cut.ply"], 4, "cut.ply: cut short: expected"),
        (["robot.ply", "--labels", "human"], 5, "no splat to write among 3"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    scene: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, message: str
) -> None:
    folder = scene.parent
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir()
    (folder / "taken.ply").write_text("taken")
    (folder / "notes.txt").write_text("notes")
    (folder / "cut.ply").write_bytes((scene / "splats.ply").read_bytes()[:-5])
    robot = ball(3)
    write_ply(folder / "robot.ply", replace(robot, labels=np.full(3, Label.ROBOT, np.uint8)), {})
    if "-o" not in arguments:
        arguments = [*arguments, "-o", "out.ply"]
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = here.splatctrl("export", *arguments)
    assert done.returncode == code
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
