"""``splatctrl export`` as a process and as a function."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.io import splats as splats_module
from splatctrl_cli.io.splats import read_ply, write_ply
from splatctrl_cli.records import Label, SplatSet


def ball(num: int = 400) -> SplatSet:
    directions = np.random.default_rng(0).normal(size=(num, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return SplatSet(
        centers=(0.3 * directions + [0.5, 0.0, 0.2]).astype(np.float32),
        radii=np.full(num, 0.02, np.float32),
        colors=(0.5 + 0.4 * directions).astype(np.float32),
        opacities=np.linspace(0.2, 1.0, num).astype(np.float32),
        labels=(np.arange(num) % 3).astype(np.uint8),
        density=np.zeros(num, np.float32),
    )


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    write_ply(folder / "splats.ply", ball(), {"scene": "ball"})
    return folder


def run(*arguments: object) -> int:
    return main(["export", *map(str, arguments)])


def test_a_scene_is_exported_and_renders_the_same(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run(scene, "-o", out, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["largest_pixel_difference"] <= 0.01 / 255
    assert result["covered_share"] > 0.1
    assert result["num_splats"] == 400
    assert result["bytes"] == out.stat().st_size
    splats, comments = read_ply(out)
    assert len(splats) == 400
    assert comments["scene"] == "ball"
    assert comments["exported_from"].startswith("splats.ply sha256 ")


@pytest.mark.parametrize(("place", "given"), [("elsewhere", "../scene"), ("scene", "."), ("scene/below", "..")])
def test_without_out_the_file_lies_beside_the_scene(
    scene: Path, monkeypatch: pytest.MonkeyPatch, place: str, given: str
) -> None:
    (scene.parent / place).mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(scene.parent / place)
    assert run(given) == 0
    assert len(read_ply(scene.parent / "scene.ply")[0]) == 400


def test_without_out_a_splat_file_is_not_written_over_itself(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scene / "splats.ply") == 2
    assert "is the input itself; give another --out" in capsys.readouterr().err


def test_labels_choose_splats(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run(scene / "splats.ply", "--labels", "object,human", "-o", out) == 0
    assert set(read_ply(out)[0].labels) == {Label.OBJECT, Label.HUMAN}
    assert "267 splats, 133 left out by label" in capsys.readouterr().out


def test_the_same_scene_gives_the_same_bytes(scene: Path) -> None:
    for name in ("a.ply", "b.ply"):
        assert run(scene, "-o", scene.parent / name) == 0
    assert (scene.parent / "a.ply").read_bytes() == (scene.parent / "b.ply").read_bytes()


def test_a_file_that_renders_differently_is_not_left_behind(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write_darker(path: Path, splats: SplatSet, comments: dict[str, str]) -> None:
        write_ply(path, replace(splats, colors=splats.colors * np.float32(0.999)), comments)

    monkeypatch.setattr(splats_module, "write_ply", write_darker)
    assert run(scene, "-o", scene.parent / "out.ply") == 6
    assert "does not render as its source: largest pixel difference" in capsys.readouterr().err
    assert not list(scene.parent.glob("out.ply*"))


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["none"], 4, "none: no such scene"),
        (["empty"], 4, "empty: has no splats.ply"),
        (["scene", "--labels", "cat"], 2, "unknown label 'cat'; known here: object, robot, human"),
        (["scene", "-o", "scene/splats.ply", "--force"], 2, "is the input itself"),
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
    (folder / "cut.ply").write_bytes((scene / "splats.ply").read_bytes()[:-5])
    robot = ball(3)
    write_ply(folder / "robot.ply", replace(robot, labels=np.full(3, Label.ROBOT, np.uint8)), {})
    if "-o" not in arguments:
        arguments = [*arguments, "-o", "out.ply"]
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = subprocess.run(
        [sys.executable, "-m", "splatctrl_cli", "export", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == code
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
