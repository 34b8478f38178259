"""``splatctrl sdf-bake --update``: only what changed is baked, and the files are those of a whole bake."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.field import slabs
from splatctrl_cli.records import OccupancyGrid, SplatSet
from splatctrl_cli.scene_files.scene_writer import SceneWriter
from splatctrl_cli.splat_files.splats import write_ply
from tests.field.scenes import cloud, splat_set
from tests.known_voxels import known

BOX = "--box=-0.6,-0.6,-0.5,0.6,0.6,0.5"
OPTIONS = ["--voxel", "0.025", "--set", "field.max_loss=1", "--formats", "npz", "--no-report", "-q"]
SECOND = 10**9


def before() -> SplatSet:
    centers, radii = cloud()
    return splat_set(centers, radii + 0.001)


def after(splats: SplatSet) -> SplatSet:
    """One splat gone, one moved."""
    centers = splats.centers.copy()
    nearest = int(np.argsort(np.linalg.norm(centers - centers[7], axis=1))[1])
    centers[nearest] += np.float32(0.004)
    kept = np.arange(len(splats)) != 7
    return replace(splats, centers=centers).select(kept)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of two snapshots that differ in two splats, and in what was seen."""
    folder = tmp_path_factory.mktemp("scene")
    writer = SceneWriter(folder, {})
    shape = (6, 6, 6)
    occupancy = OccupancyGrid(
        origin=np.full(3, -1.5),
        voxel=0.5,
        log_odds=np.full(shape, -2.0, np.float32),
        num_updates=np.ones(shape, np.uint16),
        entity=np.zeros(shape, np.uint8),
    )
    writer.snapshot(5 * SECOND, before(), known(occupancy), np.full(shape, 1, np.uint8))
    writer.snapshot(7 * SECOND, after(before()), known(occupancy), np.full(shape, 2, np.uint8))
    writer.finish(7 * SECOND, after(before()), known(occupancy))
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": 7 * SECOND}
    (folder / "run.json").write_text(json.dumps({"metrics": metrics}))
    return folder


