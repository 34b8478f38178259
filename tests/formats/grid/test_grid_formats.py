from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.grid import grid_format
from splatctrl_cli.formats.grid.grid_format import GridFormat, SlabPlan, start_slabs
from splatctrl_cli.formats.grid.grid_formats import FORMATS, check_formats, write_grid
from splatctrl_cli.recording.source import describe
from splatctrl_cli.records import DistanceGrid
from tests.formats.grid.make_grid import HEADER, ball_grid, random_grid, with_unknown

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
