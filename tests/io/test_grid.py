import json
import re
import struct
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.grid import read_npz, write_npz, write_vti
from splatctrl_cli.records import DistanceGrid

SHAPE = (3, 4, 5)


@pytest.fixture
def grid() -> DistanceGrid:
    rng = np.random.default_rng(0)
    return DistanceGrid(
        origin=np.array([-0.1, 0.2, 0.3]),
        voxel=0.02,
        channels={
            "sdf": rng.normal(size=SHAPE).astype(np.float32),
            "gpdf": rng.normal(size=SHAPE).astype(np.float32),
            "hard": rng.normal(size=SHAPE).astype(np.float32),
            "gradient": rng.normal(size=(*SHAPE, 3)).astype(np.float32),
            "observed": rng.integers(0, 4, SHAPE).astype(np.uint8),
        },
        header={"version": 1, "frame": "world", "sign": "positive outside", "note": 'a < "b" & ü'},
    )


def test_npz_gives_back_what_was_written(tmp_path: Path, grid: DistanceGrid) -> None:
    write_npz(tmp_path / "field.npz", grid)
    read = read_npz(tmp_path / "field.npz")
    assert (read.header, read.voxel, read.origin.tolist()) == (grid.header, grid.voxel, grid.origin.tolist())
    assert list(read.channels) == list(grid.channels)
    for name, values in grid.channels.items():
        np.testing.assert_array_equal(read.channels[name], values)
        assert read.channels[name].dtype == values.dtype


def test_same_grid_same_bytes(tmp_path: Path, grid: DistanceGrid) -> None:
    for name in ("a", "b"):
        write_npz(tmp_path / f"{name}.npz", grid)
        write_vti(tmp_path / f"{name}.vti", grid)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert (tmp_path / "a.vti").read_bytes() == (tmp_path / "b.vti").read_bytes()


def test_numpy_itself_reads_the_npz(tmp_path: Path, grid: DistanceGrid) -> None:
    write_npz(tmp_path / "field.npz", grid)
    with np.load(tmp_path / "field.npz", allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["sdf"], grid.channels["sdf"])
        assert json.loads(str(loaded["header"]))["frame"] == "world"


def read_vti(path: Path) -> tuple[dict[str, NDArray[np.generic]], dict[str, str], str]:
    """Point arrays as (X, Y, Z[, components]), the ImageData's attributes and the header, by VTK's rules alone."""
    content = path.read_bytes()
    begin = content.index(b"_", content.index(b'<AppendedData encoding="raw">')) + 1
    end = content.rindex(b"\n  </AppendedData>")
    root = ElementTree.fromstring(content[:begin] + content[end:])
    assert root.attrib == {
        "type": "ImageData",
        "version": "1.0",
        "byte_order": "LittleEndian",
        "header_type": "UInt64",
    }
    image = root.find("ImageData")
    assert image is not None
    piece = image.find("Piece")
    assert piece is not None
    assert piece.attrib["Extent"] == image.attrib["WholeExtent"]
    low_x, x, low_y, y, low_z, z = map(int, piece.attrib["Extent"].split())
    assert (low_x, low_y, low_z) == (0, 0, 0)
    arrays, used = {}, 0
    for array in piece.iterfind("PointData/DataArray"):
        start = begin + int(array.attrib["offset"])
        (size,) = struct.unpack_from("<Q", content, start)
        dtype = {"Float32": "<f4", "UInt8": "u1"}[array.attrib["type"]]
        flat = np.frombuffer(content[start + 8 : start + 8 + size], dtype)
        values = flat.reshape(z + 1, y + 1, x + 1, int(array.attrib["NumberOfComponents"]))
        arrays[array.attrib["Name"]] = (
            values.transpose(2, 1, 0, 3).squeeze(-1) if values.shape[-1] == 1 else (values.transpose(2, 1, 0, 3))
        )
        used += 8 + size
    assert begin + used == end
    text = image.findtext("FieldData/Array")
    assert text is not None
    codes = [int(code) for code in text.split()]
    assert codes[-1] == 0
    return arrays, image.attrib, bytes(codes[:-1]).decode()


def test_vti_holds_the_same_arrays(tmp_path: Path, grid: DistanceGrid) -> None:
    write_vti(tmp_path / "field.vti", grid)
    arrays, image, header = read_vti(tmp_path / "field.vti")
    assert list(arrays) == list(grid.channels)
    for name, values in grid.channels.items():
        np.testing.assert_array_equal(arrays[name], values)
    assert [float(v) for v in image["Origin"].split()] == grid.origin.tolist()
    assert [float(v) for v in image["Spacing"].split()] == [0.02, 0.02, 0.02]
    assert json.loads(header) == grid.header


def test_a_pickled_npz_is_refused(tmp_path: Path, grid: DistanceGrid) -> None:
    channels = {**grid.channels, "sdf": np.array([print], dtype=object)}
    with (tmp_path / "field.npz").open("wb") as stream:
        np.savez(stream, origin=grid.origin, voxel=grid.voxel, header="{}", **channels)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"field.npz: not a whole distance grid: .*allow_pickle"):
        read_npz(tmp_path / "field.npz")


def test_every_damaged_byte_of_an_array_is_noticed(tmp_path: Path, grid: DistanceGrid) -> None:
    path = tmp_path / "field.npz"
    write_npz(path, grid)
    content = path.read_bytes()
    at = content.index(grid.channels["sdf"].tobytes())
    path.write_bytes(content[: at + 10] + bytes([content[at + 10] ^ 1]) + content[at + 11 :])
    with pytest.raises(InputError, match="CRC"):
        read_npz(path)
    path.write_bytes(content[:-40])
    with pytest.raises(InputError, match="not a whole distance grid"):
        read_npz(path)


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
        ({"hard": None}, "expected the arrays gpdf, gradient, hard"),
        ({"extra": np.zeros(1)}, "got extra, gpdf"),
        ({"voxel": np.float64(0)}, "voxel: expected one float64 above 0 m"),
        ({"voxel": np.zeros(2)}, "voxel: expected one float64"),
        ({"origin": np.array([0.0, np.nan, 0.0])}, "origin: expected 3 finite float64"),
        ({"header": "{"}, "header: not JSON"),
        ({"header": '{"version": 9}'}, "header: expected version 1, got 9"),
        ({"header": np.zeros(3)}, "header: expected one string"),
        ({"hard": np.zeros((3, 4, 6), np.float32)}, r"hard: expected <f4 \(3, 4, 5\), got <f4 \(3, 4, 6\)"),
        ({"sdf": np.zeros(SHAPE)}, "sdf: expected <f4"),
        ({"gpdf": np.full(SHAPE, np.inf, np.float32)}, "gpdf: expected finite values"),
    ],
)
def test_an_npz_that_is_not_ours_is_named(
    tmp_path: Path, grid: DistanceGrid, changes: dict[str, object], message: str
) -> None:
    rewrite(tmp_path / "field.npz", grid, **changes)
    with pytest.raises(InputError, match=message):
        read_npz(tmp_path / "field.npz")


def test_a_missing_file_a_folder_and_a_zip_of_something_else_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_npz(tmp_path / "none.npz")
    with pytest.raises(InputError, match="got a folder"):
        read_npz(tmp_path)
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(InputError, match=re.escape(f"{tmp_path / 'other.npz'}: not a whole distance grid")):
        read_npz(tmp_path / "other.npz")
