"""Bakes beside a truth, a mesh, and cameras that did not train."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.formats.splat.splats import read_ply, write_ply
from splatctrl_cli.jobs.bake.accuracy import counts_of
from splatctrl_cli.jobs.bake.bake import BakeResult
from splatctrl_cli.simulate.truth import load_truth
from tests.cli.replay_desk import write_scene
from tests.field.scenes import splat_set
from tests.jobs.bake.baked import baked, field_json

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


def bake(scene: Path, out: Path, **more: Any) -> BakeResult:
    return baked(scene, out, voxel=0.03, box=tuple(BOX.ravel()), **more)


def test_held_out_depth_agrees_with_splats_on_the_true_surface(
    true_splats: Path, sample_data: Path, tmp_path: Path
) -> None:
    folder = sample_data / "tabletop"
    robot = {"urdf": folder / "robot.urdf", "spheres": folder / "robot_spheres.yaml"}
    held_out = {"held_out": folder / "log.mcap", "held_out_cameras": ("cam3",)}
    found = bake(true_splats, tmp_path / "field", **held_out, **robot).accuracy.held_out_depth
    assert found is not None and found.num_frames == 1
    half_a_cell = 0.015  # which the interpolation of a surface between two cells may read on it
    on_surface, near = found.on_surface["hard"].median, found.before.seen["sdf"][0]
    assert on_surface is not None and 0 < on_surface < half_a_cell
    assert near.median is not None and abs(near.median) < half_a_cell
    assert near.count > 20
    with_robot = bake(true_splats, tmp_path / "robot", **held_out).accuracy.held_out_depth
    assert with_robot is not None and with_robot.num_measured > found.num_measured, (
        "pixels of the robot count where nobody says where it is"
    )


def test_depth_later_than_the_scene_does_not_count(true_splats: Path, sample_data: Path, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", (1, read_ply(true_splats)[0]))
    log = sample_data / "tabletop" / "log.mcap"
    with pytest.raises(NotEvaluableError, match="no frame of cam3 up to the time of the scene"):
        bake(scene, tmp_path / "field", held_out=log, held_out_cameras=("cam3",))


def test_probability_is_held_to_the_truth(true_splats: Path, sample_data: Path, tmp_path: Path) -> None:
    folder = sample_data / "tabletop"
    truth = {"truth": folder / "truth.json", "seen_by": folder / "log.mcap"}
    result = bake(true_splats, tmp_path / "field", **truth, with_probability=True, no_report=False)
    found = result.accuracy.truth
    assert found is not None and found.error_sigma is not None and 0 < found.error_sigma < 0.02
    calibrated, paper = found.reliability["calibrated"], found.reliability["paper"]
    assert calibrated.count.sum() == paper.count.sum() > 50
    assert calibrated.calibration_error < 0.2
    pictures = sorted(path.name for path in (tmp_path / "field" / "report").iterdir())
    assert pictures == ["gradient.png", "probability.png", "reliability.png", "slices.png"]


def test_a_mesh_is_compared_with(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    ball.apply_translation([0.55, 0.0, 0.08])
    ball.export(tmp_path / "ball.ply")
    write_ply(tmp_path / "splats.ply", splat_set(np.array(ball.vertices), np.full(len(ball.vertices), 0.001)), {})
    bake(tmp_path / "splats.ply", tmp_path / "field", reference_mesh=tmp_path / "ball.ply")
    found = field_json(tmp_path / "field")["accuracy"]["reference_mesh"]
    assert found["file"] == "ball.ply"
    assert found["is_closed"] is True
    assert all(band["rmse"] < 0.003 for band in found["everywhere"]["hard"] if band["count"])


def test_a_figure_of_a_band_rests_on_the_cells_of_that_band() -> None:
    figures = {"num_cells": 1000, "voxel": 0.02, "seen.hard.0_2cm.count": 0, "seen.hard.0_2cm.rmse": None}
    figures |= {"over_estimate.count": 7, "over_estimate.count_beyond": 0}
    counts = counts_of(figures)
    assert counts["seen.hard.0_2cm.rmse"] == 0 and counts["over_estimate.count_beyond"] == 7
    assert counts["voxel"] == counts["seen.hard.0_2cm.count"] == 1000
