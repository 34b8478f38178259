"""Grids for viewers, as their own readers find them: pynrrd, OpenVDB, VTK."""

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.grid import grid_format
from splatctrl_cli.formats.grid.npz_grid import write_npz
from splatctrl_cli.formats.grid.nrrd import PREFIX, write_nrrd
from splatctrl_cli.formats.grid.vdb import openvdb, read_vdb_head, write_vdb
from splatctrl_cli.formats.grid.vti import read_vti, write_vti
from splatctrl_cli.recording.source import describe
from tests.formats.grid.make_grid import SHAPE, random_grid, with_unknown


@pytest.mark.parametrize("channel", ["sdf", "gradient", "observed", "bound"])
def test_pynrrd_reads_every_value_at_its_place(tmp_path: Path, channel: str) -> None:
    nrrd = pytest.importorskip("nrrd", reason="pynrrd is not installed: not tried on its reader")
    grid = with_unknown(random_grid())
    write_nrrd(tmp_path / "field.nrrd", grid, channel)
    values, header = nrrd.read(str(tmp_path / "field.nrrd"))
    is_vector = channel == "gradient"
    np.testing.assert_array_equal(np.moveaxis(values, 0, -1) if is_vector else values, grid.channels[channel])
    assert values.dtype == grid.channels[channel].dtype
    assert (header["space"], header["content"]) == ("3D-right-handed", channel)
    directions = header["space directions"][1:] if is_vector else header["space directions"]
    np.testing.assert_array_equal(directions, 0.02 * np.eye(3))
    np.testing.assert_array_equal(header["space origin"], grid.origin)
    assert header["kinds"] == ["vector"] * is_vector + ["domain"] * 3
    assert header["space units"] == ["m", "m", "m"]
    assert header.get("sample units") == (None if channel in {"gradient", "observed"} else "m")
    ours = {key.removeprefix(PREFIX): json.loads(text) for key, text in header.items() if key.startswith(PREFIX)}
    assert ours == grid.header


ROOT = Path(__file__).parents[3]
ROUND_TRIP = """
import ast, sys
from pathlib import Path
import numpy as np
from splatctrl_cli.formats.grid.vdb import openvdb, write_vdb
from splatctrl_cli.records import DistanceGrid
folder, vdb = Path(sys.argv[1]), openvdb()
arrays = dict(np.load(folder / "arrays.npz"))
header = ast.literal_eval(sys.argv[2])
grid = DistanceGrid(origin=np.array([-0.1, 0.2, 0.3]), voxel=0.02, channels=arrays, header=header)
for name in ("a.vdb", "b.vdb"):
    write_vdb(folder / name, grid)
read, found = {}, []
for made in vdb.readAll(str(folder / "a.vdb"))[0]:
    values = np.full(arrays[made.name].shape, 99.0, np.float32)
    made.copyToArray(values)
    read[made.name] = values
    outside = made.getConstAccessor().probeValue((-1, 0, 0))
    found.append((made.name, made.gridClass, made.activeVoxelCount(), outside, made.background,
                  made.transform.indexToWorld((4, 1, 10)), dict(made.metadata)))
np.savez(folder / "read.npz", **read)
print(repr(found))
"""


def python_with_openvdb() -> str:
    """An interpreter that has OpenVDB's module and a NumPy that it was built for."""
    for python in (sys.executable, "/usr/bin/python3"):
        program = "import numpy, sys\ntry: import openvdb\nexcept ImportError: import pyopenvdb\n"
        if not shutil.which(python):
            continue
        if subprocess.run([python, "-c", program], capture_output=True, check=False).returncode == 0:
            return python
    pytest.skip("no Python with OpenVDB's module here: .vdb files are not tried on OpenVDB itself")


def test_openvdb_reads_every_value_at_its_place(tmp_path: Path) -> None:
    python = python_with_openvdb()
    grid = with_unknown(random_grid(shape=(20, 9, 13)))
    np.savez(tmp_path / "arrays.npz", **grid.channels)  # type: ignore[arg-type]
    result = subprocess.run(
        [python, "-c", ROUND_TRIP, str(tmp_path), repr(grid.header)],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
    )
    assert result.returncode == 0, result.stderr
    found = {name: rest for name, *rest in ast.literal_eval(result.stdout)}
    assert found.keys() == grid.channels.keys()
    with np.load(tmp_path / "read.npz") as read:
        for name, values in grid.channels.items():
            kind, num_active, outside, background, place, metadata = found[name]
            blank = np.isnan(values)
            is_vector = values.ndim == 4
            np.testing.assert_array_equal(read[name][~blank], values[~blank].astype(np.float32))
            np.testing.assert_array_equal(read[name][blank], 0.0 if is_vector else np.float32(background))
            assert num_active == values[..., 0].size - blank[..., 0].sum() if is_vector else values.size - blank.sum()
            assert outside == (background, False)
            assert is_vector or np.float32(background) == np.nextafter(np.nanmax(values).astype("f4"), np.float32(9))
            np.testing.assert_allclose(place, (-0.02, 0.22, 0.5), atol=1e-12)
            assert kind == ("level set" if name in {"sdf", "hard", "se", "gpdf"} else "unknown")
            assert metadata["sign"] == "positive outside"
            assert metadata["labels"] == '["human", "object"]'
            assert metadata["length_scale"] == 0.02
    heads = {name: (kind, metadata) for name, kind, metadata in read_vdb_head(tmp_path / "a.vdb")}
    assert heads.keys() == grid.channels.keys()
    assert heads["gradient"][0] == "Tree_vec3s_5_4_3"
    assert {key: heads["sdf"][1][key] for key in ("frame", "version", "note")} == {
        key: grid.header[key] for key in ("frame", "version", "note")
    }
    assert (tmp_path / "a.vdb").read_bytes() == (tmp_path / "b.vdb").read_bytes()
    summary = describe(tmp_path / "a.vdb")
    assert (summary.kind, summary.facts["grids"]) == ("OpenVDB", len(grid.channels))
    assert (summary.facts["labels"], summary.facts["distance"]) == (["human", "object"], "safe")
    assert ["sdf", "Tree_float_5_4_3", "level set", 20 * 9 * 13 - 12] in list(summary.grids[0].rows)
    content = (tmp_path / "a.vdb").read_bytes()
    for length in (9, 30, 70, 200):
        (tmp_path / "cut.vdb").write_bytes(content[:length])
        with pytest.raises(InputError, match="not a readable OpenVDB file"):
            read_vdb_head(tmp_path / "cut.vdb")


def test_without_openvdb_the_remedy_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvdb", None)
    monkeypatch.setitem(sys.modules, "pyopenvdb", None)
    with pytest.raises(UsageError, match=r"cannot be imported.*; install OpenVDB's Python module: conda-forge"):
        openvdb()
    with pytest.raises(UsageError):
        write_vdb(tmp_path / "field.vdb", random_grid())
    write_npz(tmp_path / "field.npz", random_grid())
    with pytest.raises(InputError, match="expected an OpenVDB file"):
        read_vdb_head(tmp_path / "field.npz")


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
