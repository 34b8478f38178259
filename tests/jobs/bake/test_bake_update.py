"""What a bake keeps in an update, tells of its accuracy, and does with odd splats."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from splatctrl_cli.errors import InputError, NotEvaluableError, SplatCtrlError, UsageError
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.field import slabs
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.formats.splat.splats import read_ply, write_ply
from splatctrl_cli.jobs.bake.accuracy import counts_of
from splatctrl_cli.records import Label, SplatSet
from splatctrl_cli.simulate.truth import load_truth
from tests.cli.replay_desk import write_scene
from tests.field.scenes import cloud, splat_set
from tests.jobs.bake.baked import Said, baked, field_json
from tests.jobs.stage import interrupt, patch_json
from tests.plain import known, plain_grid
from tests.refused import expect_refusal

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
    return replace(splats, centers=centers).select(np.arange(len(splats)) != 7)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of two snapshots that differ in two splats, and in what was seen."""
    folder, voxels = tmp_path_factory.mktemp("scene"), known(plain_grid((6, 6, 6), 0.5, -1.5))
    writer = SceneWriter(folder, {})
    writer.snapshot(5 * SECOND, before(), voxels, np.full((6, 6, 6), 1, np.uint8))
    writer.snapshot(7 * SECOND, after(before()), voxels, np.full((6, 6, 6), 2, np.uint8))
    writer.finish(7 * SECOND, after(before()), voxels)
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


def bake(scene: Path, out: Path, *, voxel: float = 0.025, **more: Any) -> JudgedResult:
    return baked(scene, out, voxel=voxel, **more)


def npz(folder: Path) -> bytes:
    return (folder / "field.npz").read_bytes()


def test_an_update_is_the_whole_bake_to_the_byte(scene: Path, fields: Path, tmp_path: Path) -> None:
    bake(scene, tmp_path / "field", at=2, update=fields / "0")
    assert npz(tmp_path / "field") == npz(fields / "2") != npz(fields / "0")
    said = field_json(tmp_path / "field")
    update = said.pop("update")
    assert 0 < update["blocks_baked"] < 0.6 * update["blocks"]
    assert said == field_json(fields / "2"), "the note is all that differs"


def test_an_update_can_be_in_slabs_and_interrupted(
    scene: Path, fields: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slabs, "SLAB_BYTES", 1)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("splatctrl_cli.field.slabs.label_counts", interrupt)
        bake(scene, tmp_path / "field", at=2, update=fields / "0")
    bake(scene, tmp_path / "field", at=2, update=fields / "0", resume=True)
    assert npz(tmp_path / "field") == npz(fields / "2")
    bake(scene, tmp_path / "other", at=0, update=fields / "0", resume=True)
    assert npz(tmp_path / "other") == npz(fields / "0")


def test_a_bare_file_needs_its_predecessor(tmp_path: Path) -> None:
    old, new = tmp_path / "old.ply", tmp_path / "new.ply"
    for path, splats, field in ((old, before(), "first"), (new, after(before()), "whole")):
        write_ply(path, splats, {})
        bake(path, tmp_path / field, box=BOX)
    expect_refusal(
        "was not baked from the splats of", bake, new, tmp_path / "field", update=tmp_path / "first", error=UsageError
    )
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
    assert update["blocks_baked"] == update["blocks"] and "gpdf" in update["why_all"]


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
    expect_refusal(
        f"{re.escape(words)}.*bake without --update",
        bake,
        scene,
        tmp_path / "field",
        update=fields / "0",
        error=UsageError,
        **more,
    )
    assert not list(tmp_path.iterdir())


def cut(field: Path) -> None:
    (field / "field.npz").write_bytes((field / "field.npz").read_bytes()[:-2000])


def replace_arrays(field: Path) -> None:
    np.savez(field / "field.npz", a=np.zeros(3))


def remove(field: Path) -> None:
    (field / "field.npz").unlink()


def break_run(field: Path) -> None:
    (field / "run.json").write_text("{")


def change_run(field: Path, **changes: str) -> None:
    patch_json(field / "run.json", lambda run: run | changes)


