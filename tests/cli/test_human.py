"""Masks of people on their way: log, capture, scene, field."""

import json
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.records import Label
from splatctrl_cli.scene_files.scene_folder import open_scene
from tests.logs.make_log import LogRecipe, make_log

MASK = ("--human-topic", "cam0=/cam0/people/mask")


def run(*arguments: object) -> None:
    assert main([*map(str, arguments), "-q"]) == 0


def test_who_the_masks_show_is_human_in_scene_and_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(mask_every=1, num_frames=3))
    run("ingest", log, *MASK, "-o", tmp_path / "x.capture")
    for name, source in (("a", (log, *MASK)), ("b", (tmp_path / "x.capture",))):
        run(
            "reconstruct", *source, "-o", tmp_path / name, "--max-splats", "300", "--set", "scene.first_iterations=20"
        )
    scene = open_scene(tmp_path / "a")
    is_human = scene.splats().labels == Label.HUMAN
    assert 10 < is_human.sum() < 0.6 * len(is_human)
    assert (open_scene(tmp_path / "b").splats().labels == scene.splats().labels).all()
    row = json.loads((tmp_path / "a/audit.jsonl").read_text().splitlines()[-1])
    assert row["human"] == is_human.sum()
    assert np.count_nonzero(scene.occupancy().entity & Label.HUMAN) > 10
    run("sdf-bake", tmp_path / "a", "-o", tmp_path / "field")
    run("sdf-bake", tmp_path / "a", "--include", "none", "-o", tmp_path / "without")
    capsys.readouterr()
    used = [json.loads((tmp_path / name / "field.json").read_text())["splats_used"] for name in ("field", "without")]
    assert [counts["human"] for counts in used] == [is_human.sum(), 0]
