import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.grid.grid_format import GridSlabs, SlabPlan, resume_slabs, start_slabs
from splatctrl_cli.records import DistanceGrid
from tests.formats.grid.make_grid import SHAPE, random_grid

CHANNELS = ("sdf", "gradient", "observed")
PLAN = SlabPlan(
    origin=(-0.1, 0.2, 0.3), voxel=0.02, shape=SHAPE, channels=CHANNELS, settings={"noise": 1e-6, "digest": "a"}
)


def fill(slabs: GridSlabs, grid: DistanceGrid, *, until: int, step: int = 2) -> None:
    while slabs.num_layers < until:
        stop = min(slabs.num_layers + step, until)
        slabs.write({name: grid.channels[name][slabs.num_layers : stop] for name in CHANNELS})


def test_slabs_give_the_grid_they_were_cut_from(tmp_path: Path) -> None:
    grid = random_grid(*CHANNELS)
    slabs = start_slabs(tmp_path / "slabs", PLAN)
    fill(slabs, grid, until=SHAPE[0])
    read = slabs.grid({"a": 1})
    assert (read.header, read.voxel, read.origin.tolist()) == ({"a": 1}, 0.02, [-0.1, 0.2, 0.3])
    for name in CHANNELS:
        assert isinstance(read.channels[name], np.memmap)
        np.testing.assert_array_equal(read.channels[name], grid.channels[name])
        assert not read.channels[name].flags.writeable


def test_an_interrupted_bake_goes_on_where_the_last_whole_slab_ended(tmp_path: Path) -> None:
    grid = random_grid(*CHANNELS)
    folder = tmp_path / "slabs"
    fill(start_slabs(folder, PLAN), grid, until=2)
    with (folder / "sdf.npy").open("r+b") as stream:  # half of a slab that was not counted
        stream.seek(-4 * SHAPE[1] * SHAPE[2] * 3, 2)
        stream.write(b"\x01" * 40)
    slabs = resume_slabs(folder, PLAN)
    assert (slabs.num_layers, slabs.is_whole()) == (2, False)
    with pytest.raises(InputError, match="expected 5 layers, got 2; continue the bake"):
        slabs.grid({})
    fill(slabs, grid, until=SHAPE[0], step=3)
    for name in CHANNELS:
        np.testing.assert_array_equal(slabs.grid({}).channels[name], grid.channels[name])
    assert resume_slabs(folder, PLAN).is_whole()


def test_what_was_baked_otherwise_is_not_gone_on_with(tmp_path: Path) -> None:
    folder = tmp_path / "slabs"
    fill(start_slabs(folder, PLAN), random_grid(*CHANNELS), until=2)
    other = replace(PLAN, settings={"noise": 1e-3, "digest": "a"}, voxel=0.04)
    with pytest.raises(
        UsageError, match=r"voxel was 0.02, is 0.04, noise was 1e-06, is 0.001; bake without --resume"
    ):
        resume_slabs(folder, other)
    assert resume_slabs(folder, PLAN).num_layers == 2


def test_without_anything_left_it_starts_at_the_beginning(tmp_path: Path) -> None:
    assert resume_slabs(tmp_path / "slabs", PLAN).num_layers == 0
    fill(resume_slabs(tmp_path / "slabs", PLAN), random_grid(*CHANNELS), until=2)
    assert start_slabs(tmp_path / "slabs", PLAN).num_layers == 0
    assert resume_slabs(tmp_path / "slabs", PLAN).num_layers == 0


def test_damaged_remains_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "slabs"
    start_slabs(folder, PLAN)
    (folder / "sdf.npy").unlink()
    with pytest.raises(InputError, match=r"sdf.npy: expected \(5, 4, 11\), got no such array"):
        resume_slabs(folder, PLAN)
    np.save(folder / "sdf.npy", np.zeros(3))
    with pytest.raises(InputError, match=r"sdf.npy: expected \(5, 4, 11\), got no such array"):
        resume_slabs(folder, PLAN)
    (folder / "progress.json").write_text(json.dumps({"plan": 3}))
    with pytest.raises(InputError, match=r"progress.json: not readable"):
        resume_slabs(folder, PLAN)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gradient": None}, "expected the channels sdf, gradient, observed, got sdf, observed"),
        ({"sdf": np.zeros((2, 4, 10), "f4")}, "slab: sdf at layer 0 of 5: expected"),
        ({"sdf": np.zeros((2, 4, 11))}, "slab: sdf at layer 0 of 5: expected"),
    ],
)
def test_a_slab_that_does_not_fit_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    grid = random_grid(*CHANNELS)
    slab = {**{name: grid.channels[name][:2] for name in CHANNELS}, **change}
    slabs = start_slabs(tmp_path / "slabs", PLAN)
    with pytest.raises(InputError, match=message):
        slabs.write({name: values for name, values in slab.items() if values is not None})  # type: ignore[misc]
    fill(slabs, grid, until=5)
    with pytest.raises(InputError, match="slab: sdf at layer 5 of 5"):
        slabs.write({name: grid.channels[name][:2] for name in CHANNELS})
