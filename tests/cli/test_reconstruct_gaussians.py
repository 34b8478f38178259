"""``splatctrl reconstruct --method 3dgs`` on the small DTU scan of the sample data."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.splat_files.gaussian_ply import read_gaussian_ply, write_gaussian_ply

SAMPLES = Path(__file__).parents[2] / "sample_data"
DTU = ["--dtu", str(SAMPLES / "dtu"), "--holdout", "2,5"]
FAST = [
    *("--method", "3dgs", "-q"),
    *("--set", "gaussians.iterations=24", "--set", "gaussians.densify_from=8"),
    *("--set", "gaussians.densify_every=8", "--set", "gaussians.densify_until=0.9"),
]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gaussians") / "scene"
    assert main(["reconstruct", *DTU, *FAST, "--threads", "2", "-o", str(out)]) == 0
    return out


def said(capsys: pytest.CaptureFixture[str]) -> str:
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


def test_the_scene_holds_a_gaussian_file_and_an_audit_that_agree(scene: Path) -> None:
    gaussians, comments = read_gaussian_ply(scene / "splats.ply")
    rows = [json.loads(line) for line in (scene / "audit.jsonl").read_text().splitlines()]
    metrics = json.loads((scene / "run.json").read_text())["metrics"]
    assert comments["format"].startswith("splatctrl-scene")
    assert len(gaussians) == rows[-1]["gaussians"] == metrics["splats"] > 4500
    assert metrics["method"] == "3dgs"
    assert metrics["iterations"] == rows[-1]["iteration"] == 24
    assert len(metrics["training_stamps_ns"]) == 6


def test_score_renders_the_held_out_views(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(scene), *DTU, "-q", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["metrics"]["num_views"] == 2
    assert result["metrics"]["psnr_all"] > 5
    assert main(["score", str(scene), "--dtu", str(SAMPLES / "dtu"), "--holdout", "3", "-q"]) == 2
    assert "trained the scene" in said(capsys)


def test_score_refuses_a_scene_without_gaussians(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    shutil.copytree(scene, empty)
    gaussians, comments = read_gaussian_ply(scene / "splats.ply")
    write_gaussian_ply(empty / "splats.ply", gaussians.select(np.zeros(len(gaussians), dtype=np.bool_)), comments)
    run = json.loads((scene / "run.json").read_text())
    (empty / "run.json").write_text(json.dumps({name: run[name] for name in run if name != "parts"}))
    assert main(["score", str(empty), *DTU, "-q", "-o", str(tmp_path / "scores")]) == 4
    assert "empty: expected Gaussians, got none: there is nothing to render" in said(capsys)
    assert not (tmp_path / "scores").exists()


def test_what_needs_distances_is_refused_in_one_line(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sdf-bake", str(scene), "-o", str(tmp_path / "field"), "-q"]) == 4
    assert "reconstruct without --method" in said(capsys)
    log, urdf = str(SAMPLES / "tabletop" / "log.mcap"), str(SAMPLES / "tabletop" / "robot.urdf")
    spheres = str(SAMPLES / "tabletop" / "robot_spheres.yaml")
    robot = ["--urdf", urdf, "--spheres", spheres]
    assert main(["replay", log, *robot, "--scene", str(scene), "-o", str(tmp_path / "run"), "-q"]) == 4
    assert "reconstruct without --method" in said(capsys)


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ([str(SAMPLES / "tabletop" / "log.mcap")], 2, "has a clock"),
        ([*DTU, "--urdf", str(SAMPLES / "tabletop" / "robot.urdf")], 2, "--urdf: does not apply"),
        ([*DTU, "--resume"], 2, "--resume: does not apply"),
        ([*DTU, "--points", "cloud.ply"], 2, "--points: does not apply"),
        ([*DTU, "--box=50,50,50,51,51,51"], 4, "no pixel of any view"),
        ([*DTU, "--require", "relocated>=1"], 2, "unknown metric"),
        ([*DTU, "--set", "gaussians.max_degree=4"], 2, "gaussians.max_degree"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], code: int, words: str
) -> None:
    assert main(["reconstruct", *options, *FAST, "-o", str(tmp_path / "out")]) == code
    assert words in said(capsys)
    assert not list(tmp_path.iterdir())
