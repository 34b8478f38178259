import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.grid.npz_grid import read_npz, read_npz_head, write_npz
from splatctrl_cli.records import DistanceGrid
from tests.formats.grid.make_grid import HEADER, SHAPE, random_grid, with_unknown


@pytest.fixture
def grid() -> DistanceGrid:
    return random_grid()


def test_a_file_is_of_the_version_that_wrote_it(tmp_path: Path, grid: DistanceGrid) -> None:
    old = DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=grid.channels, header={"version": 1})
    write_npz(tmp_path / "field.npz", old)
    assert read_npz(tmp_path / "field.npz").header == {"format": "splatctrl distance grid", "version": 2}


def test_the_head_is_read_without_the_values(tmp_path: Path) -> None:
    path, shape = tmp_path / "field.npz", (9, 20, 40)
    grid = random_grid(shape=shape)
    write_npz(path, grid)
    content = bytearray(path.read_bytes())
    content[content.index(grid.channels["hard"].tobytes()) + 28000] ^= 1
    path.write_bytes(content)
    head = read_npz_head(path)
    assert (head.shape, head.channels, head.header) == (shape, tuple(grid.channels), grid.header)
    assert (head.voxel, head.origin.tolist()) == (grid.voxel, grid.origin.tolist())
    with pytest.raises(InputError, match="CRC"):
        read_npz(path)


def test_numpy_itself_reads_the_npz(tmp_path: Path, grid: DistanceGrid) -> None:
    write_npz(tmp_path / "field.npz", grid)
    with np.load(tmp_path / "field.npz", allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["sdf"], grid.channels["sdf"])
        assert json.loads(str(loaded["header"]))["frame"] == "world"


def test_cells_without_a_value_are_let_through_only_by_their_policy(tmp_path: Path, grid: DistanceGrid) -> None:
    blank = with_unknown(grid)
    write_npz(tmp_path / "field.npz", blank)
    np.testing.assert_array_equal(read_npz(tmp_path / "field.npz").channels["sdf"], blank.channels["sdf"])
    blank.header["unknown"] = "free"
    write_npz(tmp_path / "field.npz", blank)
    with pytest.raises(InputError, match="sdf: expected finite values, got nan; bake it again"):
        read_npz(tmp_path / "field.npz")


@pytest.mark.parametrize(("name", "value"), [("sdf", np.inf), ("gradient", -np.inf), ("bound", np.nan)])
def test_what_no_policy_leaves_is_refused(tmp_path: Path, grid: DistanceGrid, name: str, value: float) -> None:
    blank = with_unknown(grid)
    blank.channels[name].flat[7] = value
    write_npz(tmp_path / "field.npz", blank)
    with pytest.raises(InputError, match=f"{name}: expected finite values, got {value}"):
        read_npz(tmp_path / "field.npz")


def test_a_pickled_npz_is_refused(tmp_path: Path, grid: DistanceGrid) -> None:
    rewrite(tmp_path / "field.npz", grid, sdf=np.array([print], dtype=object))
    with pytest.raises(InputError, match=r"field.npz: not a whole distance grid: objects, expected numbers"):
        read_npz(tmp_path / "field.npz")


def test_no_changed_byte_ends_in_another_error_or_another_grid(tmp_path: Path) -> None:
    grid = random_grid("sdf", "observed", shape=(2, 2, 2))
    path = tmp_path / "field.npz"
    write_npz(path, grid)
    content = path.read_bytes()
    refused = 0
    for at in range(0, len(content), 3):
        path.write_bytes(content[:at] + bytes([content[at] ^ 0x15]) + content[at + 1 :])
        try:
            read = read_npz(path)
        except InputError:
            refused += 1
        else:  # a date, an attribute: nothing that is read
            np.testing.assert_array_equal(read.channels["sdf"], grid.channels["sdf"])
            assert read.header == grid.header
    assert refused > 0.7 * len(content) / 3


def rewrite(path: Path, grid: DistanceGrid, **changes: object) -> None:
    members = {
        "origin": grid.origin,
        "voxel": np.float64(grid.voxel),
        "header": json.dumps(grid.header),
        **grid.channels,
        **changes,
    }
    with path.open("wb") as stream:
        np.savez(stream, **{name: value for name, value in members.items() if value is not None})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sdf": None}, "expected the arrays origin, voxel, header and sdf, got origin, voxel, header, gradient"),
        ({"extra": np.zeros(1)}, "expected the channel sdf and any of gradient, bound, .*, got sdf"),
        ({"voxel": np.float64(0)}, "voxel: expected a size above 0 m, got 0.0; bake it again"),
        ({"voxel": np.zeros(2)}, r"voxel: expected \('<f8', \(\)\), got"),
        ({"origin": np.zeros(3, np.float32)}, r"origin: expected \('<f8', \(3,\)\), got"),
        ({"origin": np.array([0.0, np.nan, 0.0])}, "origin: expected 3 finite float64"),
        ({"header": "{"}, "header: not JSON"),
        ({"header": json.dumps({**HEADER, "version": 1})}, "header: expected version 2, got 1; bake it again"),
        ({"header": "[]"}, "header: expected version 2, got None"),
        ({"header": np.zeros(3)}, "header: expected one string"),
        ({"hard": np.zeros((5, 4, 6), np.float32)}, r"hard: expected <f4 \(5, 4, 11\), got <f4 \(5, 4, 6\)"),
        ({"gradient": np.zeros(SHAPE, np.float32)}, r"gradient: expected <f4 \(5, 4, 11, 3\)"),
        ({"sdf": np.zeros(SHAPE)}, "sdf: expected <f4"),
        ({"sdf": np.zeros((3, 4), np.float32)}, r"sdf: expected \(X, Y, Z\) cells, got \(3, 4\)"),
        ({"sdf": np.zeros((3, 0, 4), np.float32)}, "sdf: expected"),
    ],
)
def test_an_npz_that_is_not_ours_is_named(
    tmp_path: Path, grid: DistanceGrid, changes: dict[str, object], message: str
) -> None:
    rewrite(tmp_path / "field.npz", grid, **changes)
    for read in (read_npz, read_npz_head):
        with pytest.raises(InputError, match=message) as refused:
            read(tmp_path / "field.npz")
        assert refused.value.remedy


def test_a_file_that_claims_more_than_it_holds_is_not_made_room_for(tmp_path: Path, grid: DistanceGrid) -> None:
    path = tmp_path / "field.npz"
    rewrite(path, grid, sdf=None)
    with zipfile.ZipFile(path, "a") as archive:
        claim = b"{'descr': '<f4', 'fortran_order': False, 'shape': (90000, 90000, 90000), }\n"
        archive.writestr("sdf.npy", b"\x93NUMPY\x01\x00" + len(claim).to_bytes(2, "little") + claim)
    with pytest.raises(InputError, match=r"sdf.npy: expected 2916\d+ bytes, got"):
        read_npz(path)


def test_a_missing_file_a_folder_and_a_zip_of_something_else_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_npz(tmp_path / "none.npz")
    with pytest.raises(InputError, match="got a folder"):
        read_npz(tmp_path)
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(InputError, match=re.escape(f"{tmp_path / 'other.npz'}: not a whole distance grid")):
        read_npz(tmp_path / "other.npz")


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
    with pytest.raises(InputError, match=message):
        write_npz(tmp_path / "field.npz", grid)
    assert not (tmp_path / "field.npz").exists()
