"""3D Gaussian splatting into a scene folder: what it holds, and what the commands make of it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.densify import GaussianSettings
from experiments.gaussians import reconstruct_gaussians
from splatctrl_cli import InputError, ReconstructRequest, RecordingRequest, UsageError, open_to_train
from splatctrl_cli.cli.main import main
from splatctrl_cli.formats.splat.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from tests.jobs.score.wall import FakeSource
from tests.refused import expect_refusal
from tests.scene.wall import frame

SAMPLES = Path(__file__).parents[2] / "sample_data"
DTU = ["--dtu", str(SAMPLES / "dtu"), "--protocol", "holdout:2,5"]
SHORT = GaussianSettings(iterations=24, densify_from=8, densify_every=8, densify_until=0.9)


@pytest.fixture(scope="module")
def gaussians_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gaussians") / "scene"
    source = open_to_train(RecordingRequest(path=SAMPLES / "dtu", is_dtu=True, protocol="holdout:2,5"))
    made = reconstruct_gaussians(ReconstructRequest(source=source, out=out, threads=2), SHORT)
    assert made.verdict.exit_code == 0 and made.seconds["fit"] > 0
    return out


def said(capsys: pytest.CaptureFixture[str]) -> str:
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


def test_the_scene_holds_a_gaussian_file_and_an_audit_that_agree(gaussians_scene: Path) -> None:
    gaussians, comments = read_gaussian_ply(gaussians_scene / "splats.ply")
    rows = [json.loads(line) for line in (gaussians_scene / "audit.jsonl").read_text().splitlines()]
    metrics = json.loads((gaussians_scene / "run.json").read_text())["metrics"]
    assert comments["source"]
    assert len(gaussians) == rows[-1]["gaussians"] == metrics["splats"] > 4500 and metrics["method"] == "3dgs"
    assert metrics["iterations"] == rows[-1]["iteration"] == 24 and len(metrics["training_stamps_ns"]) == 6


def test_score_renders_the_held_out_views(gaussians_scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(gaussians_scene), *DTU, "-q", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["metrics"]["num_views"] == 2 and result["metrics"]["psnr_all"] > 5
    other = ["--dtu", str(SAMPLES / "dtu"), "--holdout", "3"]
    assert main(["score", str(gaussians_scene), *other, "-q"]) == 2
    assert "trained the scene" in said(capsys)


def test_score_refuses_a_scene_without_gaussians(
    gaussians_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    shutil.copytree(gaussians_scene, empty)
    gaussians, comments = read_gaussian_ply(gaussians_scene / "splats.ply")
    write_gaussian_ply(empty / "splats.ply", gaussians.select(np.zeros(len(gaussians), dtype=np.bool_)), comments)
    run = json.loads((gaussians_scene / "run.json").read_text())
    (empty / "run.json").write_text(json.dumps({name: run[name] for name in run if name != "parts"}))
    assert main(["score", str(empty), *DTU, "-q", "-o", str(tmp_path / "scores")]) == 4
    assert "empty: expected Gaussians, got none: there is nothing to render" in said(capsys)
    assert not (tmp_path / "scores").exists()


def test_what_needs_distances_is_refused_in_one_line(
    gaussians_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sdf-bake", str(gaussians_scene), "-o", str(tmp_path / "field"), "-q"]) == 4
    assert "made by 3D Gaussian splatting; distances are defined on isotropic splats" in said(capsys)
    log, urdf = str(SAMPLES / "tabletop" / "log.mcap"), str(SAMPLES / "tabletop" / "robot.urdf")
    spheres = str(SAMPLES / "tabletop" / "robot_spheres.yaml")
    robot = ["--urdf", urdf, "--spheres", spheres]
    assert main(["replay", log, *robot, "--scene", str(gaussians_scene), "-o", str(tmp_path / "run"), "-q"]) == 4
    assert "made by 3D Gaussian splatting; distances are defined on isotropic splats" in said(capsys)


def test_what_moves_or_has_no_depth_is_refused(tmp_path: Path) -> None:
    moving = ReconstructRequest(source=FakeSource(frames=[frame()], has_clock=True), out=tmp_path / "scene")
    expect_refusal("has a clock", reconstruct_gaussians, moving, error=UsageError)
    bare = replace(frame(), depth=np.zeros_like(frame().depth))
    with pytest.raises(InputError, match="no frame to train on has depth"):
        reconstruct_gaussians(replace(moving, source=FakeSource(frames=[bare], has_clock=False)))
    assert not list(tmp_path.iterdir())
