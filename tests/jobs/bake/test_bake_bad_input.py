"""Bakes of splats and grids at the edge of what can be baked, and beyond."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.bake.bake import BakeResult
from splatctrl_cli.records import Label, SplatSet
from tests.field.scenes import cloud, splat_set
from tests.jobs.bake.baked import baked, field_json

BOX = (-0.2, -0.2, -0.2, 0.2, 0.2, 0.2)


def bake(splats: SplatSet, folder: Path, **more: Any) -> BakeResult:
    write_ply(folder / "splats.ply", splats, {})
    return baked(folder / "splats.ply", folder / "field", voxel=0.05, **more)


def spheres(num: int = 5, seed: int = 0) -> SplatSet:
    centers, radii = cloud(num, seed)
    return splat_set(centers, radii + 0.001)


def test_an_empty_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises((InputError, NotEvaluableError)):
        bake(spheres().select(np.zeros(5, bool)), tmp_path)
    with pytest.raises(NotEvaluableError, match="none of 5 is labelled object, human; give a scene that has some"):
        bake(replace(spheres(), labels=np.full(5, Label.ROBOT, np.uint8)), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["splats.ply"]


@pytest.mark.parametrize("name", ["one", "duplicates", "tiny radii", "mixed radii"])
def test_odd_splats_are_baked(tmp_path: Path, name: str) -> None:
    made = {
        "one": spheres(1),
        "duplicates": splat_set(np.zeros((40, 3)), np.full(40, 0.01)),
        "tiny radii": splat_set(cloud(40)[0], np.full(40, 1e-9)),
        "mixed radii": splat_set(cloud(40)[0], np.geomspace(0.001, 0.3, 40)),
    }
    bake(made[name], tmp_path, box=BOX, channels=("gradient", "bound", "hard", "se", "gpdf", "label"))
    channels = read_npz(tmp_path / "field" / "field.npz").channels
    assert all(np.isfinite(values).all() for values in channels.values())
    assert (channels["sdf"] <= channels["hard"]).all()


def test_a_box_without_a_splat_is_baked_with_a_note(tmp_path: Path) -> None:
    result = bake(spheres(), tmp_path, box=(5, 5, 5, 5.2, 5.2, 5.2))
    assert any("the box holds no splat: the nearest is" in reason.sentence for reason in result.verdict.said)
    said = field_json(result.out)
    assert any("holds no splat" in warning for warning in said["warnings"])
    assert said["statistics"]["lowest"] > 4.0
