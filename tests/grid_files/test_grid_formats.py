from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.grid_files.grid_formats import FORMATS, check_formats, read_grid, write_grid
from splatctrl_cli.grid_files.grid_slabs import SlabPlan, start_slabs
from splatctrl_cli.records import DistanceGrid
from splatctrl_cli.sources.describe import describe
from tests.grid_files.make_grid import ball_grid, random_grid

WITHOUT_LIBRARY = [name for name in FORMATS if name != "vdb"]


def mapped(folder: Path, grid: DistanceGrid) -> DistanceGrid:
    """The same grid with its channels on disk."""
    shape = grid.channels["sdf"].shape
    plan = SlabPlan(origin=tuple(grid.origin.tolist()), voxel=grid.voxel, shape=shape, channels=tuple(grid.channels))
    slabs = start_slabs(folder, plan)
    slabs.write(grid.channels)
    return slabs.grid(grid.header)


@pytest.mark.parametrize("name", WITHOUT_LIBRARY)
def test_memory_maps_are_written_as_arrays_are(tmp_path: Path, name: str) -> None:
    grid = ball_grid()
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    files = write_grid(tmp_path / "a", grid, [name])
    write_grid(tmp_path / "b", mapped(tmp_path / "slabs", grid), [name])
    assert sorted(files) == sorted((tmp_path / "a").iterdir())
    for file in files:
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


@pytest.mark.parametrize(
    ("name", "files", "kind"),
    [
        ("npz", ["field.npz"], "distance grid"),
        ("vti", ["field.vti"], "ParaView image data"),
        ("nrrd", ["field.bound.nrrd", "field.hard.nrrd", "field.sdf.nrrd"], "NRRD"),
        ("curobo", ["field.curobo.npz"], "cuRobo voxel grid"),
        ("moveit", ["field.moveit"], "MoveIt distance field"),
        ("ply", ["field.ply"], "PLY"),
        ("obj", ["field.obj"], "mesh"),
        ("stl", ["field.stl"], "mesh"),
    ],
)
def test_every_file_is_described(tmp_path: Path, name: str, files: list[str], kind: str) -> None:
    grid = ball_grid()
    write_grid(tmp_path, grid, [name])
    assert sorted(path.name for path in tmp_path.iterdir()) == files
    for file in files:
        summary = describe(tmp_path / file)
        assert summary.kind == kind
        facts = summary.facts
        if name in {"npz", "vti", "moveit"}:
            assert (facts["shape"], facts["voxel"]) == ([21, 22, 23], 0.04)
            assert facts["first_cell"] == np.round(grid.origin, 6).tolist()
        if name in {"npz", "vti", "nrrd", "curobo"}:
            assert (facts["distance"], facts["splats_used"]) == ("safe", {"object": 3})
        if name in {"npz", "vti"}:
            assert summary.grids[0].rows == [[channel, "f4", "m"] for channel in ("sdf", "hard", "bound")]
        if name in {"obj", "stl"}:
            assert isinstance(facts["faces"], int)
            assert facts["faces"] > 1000


def test_an_older_file_is_described_as_one_to_bake_again(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "field.npz", origin=np.zeros(3), voxel=0.1, header='{"version": 1}', sdf=np.zeros((2, 2, 2), "f4")
    )
    with pytest.raises(InputError, match="header: expected version 2, got 1; bake it again"):
        describe(tmp_path / "field.npz")


@pytest.mark.parametrize(
    "file", ["field.npz", "field.vti", "field.sdf.nrrd", "field.curobo.npz", "field.moveit", "field.stl"]
)
def test_a_cut_file_is_refused_in_one_line(tmp_path: Path, file: str) -> None:
    write_grid(tmp_path, ball_grid(), ["npz", "vti", "nrrd", "curobo", "moveit", "stl"])
    content = (tmp_path / file).read_bytes()
    for length in (60, 100):
        (tmp_path / file).write_bytes(content[:length])
        with pytest.raises(InputError) as refused:
            describe(tmp_path / file)
        assert refused.value.remedy


def test_a_curobo_file_whose_list_of_contents_is_damaged_is_refused(tmp_path: Path) -> None:
    (path,) = write_grid(tmp_path, ball_grid(), ["curobo"])
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02") + 42] ^= 0xFF  # the place of a member
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"field.curobo.npz: not a readable .npz: .*; the file is damaged"):
        describe(path)


def test_a_grid_is_read_back_from_the_files_that_hold_it_whole(tmp_path: Path) -> None:
    grid = random_grid()
    write_grid(tmp_path, grid, ["npz", "vti", "nrrd"])
    for name in ("field.npz", "field.vti"):
        read = read_grid(tmp_path / name)
        assert read.header == grid.header
        for channel, values in grid.channels.items():
            np.testing.assert_array_equal(read.channels[channel], values)
    with pytest.raises(InputError, match=r"expected a distance grid to read, .npz or .vti, got .nrrd"):
        read_grid(tmp_path / "field.sdf.nrrd")


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
    check_formats(WITHOUT_LIBRARY, ["sdf", "bound"])
