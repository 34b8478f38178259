"""``splatctrl sdf-bake`` with splats and grids at the edge of what can be baked, and beyond."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.grid_files.grid import read_npz
from splatctrl_cli.records import Label, SplatSet
from splatctrl_cli.splat_files.splats import write_ply
from tests.field.scenes import cloud, splat_set

BOX = "--box=-0.2,-0.2,-0.2,0.2,0.2,0.2"


def bake(splats: SplatSet, folder: Path, *more: str) -> int:
    write_ply(folder / "splats.ply", splats, {})
    given = ["sdf-bake", str(folder / "splats.ply"), "-o", str(folder / "field"), "--voxel", "0.05", "--no-report"]
    given += ["--set", "field.max_loss=1"]
    return main([*given, *more])


def spheres(num: int = 5, seed: int = 0) -> SplatSet:
    centers, radii = cloud(num, seed)
    return splat_set(centers, radii + 0.001)


def refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    assert [path.name for path in folder.iterdir()] == ["splats.ply"]
    return line


def test_an_empty_set_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nothing = spheres().select(np.zeros(5, bool))
    assert bake(nothing, tmp_path) in (4, 5)
    assert refused(tmp_path, capsys)
    assert bake(replace(spheres(), labels=np.full(5, Label.ROBOT, np.uint8)), tmp_path) == 5
    assert "none of 5 is labelled object, human; give a scene that has some" in refused(tmp_path, capsys)


def test_a_centre_that_is_no_number_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "splats.ply", spheres(), {})
    content = (tmp_path / "splats.ply").read_bytes()
    place = content.index(b"end_header\n") + len(b"end_header\n")
    harmed = content[:place] + np.float32(np.nan).tobytes() + content[place + 4 :]
    (tmp_path / "splats.ply").write_bytes(harmed)
    given = ["sdf-bake", str(tmp_path / "splats.ply"), "-o", str(tmp_path / "field")]
    assert main(given) == 4
    assert "splats.ply" in refused(tmp_path, capsys)


@pytest.mark.parametrize("name", ["one", "duplicates", "tiny radii", "mixed radii"])
def test_odd_splats_are_baked(tmp_path: Path, name: str) -> None:
    made = {
        "one": spheres(1),
        "duplicates": splat_set(np.zeros((40, 3)), np.full(40, 0.01)),
        "tiny radii": splat_set(cloud(40)[0], np.full(40, 1e-9)),
        "mixed radii": splat_set(cloud(40)[0], np.geomspace(0.001, 0.3, 40)),
    }
    assert bake(made[name], tmp_path, BOX, "--channels", "gradient,bound,hard,se,gpdf,label", "-q") == 0
    channels = read_npz(tmp_path / "field" / "field.npz").channels
    assert all(np.isfinite(values).all() for values in channels.values())
    assert (channels["sdf"] <= channels["hard"]).all()


@pytest.mark.parametrize("length", ["1e-10", "1e-4", "1", "1e2"])
@pytest.mark.parametrize("distance", ["safe", "safe_gpdf"])
def test_any_length_scale_is_baked(tmp_path: Path, length: str, distance: str) -> None:
    more = ["--length-scale", length, "--distance", distance, "-q"]
    assert bake(spheres(50), tmp_path, BOX, *more, "--channels", "hard") == 0
    channels = read_npz(tmp_path / "field" / "field.npz").channels
    assert np.isfinite(channels["sdf"]).all()
    assert (channels["sdf"] <= channels["hard"]).all()


def test_a_box_without_a_splat_is_baked_with_a_note(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bake(spheres(), tmp_path, "--box=5,5,5,5.2,5.2,5.2") == 0
    assert "\n  note: field: the box holds no splat: the nearest is" in capsys.readouterr().out
    said = json.loads((tmp_path / "field" / "field.json").read_text())
    assert any("holds no splat" in warning for warning in said["warnings"])
    assert said["statistics"]["lowest"] > 4.0


def test_unknown_space_of_a_bare_splat_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for policy in ("nan", "obstacle"):
        assert bake(spheres(), tmp_path, BOX, "--unknown", policy) == 5
        assert f"field.unknown = {policy}: expected a cell that a camera saw" in refused(tmp_path, capsys)
        assert bake(spheres(), tmp_path, BOX, "--unknown", policy, "--channels", "bound") == 2
        assert "bake the channel observed as well" in refused(tmp_path, capsys)


def test_options_and_configuration_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    options = ["--distance", "safe_gpdf", "--weights", "voxel", "--length-scale", "0.03", "--unknown", "free"]
    keys = ["distance=safe_gpdf", "weights=voxel", "length_scale=0.03", "unknown=free"]
    assert bake(spheres(30), tmp_path / "a", BOX, "-q", *options) == 0
    assert (
        bake(spheres(30), tmp_path / "b", BOX, "-q", *(part for key in keys for part in ("--set", f"field.{key}")))
        == 0
    )
    first, second = ((tmp_path / name / "field" / "field.npz").read_bytes() for name in "ab")
    assert first == second