@pytest.mark.parametrize(
    ("harm", "code", "words"),
    [
        (cut, 4, "field.npz: was changed after it was written"),
        (replace_arrays, 4, "field.npz: was changed after it was written"),
        (remove, 4, "field.npz: missing"),
        (break_run, 4, "has no readable run.json"),
        (partial(change_run, splatctrl="0.0.0"), 2, "got one of sdf-bake of 0.0.0"),
        (partial(change_run, command="replay"), 2, "got one of replay of"),
    ],
    ids=["cut", "foreign", "no npz", "no run", "other version", "other command"],
)
def test_a_damaged_or_foreign_field_is_not_updated(
    scene: Path, fields: Path, tmp_path: Path, harm: Callable[[Path], None], code: int, words: str
) -> None:
    harm(shutil.copytree(fields / "0", tmp_path / "old"))
    with pytest.raises(SplatCtrlError, match=words) as refused:
        bake(scene, tmp_path / "field", update=tmp_path / "old")
    assert refused.value.exit_code == code
    assert [path.name for path in tmp_path.iterdir()] == ["old"]


TRUE_BOX = np.array([[0.4, -0.15, -0.05], [0.7, 0.15, 0.2]])


@pytest.fixture(scope="module")
def true_splats(sample_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small splats on the true surfaces about the box, but for the robot."""
    truth = load_truth(sample_data / "tabletop" / "truth.json")
    near = np.random.default_rng(0).uniform(TRUE_BOX[0] - 0.25, TRUE_BOX[1] + 0.25, (80_000, 3))
    distance, surface = truth.closest(near, int(truth.stamps[-1]))
    surface = surface[np.abs(distance) < 0.1]
    path = tmp_path_factory.mktemp("true") / "true.ply"
    write_ply(path, splat_set(surface, np.full(len(surface), 0.002)), {})
    return path


def bake_true(scene: Path, out: Path, **more: Any) -> JudgedResult:
    return baked(scene, out, voxel=0.03, box=tuple(TRUE_BOX.ravel()), **more)


def test_held_out_depth_agrees_with_splats_on_the_true_surface(
    true_splats: Path, sample_data: Path, tmp_path: Path
) -> None:
    folder = sample_data / "tabletop"
    robot = {"urdf": folder / "robot.urdf", "spheres": folder / "robot_spheres.yaml"}
    held_out = {"held_out": folder / "log.mcap", "held_out_cameras": ("cam3",)}
    found = bake_true(true_splats, tmp_path / "field", **held_out, **robot).document["accuracy"]["held_out_depth"]
    near, least = found["before"]["seen"]["sdf"][0], found["on_surface"]["hard"]["median"]
    half_a_cell = 0.015  # which the interpolation of a surface between two cells may read on it
    assert 0 < least < half_a_cell and abs(near["median"]) < half_a_cell
    assert found["num_frames"] == 1 and near["count"] > 20
    with_robot = bake_true(true_splats, tmp_path / "robot", **held_out).document["accuracy"]["held_out_depth"]
    assert with_robot["num_measured"] > found["num_measured"], (
        "the robot's pixels count where nothing says where it is"
    )


def test_depth_later_than_the_scene_does_not_count(true_splats: Path, sample_data: Path, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", (1, read_ply(true_splats)[0]))
    log = sample_data / "tabletop" / "log.mcap"
    expect_refusal(
        "no frame of cam3 up to the time of the scene",
        bake_true,
        scene,
        tmp_path / "field",
        held_out=log,
        held_out_cameras=("cam3",),
        error=NotEvaluableError,
    )


def test_probability_is_held_to_the_truth(true_splats: Path, sample_data: Path, tmp_path: Path) -> None:
    folder = sample_data / "tabletop"
    truth = {"truth": folder / "truth.json", "seen_by": folder / "log.mcap"}
    result = bake_true(true_splats, tmp_path / "field", **truth, with_probability=True, no_report=False)
    found = result.document["accuracy"]["truth"]
    calibrated, paper = found["reliability"]["calibrated"], found["reliability"]["paper"]
    assert calibrated["count"].sum() == paper["count"].sum() > 50
    assert 0 < found["error_sigma"] < 0.02 and calibrated["calibration_error"] < 0.2
    pictures = sorted(path.name for path in (tmp_path / "field" / "report").iterdir())
    assert pictures == ["gradient.png", "probability.png", "reliability.png", "slices.png"]


def test_a_mesh_is_compared_with(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    ball.apply_translation([0.55, 0.0, 0.08])
    ball.export(tmp_path / "ball.ply")
    write_ply(tmp_path / "splats.ply", splat_set(np.array(ball.vertices), np.full(len(ball.vertices), 0.001)), {})
    bake_true(tmp_path / "splats.ply", tmp_path / "field", reference_mesh=tmp_path / "ball.ply")
    found = field_json(tmp_path / "field")["accuracy"]["reference_mesh"]
    assert found["file"] == "ball.ply" and found["is_closed"] is True
    assert all(band["rmse"] < 0.003 for band in found["everywhere"]["hard"] if band["count"])


def test_a_figure_of_a_band_rests_on_the_cells_of_that_band() -> None:
    figures = {"num_cells": 1000, "voxel": 0.02, "seen.hard.0_2cm.count": 0, "seen.hard.0_2cm.rmse": None}
    figures |= {"over_estimate.count": 7, "over_estimate.count_beyond": 0}
    counts = counts_of(figures)
    assert (counts["seen.hard.0_2cm.rmse"], counts["over_estimate.count_beyond"]) == (0, 7)
    assert counts["voxel"] == counts["seen.hard.0_2cm.count"] == 1000


SMALL_BOX = (-0.2, -0.2, -0.2, 0.2, 0.2, 0.2)


def bake_splats(splats: SplatSet, folder: Path, **more: Any) -> JudgedResult:
    write_ply(folder / "splats.ply", splats, {})
    return baked(folder / "splats.ply", folder / "field", voxel=0.05, **more)


def spheres(num: int = 5, seed: int = 0) -> SplatSet:
    centers, radii = cloud(num, seed)
    return splat_set(centers, radii + 0.001)


def test_an_empty_set_is_refused(tmp_path: Path) -> None:
    expect_refusal(
        "", bake_splats, spheres().select(np.zeros(5, bool)), tmp_path, error=(InputError, NotEvaluableError)
    )
    expect_refusal(
        "none of 5 is labelled object, human; give a scene that has some",
        bake_splats,
        replace(spheres(), labels=np.full(5, Label.ROBOT, np.uint8)),
        tmp_path,
        error=NotEvaluableError,
    )
    assert [path.name for path in tmp_path.iterdir()] == ["splats.ply"]


@pytest.mark.parametrize(
    "splats",
    [
        spheres(1),
        splat_set(np.zeros((40, 3)), np.full(40, 0.01)),
        splat_set(cloud(40)[0], np.full(40, 1e-9)),
        splat_set(cloud(40)[0], np.geomspace(0.001, 0.3, 40)),
    ],
    ids=["one", "duplicates", "tiny radii", "mixed radii"],
)
def test_odd_splats_are_baked(tmp_path: Path, splats: SplatSet) -> None:
    bake_splats(splats, tmp_path, box=SMALL_BOX, channels=("gradient", "bound", "hard", "se", "gpdf", "label"))
    channels = read_npz(tmp_path / "field" / "field.npz").channels
    assert all(np.isfinite(values).all() for values in channels.values())
    assert (channels["sdf"] <= channels["hard"]).all()


def test_a_box_without_a_splat_is_baked_with_a_note(tmp_path: Path) -> None:
    result = bake_splats(spheres(), tmp_path, box=(5, 5, 5, 5.2, 5.2, 5.2))
    assert any("the box holds no splat: the nearest is" in reason.sentence for reason in result.verdict.shown)
    said = field_json(result.out)
    assert any("holds no splat" in warning for warning in said["warnings"])
    assert said["statistics"]["lowest"] > 4.0
