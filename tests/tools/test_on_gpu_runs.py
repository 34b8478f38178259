"""The program that runs commands on a card, as far as it runs without one."""

import json
from pathlib import Path

from tests.cli.test_reconstruct import FEW, write_folder
from tests.scene.wall import frame
from tools import on_gpu_runs
from tools.on_gpu_runs import Desk, digest, of_reference


def test_a_recording_without_a_robot_is_reconstructed_where_there_is_no_pinocchio(tmp_path: Path) -> None:
    """Its parts are timed, to no more than the whole."""
    views = write_folder(
        tmp_path / "views", [frame(k * 10, x=x, camera=f"cam{x}") for k in (0, 1) for x in (0.1, -0.1)]
    )
    desk = Desk(tmp_path, "cpu")
    desk.path = ":".join([*on_gpu_runs.stand_ins(tmp_path / "stand_ins", [*on_gpu_runs.STAND_INS]), desk.path])
    words = desk.reconstruct(str(views), "scene", "cuda", *FEW)
    code, _, err, seconds = desk.run(["tools.on_gpu_runs", "--timed", *words[1:]])
    assert code == 0, err
    assert json.loads((tmp_path / "scene" / "run.json").read_text())["versions"]["pin"] == "0"
    parts = json.loads(err.splitlines()[-1])
    assert parts["iterations"] > 0 and parts["occupancy"] > 0
    assert sum(parts.values()) < seconds
    before = digest(tmp_path / "scene")
    (tmp_path / "scene" / "run.json").write_bytes(b"")
    assert digest(tmp_path / "scene") == before
    (tmp_path / "scene" / "splats.ply").write_bytes(b"")
    assert digest(tmp_path / "scene") != before


def test_a_recording_is_scored_without_what_only_a_map_has() -> None:
    assert of_reference("a/b.toml --root c --max-splats 10000 --holdout 1,2") == [
        *("--reference", "a/b.toml", "--root", "c", "--holdout", "1,2")
    ]
    assert of_reference("--dtu d --holdout 1,4 --max-splats 5") == ["--dtu", "d", "--holdout", "1,4"]
