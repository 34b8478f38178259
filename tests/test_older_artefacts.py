"""Captures, scenes, fields and replays that an earlier version wrote are still read.

`data/older.zip` was written by version 0.1.0 from one second of a simulated log, two cameras of 64 x 48 pixels.
"""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cli.here import splatctrl


def answer_of(*words: object) -> dict[str, Any]:
    """The object that a command prints, which succeeds."""
    told = splatctrl(*words, "--json")
    assert told.returncode == 0, told.stderr
    answer: dict[str, Any] = json.loads(told.stdout)
    return answer


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
    answer = answer_of("info", older / artefact)
    assert said.items() <= answer.items(), answer


def test_an_older_capture_and_scene_replay_as_they_did(older: Path, tmp_path: Path) -> None:
    robot = ["--urdf", older / "robot.urdf", "--spheres", older / "robot_spheres.yaml"]
    answer = answer_of(
        "replay", older / "tabletop.capture", "--scene", older / "scene", "--mode", "open-loop", *robot,
        "--worst-frames", "0", "--report-only", "-o", tmp_path / "replay",
    )  # fmt: skip
    assert (answer["min_clearance"], answer["num_states"]) == (pytest.approx(0.0158572, abs=1e-6), 51)
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
    words = ["sdf-bake", older / "scene", "--at", "0.6", "-o", tmp_path / "f"]
    told = splatctrl(*words, "--update", older / "field", "--json")
    assert (told.returncode, "of 0.1.0; bake it once without --update" in told.stderr) == (2, True)
    assert answer_of(*words)["distance"] == "safe"


def test_an_older_scene_is_scored_on_an_older_capture(older: Path, tmp_path: Path) -> None:
    words = ["score", older / "scene", "--reference", older / "tabletop.capture", "--allow-training"]
    answer = answer_of(*words, "-o", tmp_path / "score")
    assert answer["metrics"]["psnr_seen"] == pytest.approx(15.333, abs=0.01)
