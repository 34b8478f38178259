"""Captures, scenes, fields and replays that an earlier version wrote are still read.

`data/older.zip` was written by version 0.1.0 from one second of a simulated log, two cameras of 64 x 48 pixels.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.here import splatctrl


@pytest.mark.parametrize(
    ("artefact", "said"),
    [
        ("tabletop.capture", {"kind": "capture", "has_clock": True, "joints": [f"joint{n}" for n in range(1, 8)]}),
        ("scene", {"kind": "scene folder"}),
        ("field", {"kind": "field folder", "shape": [11, 11, 11], "distance": "safe", "length_scale": 0.02}),
        ("audit", {"kind": "run folder"}),
    ],
)
def test_an_older_artefact_is_described(older: Path, artefact: str, said: dict[str, object]) -> None:
    told = splatctrl("info", older / artefact, "--json")
    assert told.returncode == 0, told.stderr
    answer = json.loads(told.stdout)
    assert said.items() <= answer.items(), answer


def test_an_older_capture_and_scene_replay_as_they_did(older: Path, tmp_path: Path) -> None:
    robot = ["--urdf", older / "robot.urdf", "--spheres", older / "robot_spheres.yaml"]
    told = splatctrl(
        "replay", older / "tabletop.capture", "--scene", older / "scene", "--mode", "open-loop", *robot,
        "--worst-frames", "0", "--report-only", "--json", "-o", tmp_path / "replay",
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    answer = json.loads(told.stdout)
    assert answer["min_clearance"] == pytest.approx(0.0158572, abs=1e-6)
    assert answer["num_states"] == 51
    then, now = (commands(folder / "steps.csv") for folder in (older / "audit", tmp_path / "replay"))
    np.testing.assert_allclose(now, then, rtol=0, atol=1e-6)


def commands(steps: Path) -> list[list[float]]:
    """The stamp and the velocity of every joint at each step, NaN where there is none."""
    with steps.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    names = ["stamp_ns", *(name for name in rows[0] if name.startswith("v_"))]
    assert len(names) == 8
    return [[float(row[name] or "nan") for name in names] for row in rows]


def test_an_older_field_is_baked_anew_rather_than_updated(older: Path, tmp_path: Path) -> None:
    words = ["sdf-bake", older / "scene", "--at", "0.6", "--json", "-o", tmp_path / "f"]
    told = splatctrl(*words, "--update", older / "field")
    assert (told.returncode, "of 0.1.0; bake it once without --update" in told.stderr) == (2, True)
    told = splatctrl(*words)
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["distance"] == "safe"


def test_an_older_scene_is_scored_on_an_older_capture(older: Path, tmp_path: Path) -> None:
    told = splatctrl(
        "score", older / "scene", "--reference", older / "tabletop.capture", "--allow-training", "--json",
        "-o", tmp_path / "score",
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["metrics"]["psnr_seen"] == pytest.approx(15.333, abs=0.01)
