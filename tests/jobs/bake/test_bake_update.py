"""Updates of a field: only what changed is baked, and the files are those of a whole bake."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import SplatCtrlError, UsageError
from splatctrl_cli.field import slabs
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.bake.bake import BakeResult
from splatctrl_cli.records import Label, SplatSet
from tests.field.scenes import cloud, splat_set
from tests.jobs.bake.baked import Said, baked, field_json
from tests.jobs.stopped import interrupt
from tests.plain import known, plain_grid

BOX = (-0.6, -0.6, -0.5, 0.6, 0.6, 0.5)
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
    occupancy = plain_grid(shape, 0.5, -1.5)
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
    for at in (0, 2):
        bake(scene, folder / str(at), box=BOX, at=at)
    return folder


def bake(scene: Path, out: Path, *, voxel: float = 0.025, **more: Any) -> BakeResult:
    return baked(scene, out, voxel=voxel, **more)


def npz(folder: Path) -> bytes:
    return (folder / "field.npz").read_bytes()


def test_an_update_is_the_whole_bake_to_the_byte(scene: Path, fields: Path, tmp_path: Path) -> None:
    bake(scene, tmp_path / "field", at=2, update=fields / "0")
    assert npz(tmp_path / "field") == npz(fields / "2")
    assert npz(fields / "0") != npz(fields / "2")
    said = field_json(tmp_path / "field")
    update = said.pop("update")
    assert 0 < update["blocks_baked"] < 0.6 * update["blocks"]
    assert said == field_json(fields / "2"), "the note is all that differs"


def test_an_update_can_be_in_slabs_and_interrupted(
    scene: Path, fields: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slabs, "SLAB_BYTES", 1)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("splatctrl_cli.field.header.label_counts", interrupt)
        bake(scene, tmp_path / "field", at=2, update=fields / "0")
    bake(scene, tmp_path / "field", at=2, update=fields / "0", resume=True)
    assert npz(tmp_path / "field") == npz(fields / "2")
    bake(scene, tmp_path / "other", at=0, update=fields / "0", resume=True)
    assert npz(tmp_path / "other") == npz(fields / "0")


def test_a_bare_file_needs_its_predecessor(tmp_path: Path) -> None:
    old, new = tmp_path / "old.ply", tmp_path / "new.ply"
    write_ply(old, before(), {})
    write_ply(new, after(before()), {})
    bake(old, tmp_path / "first", box=BOX)
    bake(new, tmp_path / "whole", box=BOX)
    with pytest.raises(UsageError, match="was not baked from the splats of"):
        bake(new, tmp_path / "field", update=tmp_path / "first")
    bake(new, tmp_path / "field", update=tmp_path / "first", previous_scene=old)
    assert npz(tmp_path / "field") == npz(tmp_path / "whole")


def test_a_field_that_every_splat_reaches_is_baked_anew_and_says_so(scene: Path, tmp_path: Path) -> None:
    given, said = {"voxel": 0.1, "field": {"distance": "gpdf"}}, Said()
    for at in (0, 2):
        bake(scene, tmp_path / str(at), box=BOX, at=at, **given)
    bake(scene, tmp_path / "field", at=2, update=tmp_path / "0", progress=said, **given)
    assert said.lines == ["--update: every block is baked anew: every splat reaches every cell of gpdf"]
    assert npz(tmp_path / "field") == npz(tmp_path / "2")
    update = field_json(tmp_path / "field")["update"]
    assert update["blocks_baked"] == update["blocks"]
    assert "gpdf" in update["why_all"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"voxel": 0.05}, "field.voxel was 0.025, is 0.05, cells was"),
        ({"field": {"length_scale": 0.03}}, "field.length_scale was 0.02, is 0.03"),
        ({"field": {"distance": "hard"}}, "field.distance was safe, is hard"),
        ({"channels": ("sdf",)}, "channels was bound,gradient,observed,sdf, is sdf"),
        ({"labels": frozenset({Label.OBJECT})}, "labels was ['human', 'object'], is ['object']"),
        ({"box": (-0.6, -0.6, -0.5, 0.6, 0.6, 0.6)}, "cells was 49 x 49 x 41, is 49 x 49 x 45"),
    ],
)
def test_what_was_baked_otherwise_is_not_updated(
    scene: Path, fields: Path, tmp_path: Path, more: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError, match=f"{re.escape(words)}.*bake without --update"):
        bake(scene, tmp_path / "field", update=fields / "0", **more)
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
    scene: Path, fields: Path, tmp_path: Path, harm: str, code: int, words: str
) -> None:
    old = tmp_path / "old"
    shutil.copytree(fields / "0", old)
    file, run = old / "field.npz", json.loads((old / "run.json").read_text())
    if harm == "cut":
        file.write_bytes(file.read_bytes()[:-2000])
    elif harm == "foreign":
        np.savez(file, a=np.zeros(3))
    elif harm == "no npz":
        file.unlink()
    elif harm == "no run":
        (old / "run.json").write_text("{")
    else:
        run |= {"splatctrl": "0.0.0"} if harm == "other version" else {"command": "replay"}
        (old / "run.json").write_text(json.dumps(run))
    with pytest.raises(SplatCtrlError, match=words) as refused:
        bake(scene, tmp_path / "field", update=old)
    assert refused.value.exit_code == code
    assert not (tmp_path / "field").exists() and not (tmp_path / "field.partial").exists()