@pytest.fixture(scope="module")
def fields(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole bakes at both times."""
    folder = tmp_path_factory.mktemp("fields")
    for at in ("0", "2"):
        assert bake(scene, folder / at, BOX, "--at", at) == 0
    return folder


def bake(scene: Path, out: Path, *more: str) -> int:
    return main(["sdf-bake", str(scene), "-o", str(out), *OPTIONS, *more])


def field_json(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "field.json").read_text())
    return content


def test_an_update_is_the_whole_bake_to_the_byte(scene: Path, fields: Path, tmp_path: Path) -> None:
    assert bake(scene, tmp_path / "field", "--at", "2", "--update", str(fields / "0")) == 0
    assert (tmp_path / "field" / "field.npz").read_bytes() == (fields / "2" / "field.npz").read_bytes()
    assert (fields / "0" / "field.npz").read_bytes() != (fields / "2" / "field.npz").read_bytes()
    said = field_json(tmp_path / "field")
    update = said.pop("update")
    assert 0 < update["blocks_baked"] < 0.6 * update["blocks"]
    assert said == field_json(fields / "2"), "the note is all that differs"


def test_an_update_can_be_in_slabs_and_interrupted(
    scene: Path, fields: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slabs, "SLAB_BYTES", 1)
    given = ["--at", "2", "--update", str(fields / "0")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("splatctrl_cli.field.header.label_counts", interrupt)
        assert bake(scene, tmp_path / "field", *given) == 130
    assert bake(scene, tmp_path / "field", *given, "--resume") == 0
    assert (tmp_path / "field" / "field.npz").read_bytes() == (fields / "2" / "field.npz").read_bytes()
    assert bake(scene, tmp_path / "other", *given[2:], "--at", "0", "--resume") == 0
    assert (tmp_path / "other" / "field.npz").read_bytes() == (fields / "0" / "field.npz").read_bytes()


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_a_bare_file_needs_its_predecessor(fields: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, new = tmp_path / "old.ply", tmp_path / "new.ply"
    write_ply(old, before(), {})
    write_ply(new, after(before()), {})
    assert bake(old, tmp_path / "first", BOX) == 0
    assert bake(new, tmp_path / "whole", BOX) == 0
    capsys.readouterr()
    given = ["--update", str(tmp_path / "first")]
    assert bake(new, tmp_path / "field", *given) == 2
    assert "was not baked from the splats of" in capsys.readouterr().err
    assert bake(new, tmp_path / "field", *given, "--previous-scene", str(old)) == 0
    assert (tmp_path / "field" / "field.npz").read_bytes() == (tmp_path / "whole" / "field.npz").read_bytes()


def test_a_field_that_every_splat_reaches_is_baked_anew_and_says_so(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--distance", "gpdf", "--voxel", "0.1", "--set", "field.max_loss=1"]
    assert bake(scene, tmp_path / "0", BOX, "--at", "0", *given) == 0
    assert bake(scene, tmp_path / "2", BOX, "--at", "2", *given) == 0
    words = ["--at", "2", "--update", str(tmp_path / "0"), *given, *OPTIONS[2:-1]]
    assert main(["sdf-bake", str(scene), "-o", str(tmp_path / "field"), *words]) == 0
    assert "every block is baked anew: every splat reaches every cell of gpdf" in capsys.readouterr().err
    assert (tmp_path / "field" / "field.npz").read_bytes() == (tmp_path / "2" / "field.npz").read_bytes()
    update = field_json(tmp_path / "field")["update"]
    assert update["blocks_baked"] == update["blocks"]
    assert "gpdf" in update["why_all"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--voxel", "0.05"], "field.voxel was 0.025, is 0.05, cells was"),
        (["--length-scale", "0.03"], "field.length_scale was 0.02, is 0.03"),
        (["--distance", "hard"], "field.distance was safe, is hard"),
        (["--channels", "sdf"], "channels was bound,gradient,observed,sdf, is sdf"),
        (["--include", "none"], "labels was ['human', 'object'], is ['object']"),
        (["--box=-0.6,-0.6,-0.5,0.6,0.6,0.6"], "cells was 49 x 49 x 41, is 49 x 49 x 45"),
    ],
)
def test_what_was_baked_otherwise_is_not_updated(
    scene: Path, fields: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], words: str
) -> None:
    assert bake(scene, tmp_path / "field", "--update", str(fields / "0"), *more) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert "bake without --update" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("harm", "code", "words"),
    [
        ("cut", 4, "field.npz: was changed after it was written"),
        ("foreign", 4, "field.npz: was changed after it was written"),
        ("no npz", 4, "field.npz: missing"),
        ("no run", 4, "has no readable run.json"),
        ("other version", 2, "got one of sdf-bake of 0.0.0"),
        ("other command", 2, "got one of replay of"),
    ],
)
def test_a_damaged_or_foreign_field_is_not_updated(
    scene: Path, fields: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], harm: str, code: int, words: str
) -> None:
    old = tmp_path / "old"
    shutil.copytree(fields / "0", old)
    npz, run = old / "field.npz", json.loads((old / "run.json").read_text())
    if harm == "cut":
        npz.write_bytes(npz.read_bytes()[:-2000])
    elif harm == "foreign":
        np.savez(npz, a=np.zeros(3))
    elif harm == "no npz":
        npz.unlink()
    elif harm == "no run":
        (old / "run.json").write_text("{")
    else:
        run |= {"splatctrl": "0.0.0"} if harm == "other version" else {"command": "replay"}
        (old / "run.json").write_text(json.dumps(run))
    assert bake(scene, tmp_path / "field", "--update", str(old)) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (tmp_path / "field").exists() and not (tmp_path / "field.partial").exists()


def test_the_field_that_is_updated_is_not_replaced(
    scene: Path, fields: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bake(scene, fields / "0", "--update", str(fields / "0"), "--force") == 2
    assert "would replace the input" in capsys.readouterr().err
