"""A log whose cameras stand elsewhere than it says, from its reconstruction to its verdict."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.calibration.displacement import is_corrected
from splatctrl_cli.cli.main import main
from splatctrl_cli.evaluate.verdict import Outcome
from splatctrl_cli.jobs.replay.evidence_criteria import calibration
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from tests.cli.conftest import short_sample
from tests.jobs.replay.test_criteria import judged

__all__ = ["short_sample"]

SETTINGS = ("scene.max_splats=600", "scene.first_iterations=15", "scene.iterations_per_step=3")
FAST = ["--threads", "1", "-q", *(word for setting in SETTINGS for word in ("--set", setting))]
PERTURB = {"pose-error": 0.012, "pose-turn": 0.6, "seed": 5}


@pytest.fixture(scope="module")
def metrics(short_sample: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The metrics of a reconstruction of a log whose cameras are each 12 mm and 0.6 degrees off."""
    tabletop, out = short_sample / "tabletop", tmp_path_factory.mktemp("corrected") / "scene"
    words = [word for name, value in PERTURB.items() for word in ("--perturb", f"{name}={value}")]
    robot = ["--urdf", str(tabletop / "robot.urdf"), "--spheres", str(tabletop / "robot_spheres.yaml")]
    log = ["reconstruct", str(tabletop / "log.mcap"), *words]
    assert main([*log, *robot, "-o", str(out), *FAST]) in (0, 3)
    found: dict[str, Any] = json.loads((out / "run.json").read_text())["metrics"]
    return found


def test_the_map_is_made_with_the_poses_at_which_the_cameras_truly_stand(
    metrics: dict[str, Any], short_sample: Path
) -> None:
    log, rows = short_sample / "tabletop" / "log.mcap", metrics["displaced_cameras"]
    true, off = (
        {camera: T for _, camera, T in open_source(log, options).poses()}
        for options in (SourceOptions(), SourceOptions(perturb=PERTURB))
    )
    assert set(rows) == set(metrics["cameras"])
    for camera, row in rows.items():
        placed = off[camera] @ np.array(row["T_recorded_camera"]).reshape(4, 4)
        assert placed == pytest.approx(true[camera], abs=2e-3)
    assert metrics["camera_displacement_mm"] == max(row["distance_mm"] for row in rows.values()) > 5.0
    assert metrics["self_mask_residual_mm"] < 2.0  # of cameras as recorded, 5 and more


def test_the_verdict_names_the_corrected_cameras_and_holds(metrics: dict[str, Any]) -> None:
    rows, run = metrics["displaced_cameras"], judged()
    run.inputs.scene = SimpleNamespace(figures=lambda: {"displaced_cameras": rows})
    reasons = list(calibration(run))
    assert all(is_corrected(row) for row in rows.values())
    assert [(reason.outcome, reason.is_note, reason.who) for reason in reasons] == [
        (Outcome.PASSED, True, camera) for camera in rows
    ]
    assert "its pose is corrected to within" in reasons[0].sentence
