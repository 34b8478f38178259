"""What every file of a grid keeps: written, described, read back, refused where cut; and bakes in slabs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.grid import grid_format
from splatctrl_cli.formats.grid.grid_format import GridFormat, GridSlabs, SlabPlan, resume_slabs, start_slabs
from splatctrl_cli.formats.grid.grid_formats import FORMATS, check_formats, write_grid
from splatctrl_cli.recording.source import describe
from splatctrl_cli.records import DistanceGrid
from tests.formats.grid.make_grid import HEADER, SHAPE, ball_grid, random_grid, with_unknown

PLACE = {"shape": [21, 22, 23], "voxel": 0.04}
MADE = {key: HEADER[key] for key in ("distance", "splats_used", "labels", "frame")}
DESCRIBED: dict[str, tuple[str, dict[str, object]]] = {  # what `info` calls a file of a ball's grid, and says of it
    "npz": ("distance grid", PLACE | MADE),
    "vti": ("ParaView image data", PLACE | MADE),
    "nrrd": ("NRRD", {"sizes": "21 22 23"} | MADE),
    "vdb": ("OpenVDB", {"grids": 3} | MADE),
    "curobo": ("cuRobo voxel grid", {"curobo": "0.7", "channel": "sdf"} | PLACE | MADE),
    "moveit": ("MoveIt distance field", PLACE),
    "ply": ("PLY", {"format": "binary_little_endian 1.0"}),
    "obj": ("mesh", {"is_watertight": True}),
    "stl": ("mesh", {"is_watertight": True}),
}


@pytest.fixture(params=FORMATS.values(), ids=FORMATS)
def kind(request: pytest.FixtureRequest) -> GridFormat:
    """Each format whose library is installed."""
    found: GridFormat = request.param
    try:
        found.check()
    except UsageError as error:
        pytest.skip(str(error))
    return found


def mapped(folder: Path, grid: DistanceGrid) -> DistanceGrid:
    """The same grid with its channels on disk."""
    shape = grid.channels["sdf"].shape
    plan = SlabPlan(origin=tuple(grid.origin.tolist()), voxel=grid.voxel, shape=shape, channels=tuple(grid.channels))
    slabs = start_slabs(folder, plan)
    slabs.write(grid.channels)
    return slabs.grid(grid.header)


def test_memory_maps_are_written_as_arrays_are_in_whatever_pieces(
    tmp_path: Path, kind: GridFormat, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = ball_grid()
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    files = write_grid(tmp_path / "a", grid, [kind.name])
    monkeypatch.setattr(grid_format, "CHUNK", 1)
    write_grid(tmp_path / "b", mapped(tmp_path / "slabs", grid), [kind.name])
    assert sorted(files) == sorted((tmp_path / "a").iterdir())
    assert len(files) == (len(grid.channels) if kind.is_per_channel else 1)
    for file in files:
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_the_files_are_as_large_as_the_format_says(tmp_path: Path, kind: GridFormat) -> None:
    grid = ball_grid()
    size = grid.channels["sdf"].size * kind.size_per_cell(4 * len(grid.channels))
    total = sum(file.stat().st_size for file in write_grid(tmp_path, grid, [kind.name]))
    assert size == 0 or total <= size + 2**14
    assert kind.name == "vdb" or total >= 0.5 * size, "only OpenVDB's are packed"


def test_every_file_is_described_and_refused_in_one_line_where_it_is_cut(tmp_path: Path, kind: GridFormat) -> None:
    grid = ball_grid()
    name, facts = DESCRIBED[kind.name]
    for file in write_grid(tmp_path, grid, [kind.name]):
        summary = describe(file)
        assert summary.kind == name
        assert {key: summary.facts.get(key) for key in facts} == facts
        if "first_cell" in summary.facts:
            assert summary.facts["first_cell"] == np.round(grid.origin, 6).tolist()
        if kind.read is not None:
            assert summary.grids[0].rows == [[channel, "f4", "m"] for channel in grid.channels]
        content = file.read_bytes()
        for length, read in ((60, describe), (100, describe), (100, kind.read), (len(content) // 2, kind.read)):
            file.write_bytes(content[:length])
            if read is not None:
                with pytest.raises(InputError) as refused:
                    read(file)
                assert refused.value.remedy
                assert "\n" not in str(refused.value)


@pytest.mark.parametrize("channels", [(), ("sdf",), ("label", "sdf", "gradient")])
@pytest.mark.parametrize("name", [name for name, kind in FORMATS.items() if kind.read is not None])
def test_a_grid_is_read_back_from_the_files_that_hold_it_whole(
    tmp_path: Path, name: str, channels: tuple[str, ...]
) -> None:
    grid = with_unknown(random_grid(*channels))
    (path,) = write_grid(tmp_path, grid, [name])
    assert FORMATS[name].read is not None
    read = FORMATS[name].read(path)
    assert (read.header, read.voxel, read.origin.tolist()) == (grid.header, grid.voxel, grid.origin.tolist())
    assert list(read.channels) == list(grid.channels)
    for channel, values in grid.channels.items():
        np.testing.assert_array_equal(read.channels[channel], values)
        assert read.channels[channel].dtype == values.dtype


def test_a_curobo_file_whose_list_of_contents_is_damaged_is_refused(tmp_path: Path) -> None:
    (path,) = write_grid(tmp_path, ball_grid(), ["curobo"])
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02") + 42] ^= 0xFF  # the place of a member
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"field.curobo.npz: not a readable .npz: .*; the file is damaged"):
        describe(path)


@pytest.mark.parametrize(
    ("names", "channels", "unknown", "message"),
    [
        (["npz", "pdf"], ["sdf"], "free", "formats: expected some of npz, vti, nrrd, .*, got pdf"),
        ([], ["sdf"], "free", "got none"),
        (["moveit"], ["sdf", "se"], "free", "format moveit: expected one of the channels bound, hard, got sdf, se"),
        (["curobo"], ["sdf"], "nan", "format curobo: cannot hold cells without a distance; bake with"),
    ],
)
def test_what_cannot_be_written_is_told_before_the_bake(
    names: list[str], channels: list[str], unknown: str, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        check_formats(names, channels, unknown=unknown)
    check_formats([name for name in FORMATS if name != "vdb"], ["sdf", "bound"])


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
