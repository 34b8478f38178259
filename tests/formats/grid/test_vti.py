from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.grid import grid_format
from splatctrl_cli.formats.grid.vti import read_vti, write_vti
from tests.formats.grid.make_grid import SHAPE, random_grid, with_unknown


@pytest.mark.parametrize("channels", [(), ("sdf",), ("sdf", "bound", "observed")])
def test_vtk_reads_every_value_at_its_place(tmp_path: Path, channels: tuple[str, ...]) -> None:
    xml = pytest.importorskip("vtkmodules.vtkIOXML", reason="vtk is not installed: not tried on VTK's own reader")
    to_numpy = pytest.importorskip("vtkmodules.util.numpy_support").vtk_to_numpy
    grid = with_unknown(random_grid(*channels))
    write_vti(tmp_path / "field.vti", grid)
    reader = xml.vtkXMLImageDataReader()
    reader.SetFileName(str(tmp_path / "field.vti"))
    reader.Update()
    image = reader.GetOutput()
    assert image.GetDimensions() == SHAPE
    assert image.GetOrigin() == tuple(grid.origin)
    assert image.GetSpacing() == (0.02, 0.02, 0.02)
    point = image.FindPoint((-0.1 + 0.02 * 4, 0.2 + 0.02 * 1, 0.3 + 0.02 * 10))
    data = image.GetPointData()
    assert [data.GetArrayName(i) for i in range(data.GetNumberOfArrays())] == list(grid.channels)
    for name, values in grid.channels.items():
        array = to_numpy(data.GetArray(name))
        assert array.dtype == values.dtype
        cube = array.reshape(*SHAPE[::-1], *values.shape[3:])
        np.testing.assert_array_equal(cube.swapaxes(0, 2), values)
        np.testing.assert_array_equal(array[point], values[4, 1, 10])
    assert data.GetScalars().GetName() == "sdf"
    assert (data.GetVectors() is not None) == ("gradient" in grid.channels)
    assert grid_format.parse_header("x", image.GetFieldData().GetAbstractArray("header").GetValue(0)) == grid.header


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[:-300], "sdf: expected 880 bytes, got"),
        (lambda text: text.replace(b'"Float32"', b'"Float64"'), "not a distance grid of ours: KeyError"),
        (lambda text: text.replace(b"LittleEndian", b"BigEndian"), "expected a VTKFile"),
        (lambda text: text.replace(b'encoding="raw"', b'encoding="base64"'), "expected raw appended data"),
        (lambda text: text.replace(b"0.02 0.02 0.02", b"0.02 0.02 0.03"), "expected cubic cells"),
        (lambda text: text.replace(b'Extent="0 4', b'Extent="1 5'), "expected one piece"),
        (
            lambda text: text.replace(b'Extent="0 4', b'Extent="0 400000000'),
            "sdf: expected 70400000176 bytes, got 880",
        ),
        (
            lambda text: text.replace(b'Extent="0 4', b'Extent="0 -4'),
            r"expected \(X, Y, Z\) cells, got \(-3, 4, 11\)",
        ),
        (lambda text: text.replace(b'Origin="-0.1', b'Origin="nan'), "expected a place and a size above 0"),
        (lambda text: text.replace(b"<Piece", b"<Peace"), "not readable XML"),
        (lambda text: text.replace(b'Name="sdf"', b'Name="foo"'), "expected the channel sdf"),
        (lambda text: text.replace(b"123 10 32 34", b"124 10 32 34"), "header: not JSON"),
    ],
)
def test_a_vti_that_is_not_ours_or_not_whole_is_named(tmp_path: Path, change, message: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "field.vti"
    write_vti(path, random_grid("sdf"))
    before = path.read_bytes()
    path.write_bytes(change(before))
    assert path.read_bytes() != before
    with pytest.raises(InputError, match=message) as refused:
        read_vti(path)
    assert refused.value.remedy
    with pytest.raises(InputError, match="no such file"):
        read_vti(tmp_path / "none.vti")
