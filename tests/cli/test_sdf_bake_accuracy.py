"""``splatctrl sdf-bake`` beside a truth, a mesh, and cameras that did not train."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from splatctrl_cli.cli.main import main
from splatctrl_cli.cli.sdf_bake import split_cameras
from splatctrl_cli.simulate.truth import load_truth
from splatctrl_cli.splat_files.splats import write_ply
from tests.field.scenes import splat_set

BOX = np.array([[0.4, -0.15, -0.05], [0.7, 0.15, 0.2]])


@pytest.fixture(scope="module")
def true_splats(sample_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small splats on the true surfaces about the box, but for the robot."""
    truth = load_truth(sample_data / "tabletop" / "truth.json")
    near = np.random.default_rng(0).uniform(BOX[0] - 0.25, BOX[1] + 0.25, (80_000, 3))
    distance, surface = truth.closest(near, int(truth.stamps[-1]))
    surface = surface[np.abs(distance) < 0.1]
    path = tmp_path_factory.mktemp("true") / "true.ply"
    write_ply(path, splat_set(surface, np.full(len(surface), 0.002)), {})
    return path


def bake(scene: Path, out: Path, *more: object) -> int:
    box = "--box=" + ",".join(f"{value}" for value in BOX.ravel())
    given = ["sdf-bake", str(scene), "-o", str(out), box, "--voxel", "0.03", "--formats", "npz"]
    given += ["--set", "field.max_loss=1"]
    return main([*given, "-q", *map(str, more)])


def accuracy(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "field.json").read_text())["accuracy"]
    return found


def test_held_out_depth_agrees_with_splats_on_the_true_surface(
    true_splats: Path, sample_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = sample_data / "tabletop"
    robot = ["--urdf", folder / "robot.urdf", "--spheres", folder / "robot_spheres.yaml"]
    held_out = ["--held-out", f"{folder / 'log.mcap'}:cam3"]
    assert bake(true_splats, tmp_path / "field", *held_out, *robot) == 0
    assert "held-out depth of 1 frames" in capsys.readouterr().out
    found = accuracy(tmp_path / "field")["held_out_depth"]
    assert found["num_frames"] == 1
    half_a_cell = 0.015  # which the interpolation of a surface between two cells may read on it
    assert 0 < found["on_surface"]["hard"]["median"] < half_a_cell
    near = found["before"]["seen"]["sdf"][0]
    assert near["count"] > 20
    assert abs(near["median"]) < half_a_cell
    assert bake(true_splats, tmp_path / "robot", *held_out) == 0
    with_robot = accuracy(tmp_path / "robot")["held_out_depth"]
    assert with_robot["num_measured"] > found["num_measured"], (
        "pixels of the robot count where nobody says where it is"
    )


def test_cameras_of_held_out_depth_are_named(
    true_splats: Path, sample_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = sample_data / "tabletop" / "log.mcap"
    assert split_cameras(f"{log}") == (log, ())
    assert split_cameras(f"{log}:cam0, cam1") == (log, ("cam0", "cam1"))
    assert bake(true_splats, tmp_path / "field", "--held-out", f"{log}:cam9") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "has no camera cam9; it has: cam0" in line
    assert bake(true_splats, tmp_path / "field", "--held-out", tmp_path / "none.mcap") == 4
    assert not list(tmp_path.iterdir())


def test_probability_is_held_to_the_truth(
    true_splats: Path, sample_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = sample_data / "tabletop"
    truth = ["--truth", folder / "truth.json", "--seen-by", folder / "log.mcap"]
    assert bake(true_splats, tmp_path / "field", *truth, "--probability", "calibrated") == 0
    out = capsys.readouterr().out
    assert "probability, calibrated: calibration error" in out
    assert "probability, paper: calibration error" in out
    truth_said = accuracy(tmp_path / "field")["truth"]
    assert f"--set field.error_mean={truth_said['error_mean']:.4f}" in out
    assert 0 < truth_said["error_sigma"] < 0.02
    found = truth_said["reliability"]
    assert sum(found["calibrated"]["count"]) == sum(found["paper"]["count"]) > 50
    assert found["calibrated"]["calibration_error"] < 0.2
    pictures = sorted(path.name for path in (tmp_path / "field" / "report").iterdir())
    assert pictures == ["gradient.png", "probability.png", "reliability.png", "slices.png"]


def test_a_mesh_is_compared_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    ball.apply_translation([0.55, 0.0, 0.08])
    ball.export(tmp_path / "ball.ply")
    write_ply(tmp_path / "splats.ply", splat_set(np.array(ball.vertices), np.full(len(ball.vertices), 0.001)), {})
    mesh = ["--reference-mesh", tmp_path / "ball.ply"]
    assert bake(tmp_path / "splats.ply", tmp_path / "field", *mesh) == 0
    assert "from mesh cm" in capsys.readouterr().out
    found = accuracy(tmp_path / "field")["reference_mesh"]
    assert found["file"] == "ball.ply"
    assert found["is_closed"] is True
    assert all(band["rmse"] < 0.003 for band in found["everywhere"]["hard"] if band["count"])
    assert bake(tmp_path / "splats.ply", tmp_path / "other", "--reference-mesh", tmp_path / "none.ply") == 4
    (line,) = capsys.readouterr().err.splitlines()
    assert "none.ply" in line
    assert not (tmp_path / "other").exists()
