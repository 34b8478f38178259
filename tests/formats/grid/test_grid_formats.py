"""The contract of grid files: write, describe, read back, refuse cut and foreign files, bake in slabs."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.grid import grid_format
from splatctrl_cli.formats.grid.grid_format import GridFormat, GridSlabs, SlabPlan, resume_slabs, start_slabs
from splatctrl_cli.formats.grid.grid_formats import FORMATS, check_formats, write_grid
from splatctrl_cli.formats.grid.npz_grid import read_npz, write_npz
from splatctrl_cli.formats.grid.vti import read_vti
from splatctrl_cli.recording.source import describe
from splatctrl_cli.records import DistanceGrid
from tests.formats.grid.make_grid import HEADER, SHAPE, ball_grid, random_grid, with_unknown
from tests.refused import expect_refusal

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


def test_memory_maps_are_written_as_arrays_are_in_whatever_pieces_and_as_large_as_the_format_says(
    tmp_path: Path, kind: GridFormat, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = ball_grid()
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    files = write_grid(tmp_path / "a", grid, [kind.name])
    monkeypatch.setattr(grid_format, "CHUNK", 1)
    write_grid(tmp_path / "b", mapped(tmp_path / "slabs", grid), [kind.name])
    num_files = len(grid.channels) if kind.is_per_channel else 1
    assert (sorted(files), len(files)) == (sorted((tmp_path / "a").iterdir()), num_files)
    assert all(file.read_bytes() == (tmp_path / "b" / file.name).read_bytes() for file in files)
    size = grid.channels["sdf"].size * (
        4 * len(grid.channels) if kind.bytes_per_cell is None else kind.bytes_per_cell
    )
    total = sum(file.stat().st_size for file in files)
    assert size == 0 or total <= size + 2**14
    assert kind.name == "vdb" or total >= 0.5 * size, "only OpenVDB's are packed"


def test_every_file_is_described_and_refused_in_one_line_where_it_is_cut(tmp_path: Path, kind: GridFormat) -> None:
    grid = ball_grid()
    name, facts = DESCRIBED[kind.name]
    for file in write_grid(tmp_path, grid, [kind.name]):
        summary = describe(file)
        assert (summary.kind, {key: summary.facts.get(key) for key in facts}) == (name, facts)
        assert summary.facts.get("first_cell", grid.origin.tolist()) == pytest.approx(grid.origin, abs=1e-6)
        if kind.read is not None:
            assert summary.grids[0].rows == [[channel, "f4", "m"] for channel in grid.channels]
        content = file.read_bytes()
        for length, read in ((60, describe), (100, describe), (100, kind.read), (len(content) // 2, kind.read)):
            file.write_bytes(content[:length])
            if read is not None:
                expect_refusal("", read, file, has_remedy=True)


def assert_same_grid(read: DistanceGrid, grid: DistanceGrid) -> None:
    assert (read.header, read.voxel, read.origin.tolist()) == (grid.header, grid.voxel, grid.origin.tolist())
    assert list(read.channels) == list(grid.channels)
    for channel, values in grid.channels.items():
        np.testing.assert_array_equal(read.channels[channel], values, strict=True)


@pytest.mark.parametrize("channels", [(), ("sdf",), ("label", "sdf", "gradient")])
@pytest.mark.parametrize("name", [name for name, kind in FORMATS.items() if kind.read is not None])
def test_a_grid_is_read_back_from_the_files_that_hold_it_whole(
    tmp_path: Path, name: str, channels: tuple[str, ...]
) -> None:
    grid = with_unknown(random_grid(*channels))
    (path,) = write_grid(tmp_path, grid, [name])
    assert_same_grid(FORMATS[name].read(path), grid)


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
    expect_refusal(message, check_formats, names, channels, unknown=unknown, error=UsageError)
    check_formats([name for name in FORMATS if name != "vdb"], ["sdf", "bound"])


def test_a_curobo_file_whose_list_of_contents_is_damaged_is_refused(tmp_path: Path) -> None:
    (path,) = write_grid(tmp_path, ball_grid(), ["curobo"])
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02") + 42] ^= 0xFF  # the place of a member
    path.write_bytes(content)
    expect_refusal(r"field.curobo.npz: not a readable .npz: .*; the file is damaged", describe, path)


def test_the_head_of_an_npz_is_read_without_the_values_and_numpy_itself_reads_it(tmp_path: Path) -> None:
    path, grid = tmp_path / "field.npz", random_grid(shape=(9, 20, 40))
    write_npz(path, replace(grid, header={**grid.header, "version": 1}))
    with np.load(path, allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["sdf"], grid.channels["sdf"])
        assert json.loads(str(loaded["header"])) == grid.header, "of the version that wrote it"
    content = bytearray(path.read_bytes())
    content[content.index(grid.channels["hard"].tobytes()) + 28000] ^= 1
    path.write_bytes(content)
    head = read_npz(path, with_values=False)
    shapes = {name: values.shape for name, values in head.channels.items()}
    assert (shapes, head.header) == ({name: values.shape for name, values in grid.channels.items()}, grid.header)
    assert (head.voxel, head.origin.tolist()) == (grid.voxel, grid.origin.tolist())
    expect_refusal("CRC", read_npz, path)


@pytest.mark.parametrize(
    ("policy", "name", "value"),
    [("free", "sdf", np.nan), ("nan", "sdf", np.inf), ("nan", "gradient", -np.inf), ("nan", "bound", np.nan)],
)
def test_what_no_policy_leaves_is_refused(tmp_path: Path, policy: str, name: str, value: float) -> None:
    blank = with_unknown(random_grid())
    blank.header["unknown"] = policy
    blank.channels[name].flat[7] = value
    write_npz(tmp_path / "field.npz", blank)
    expect_refusal(f"{name}: expected finite values, got {value}; bake it again", read_npz, tmp_path / "field.npz")


def test_no_changed_byte_ends_in_another_error_or_another_grid(tmp_path: Path) -> None:
    grid, path, num_refused = random_grid("sdf", "observed", shape=(2, 2, 2)), tmp_path / "field.npz", 0
    write_npz(path, grid)
    content = path.read_bytes()
    for at in range(0, len(content), 3):
        path.write_bytes(content[:at] + bytes([content[at] ^ 0x15]) + content[at + 1 :])
        try:
            assert_same_grid(read_npz(path), grid)  # a date, an attribute: nothing that is read
        except InputError:
            num_refused += 1
    assert num_refused > 0.7 * len(content) / 3


def rewrite(path: Path, **changes: object) -> None:
    """An .npz of a grid with other arrays, None for no such array."""
    grid = random_grid()
    place = {"origin": grid.origin, "voxel": np.float64(grid.voxel), "header": json.dumps(grid.header)}
    members = {**place, **grid.channels, **changes}
    np.savez(path, **{name: value for name, value in members.items() if value is not None})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sdf": None}, "expected the arrays origin, voxel, header and sdf, got origin, voxel, header, gradient"),
        ({"extra": np.zeros(1)}, "expected the channel sdf and any of gradient, bound, .*, got sdf"),
        ({"voxel": np.float64(0)}, "voxel: expected a size above 0 m, got 0.0; bake it again"),
        ({"voxel": np.zeros(2)}, "voxel: expected ('<f8', ()), got"),
        ({"origin": np.zeros(3, np.float32)}, "origin: expected ('<f8', (3,)), got"),
        ({"origin": np.array([0.0, np.nan, 0.0])}, "origin: expected 3 finite float64"),
        ({"header": "{"}, "header: not JSON"),
        ({"header": json.dumps({**HEADER, "version": 1})}, "header: expected version 2, got 1; bake it again"),
        ({"header": "[]"}, "header: expected version 2, got None"),
        ({"header": np.zeros(3)}, "header: expected one string"),
        ({"hard": np.zeros((5, 4, 6), np.float32)}, "hard: expected <f4 (5, 4, 11), got <f4 (5, 4, 6)"),
        ({"gradient": np.zeros(SHAPE, np.float32)}, "gradient: expected <f4 (5, 4, 11, 3)"),
        ({"sdf": np.zeros(SHAPE)}, "sdf: expected <f4"),
        ({"sdf": np.array([print], dtype=object)}, "field.npz: not a whole distance grid: objects, expected numbers"),
        ({"sdf": np.zeros((3, 4), np.float32)}, "sdf: expected (X, Y, Z) cells, got (3, 4)"),
        ({"sdf": np.zeros((3, 0, 4), np.float32)}, "sdf: expected"),
    ],
)
def test_an_npz_that_is_not_ours_is_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    rewrite(tmp_path / "field.npz", **changes)
    for with_values in (True, False):
        expect_refusal(message, read_npz, tmp_path / "field.npz", has_remedy=True, with_values=with_values)


def test_a_file_that_claims_more_than_it_holds_is_not_made_room_for(tmp_path: Path) -> None:
    path = tmp_path / "field.npz"
    rewrite(path, sdf=None)
    with zipfile.ZipFile(path, "a") as archive:
        claim = b"{'descr': '<f4', 'fortran_order': False, 'shape': (90000, 90000, 90000), }\n"
        archive.writestr("sdf.npy", b"\x93NUMPY\x01\x00" + len(claim).to_bytes(2, "little") + claim)
    expect_refusal(r"sdf.npy: expected 2916\d+ bytes, got", read_npz, path)


def test_a_missing_file_a_folder_and_a_zip_of_something_else_are_named(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    expect_refusal("no such file", read_npz, tmp_path / "none.npz")
    expect_refusal("got a folder", read_npz, tmp_path)
    expect_refusal(f"{tmp_path / 'other.npz'}: not a whole distance grid", read_npz, tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"hard": np.zeros(SHAPE, "<f4")}, "grid to write: expected the channel sdf"),
        ({"sdf": np.zeros(SHAPE)}, "grid to write: sdf: expected <f4"),
        ({"sdf": np.zeros(SHAPE, "<f4"), "mine": np.zeros(SHAPE, "<f4")}, "got sdf, mine"),
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path: Path, channels: dict[str, object], message: str) -> None:
    grid = DistanceGrid(origin=np.zeros(3), voxel=0.1, channels=channels, header={})  # type: ignore[arg-type]
    expect_refusal(message, write_npz, tmp_path / "field.npz", grid)
    assert not (tmp_path / "field.npz").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"Float32"', b'"Float64"', "not a distance grid of ours: KeyError"),
        (b"LittleEndian", b"BigEndian", "expected a VTKFile"),
        (b'encoding="raw"', b'encoding="base64"', "expected raw appended data"),
        (b"0.02 0.02 0.02", b"0.02 0.02 0.03", "expected cubic cells"),
        (b'Extent="0 4', b'Extent="1 5', "expected one piece"),
        (b'Extent="0 4', b'Extent="0 400000000', "sdf: expected 70400000176 bytes, got 880"),
        (b'Extent="0 4', b'Extent="0 -4', "expected (X, Y, Z) cells, got (-3, 4, 11)"),
        (b'Origin="-0.1', b'Origin="nan', "expected a place and a size above 0"),
        (b"<Piece", b"<Peace", "not readable XML"),
        (b'Name="sdf"', b'Name="foo"', "expected the channel sdf"),
        (b"123 10 32 34", b"124 10 32 34", "header: not JSON"),
    ],
)
def test_a_vti_that_is_not_ours_or_not_whole_is_named(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    (path,) = write_grid(tmp_path, random_grid("sdf"), ["vti"])
    content = path.read_bytes()
    path.write_bytes(content.replace(old, new))
    expect_refusal(message, read_vti, path, has_remedy=True)
    path.write_bytes(content[:-300])
    expect_refusal("sdf: expected 880 bytes, got", read_vti, path, has_remedy=True)
    expect_refusal("no such file", read_vti, tmp_path / "none.vti")


CHANNELS = ("sdf", "gradient", "observed")
PLAN = SlabPlan(
    origin=(-0.1, 0.2, 0.3), voxel=0.02, shape=SHAPE, channels=CHANNELS, settings={"noise": 1e-6, "digest": "a"}
)


def fill(slabs: GridSlabs, grid: DistanceGrid, *, until: int, step: int = 2) -> None:
    while slabs.num_layers < until:
        stop = min(slabs.num_layers + step, until)
        slabs.write({name: grid.channels[name][slabs.num_layers : stop] for name in CHANNELS})


def test_an_interrupted_bake_goes_on_where_the_last_whole_slab_ended(tmp_path: Path) -> None:
    grid, folder = random_grid(*CHANNELS), tmp_path / "slabs"
    assert resume_slabs(folder, PLAN).num_layers == 0, "without anything left it starts at the beginning"
    fill(resume_slabs(folder, PLAN), grid, until=2)
    with (folder / "sdf.npy").open("r+b") as stream:  # half of a slab that was not counted
        stream.seek(-4 * SHAPE[1] * SHAPE[2] * 3, 2)
        stream.write(b"\x01" * 40)
    slabs = resume_slabs(folder, PLAN)
    assert (slabs.num_layers, slabs.is_whole()) == (2, False)
    expect_refusal("expected 5 layers, got 2; continue the bake", slabs.grid, {})
    other = replace(PLAN, settings={"noise": 1e-3, "digest": "a"}, voxel=0.04)
    said = "voxel was 0.02, is 0.04, noise was 1e-06, is 0.001; bake without --resume"
    expect_refusal(said, resume_slabs, folder, other, error=UsageError)
    fill(slabs, grid, until=SHAPE[0], step=3)
    read = slabs.grid(grid.header)
    assert_same_grid(read, grid)
    assert all(isinstance(each, np.memmap) and not each.flags.writeable for each in read.channels.values())
    assert resume_slabs(folder, PLAN).is_whole()
    assert start_slabs(folder, PLAN).num_layers == resume_slabs(folder, PLAN).num_layers == 0


def test_damaged_remains_are_named(tmp_path: Path) -> None:
    start_slabs(tmp_path, PLAN)
    for spoil in (Path.unlink, lambda path: np.save(path, np.zeros(3))):
        spoil(tmp_path / "sdf.npy")
        expect_refusal("sdf.npy: expected (5, 4, 11), got no such array", resume_slabs, tmp_path, PLAN)
    (tmp_path / "progress.json").write_text(json.dumps({"plan": 3}))
    expect_refusal("progress.json: not readable", resume_slabs, tmp_path, PLAN)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gradient": None}, "expected the channels sdf, gradient, observed, got sdf, observed"),
        ({"sdf": np.zeros((2, 4, 10), "f4")}, "slab: sdf at layer 0 of 5: expected"),
        ({"sdf": np.zeros((2, 4, 11))}, "slab: sdf at layer 0 of 5: expected"),
    ],
)
def test_a_slab_that_does_not_fit_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    grid, slabs = random_grid(*CHANNELS), start_slabs(tmp_path / "slabs", PLAN)
    slab = {name: grid.channels[name][:2] for name in CHANNELS}
    changed = {name: values for name, values in (slab | change).items() if values is not None}
    expect_refusal(message, slabs.write, changed)
    fill(slabs, grid, until=5)
    expect_refusal("slab: sdf at layer 5 of 5", slabs.write, slab)
