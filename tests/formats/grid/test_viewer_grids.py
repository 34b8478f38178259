"""Grids and their surfaces as other programs find them: pynrrd, OpenVDB, VTK, trimesh, cuRobo and MoveIt.

The index arithmetic of cuRobo is as its source has it (NVlabs/curobo 0.7.5 to 0.7.7: src/curobo/geom/types.py,
VoxelGrid.get_grid_shape, and src/curobo/curobolib/cpp/sphere_obb_kernel.cu, compute_voxel_index). `read_from_stream`
follows MoveIt's PropagationDistanceField::readFromStream and VoxelGrid::resize line by line (moveit_core,
distance_field; the same in MoveIt 1 and 2). Neither program was run.
"""

import ast
import io
import json
import math
import shutil
import subprocess
import sys
import zlib
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.formats.grid import grid_format, planner_grids
from splatctrl_cli.formats.grid import iso_surface as module
from splatctrl_cli.formats.grid.iso_surface import iso_surface, write_surface
from splatctrl_cli.formats.grid.npz_grid import write_npz
from splatctrl_cli.formats.grid.nrrd import PREFIX, write_nrrd
from splatctrl_cli.formats.grid.planner_grids import read_moveit_head, write_curobo, write_moveit
from splatctrl_cli.formats.grid.vdb import openvdb, read_vdb_head, write_vdb
from splatctrl_cli.formats.grid.vti import write_vti
from splatctrl_cli.recording.source import describe
from splatctrl_cli.records import Bool, DistanceGrid, Float64
from tests.conftest import ROOT
from tests.formats.grid.make_grid import HEADER, SHAPE, ball_grid, centers, random_grid, with_unknown
from tests.refused import expect_refusal

f32 = np.float32


@pytest.mark.parametrize("channel", ["sdf", "gradient", "observed", "bound"])
def test_pynrrd_reads_every_value_at_its_place(tmp_path: Path, channel: str) -> None:
    nrrd = pytest.importorskip("nrrd", reason="pynrrd is not installed: not tried on its reader")
    grid = with_unknown(random_grid())
    write_nrrd(tmp_path / "field.nrrd", grid, channel)
    values, header = nrrd.read(str(tmp_path / "field.nrrd"))
    is_vector = channel == "gradient"
    found = np.moveaxis(values, 0, -1) if is_vector else values
    np.testing.assert_array_equal(found, grid.channels[channel], strict=True)
    np.testing.assert_array_equal(header["space directions"][is_vector:], 0.02 * np.eye(3))
    np.testing.assert_array_equal(header["space origin"], grid.origin)
    expected = {
        "space": "3D-right-handed",
        "content": channel,
        "space units": ["m"] * 3,
        "kinds": ["vector"] * is_vector + ["domain"] * 3,
        "sample units": None if channel in {"gradient", "observed"} else "m",
    }
    assert {key: header.get(key) for key in expected} == expected
    ours = {key.removeprefix(PREFIX): json.loads(text) for key, text in header.items() if key.startswith(PREFIX)}
    assert ours == grid.header


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
    program = "import numpy, sys\ntry: import openvdb\nexcept ImportError: import pyopenvdb\n"
    for python in filter(shutil.which, (sys.executable, "/usr/bin/python3")):
        if subprocess.run([python, "-c", program], capture_output=True, check=False).returncode == 0:
            return python
    pytest.skip("no Python with OpenVDB's module here: .vdb files are not tried on OpenVDB itself")


def test_openvdb_reads_every_value_at_its_place(tmp_path: Path) -> None:
    python, grid = python_with_openvdb(), with_unknown(random_grid(shape=(20, 9, 13)))
    np.savez(tmp_path / "arrays.npz", **grid.channels)  # type: ignore[arg-type]
    command = [python, "-c", ROUND_TRIP, str(tmp_path), repr(grid.header)]
    env = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert result.returncode == 0, result.stderr
    found = {name: rest for name, *rest in ast.literal_eval(result.stdout)}
    assert found.keys() == grid.channels.keys()
    with np.load(tmp_path / "read.npz") as read:
        for name, values in grid.channels.items():
            kind, num_active, outside, background, place, metadata = found[name]
            blank, is_vector = np.isnan(values), values.ndim == 4
            np.testing.assert_array_equal(read[name][~blank], values[~blank].astype(np.float32))
            np.testing.assert_array_equal(read[name][blank], 0.0 if is_vector else np.float32(background))
            known = ~(blank[..., 0] if is_vector else blank)
            called = "level set" if name in {"sdf", "hard", "se", "gpdf"} else "unknown"
            assert (num_active, outside, kind) == (known.sum(), (background, False), called)
            assert is_vector or np.float32(background) == np.nextafter(np.nanmax(values).astype("f4"), np.float32(9))
            np.testing.assert_allclose(place, (-0.02, 0.22, 0.5), atol=1e-12)
            said = {"sign": "positive outside", "labels": '["human", "object"]', "length_scale": 0.02}
            assert said.items() <= metadata.items()
    heads = {name: (kind, metadata) for name, kind, metadata in read_vdb_head(tmp_path / "a.vdb")}
    assert heads.keys() == grid.channels.keys() and heads["gradient"][0] == "Tree_vec3s_5_4_3"
    assert {key: grid.header[key] for key in ("frame", "version", "note")}.items() <= heads["sdf"][1].items()
    content = (tmp_path / "a.vdb").read_bytes()
    assert content == (tmp_path / "b.vdb").read_bytes()
    summary = describe(tmp_path / "a.vdb")
    facts = {"grids": len(grid.channels), "labels": ["human", "object"], "distance": "safe"}
    assert summary.kind == "OpenVDB" and facts.items() <= summary.facts.items()
    assert ["sdf", "Tree_float_5_4_3", "level set", 20 * 9 * 13 - 12] in list(summary.grids[0].rows)
    for length in (9, 30, 70, 200):
        (tmp_path / "cut.vdb").write_bytes(content[:length])
        expect_refusal("not a readable OpenVDB file", read_vdb_head, tmp_path / "cut.vdb")


def test_without_openvdb_the_remedy_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("openvdb", "pyopenvdb"):
        monkeypatch.setitem(sys.modules, name, None)
    remedy = "cannot be imported.*; install OpenVDB's Python module: conda-forge"
    expect_refusal(remedy, openvdb, error=UsageError)
    expect_refusal(remedy, write_vdb, tmp_path / "field.vdb", random_grid(), error=UsageError)
    write_npz(tmp_path / "field.npz", random_grid())
    expect_refusal("expected an OpenVDB file", read_vdb_head, tmp_path / "field.npz")


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
    places = image.GetDimensions(), image.GetOrigin(), image.GetSpacing()
    assert places == (SHAPE, tuple(grid.origin), (0.02, 0.02, 0.02))
    point, data = image.FindPoint((-0.1 + 0.02 * 4, 0.2 + 0.02 * 1, 0.3 + 0.02 * 10)), image.GetPointData()
    assert [data.GetArrayName(i) for i in range(data.GetNumberOfArrays())] == list(grid.channels)
    for name, values in grid.channels.items():
        array = to_numpy(data.GetArray(name))
        cube = array.reshape(*SHAPE[::-1], *values.shape[3:])
        np.testing.assert_array_equal(cube.swapaxes(0, 2), values, strict=True)
        np.testing.assert_array_equal(array[point], values[4, 1, 10])
    has_vectors = data.GetVectors() is not None
    assert (data.GetScalars().GetName(), has_vectors) == ("sdf", "gradient" in grid.channels)
    assert grid_format.parse_header("x", image.GetFieldData().GetAbstractArray("header").GetValue(0)) == grid.header


HOSTILE = [  # voxels and sizes at which a product of floats falls short of a whole number; odd and even sides
    *((0.02, (9, 10, 11)), (0.1, (8, 29, 7)), (0.015, (13, 7, 58)), (1 / 3, (10, 11, 6)), (0.7, (7, 8, 9))),
]


def host_shape_07(dims: list[float], voxel: float) -> list[int]:
    def robust_floor(x: float) -> int:
        return round(x) if abs(x - round(x)) < 1e-4 else math.floor(x)

    return [1 + robust_floor(x * (1.0 / voxel)) for x in dims]


def kernel_07(file: dict[str, Any], points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(Q, 3) cells and (Q,) what a sphere's centre reads there, in float32 throughout."""
    dims, inverse = file["dims"].astype(f32), f32(1.0) / f32(file["voxel_size"])
    local = points.astype(f32) - file["pose"][:3].astype(f32)
    exact = dims * inverse
    nearest = np.round(exact)
    shape = (np.where(exact - nearest >= f32(1e-4), np.floor(exact), nearest) + 1).astype(int)
    cells = ((local + f32(0.5) * dims) * inverse).astype(int)  # truncates, as make_int3 does
    flat = cells[:, 0] * shape[1] * shape[2] + cells[:, 1] * shape[2] + cells[:, 2]
    is_inside = ((cells > 2) & (cells < shape - 2)).all(axis=1)
    return cells, np.where(is_inside, file["features"][np.where(is_inside, flat, 0)], f32(-1000.0))


@pytest.mark.parametrize(("voxel", "shape"), HOSTILE)
def test_0_7_reads_the_value_of_the_cell_that_a_centre_lies_in(
    tmp_path: Path, voxel: float, shape: tuple[int, int, int]
) -> None:
    grid = replace(random_grid("sdf", shape=shape), origin=np.array([1.7, -2.3, 0.01]), voxel=voxel)
    write_curobo(tmp_path / "field.curobo.npz", grid)
    with np.load(tmp_path / "field.curobo.npz", allow_pickle=False) as content:
        file = dict(content)
    assert host_shape_07(file["dims"].tolist(), float(file["voxel_size"])) == list(shape) == file["shape"].tolist()
    assert (json.loads(str(file["header"])), file["pose"][3:].tolist()) == (HEADER, [1.0, 0.0, 0.0, 0.0])
    assert (file["features"].dtype, file["features"].shape) == (np.float32, (math.prod(shape),))
    points, expected = centers(grid).reshape(-1, 3), np.array(list(np.ndindex(shape)))
    is_read = ((expected > 2) & (expected < np.array(shape) - 2)).all(axis=1)
    assert is_read.any()
    for offset in (0.0, 0.45, -0.45):
        cells, values = kernel_07(file, points + offset * grid.voxel)
        np.testing.assert_array_equal(cells, expected)
        np.testing.assert_array_equal(values[is_read], -grid.channels["sdf"].ravel()[is_read])
        assert (values[~is_read] == -1000.0).all(), "as the docs say: free"


def test_what_planners_cannot_take_is_refused(tmp_path: Path) -> None:
    path, unknown = tmp_path / "field.x", "got NaN; bake with field.unknown=obstacle or free"
    expect_refusal(unknown, write_curobo, path, with_unknown(random_grid()))
    channels = "expected the channel bound or hard, got sdf; bake it with one of them"
    expect_refusal(channels, write_moveit, path, random_grid("sdf"))
    assert not path.exists()
    path.write_bytes(b"resolution: 0.1\nsize_x: inf\n")
    expect_refusal("expected 'size_x: NUMBER', got b'size_x: inf", read_moveit_head, path)


def read_from_stream(path: Path) -> tuple[Float64, float, Bool]:
    """Origin, resolution, and (X, Y, Z) which cells are obstacles."""
    stream = io.BytesIO(path.read_bytes())
    words: list[bytes] = []

    def word() -> bytes:  # operator>>: skips white space, stops before the next
        while (byte := stream.read(1)).isspace():
            pass
        found = b""
        while byte and not byte.isspace():
            found, byte = found + byte, stream.read(1)
        stream.seek(-1, io.SEEK_CUR)
        return found

    for name in ("resolution", "size_x", "size_y", "size_z", "origin_x", "origin_y", "origin_z"):
        assert word() == name.encode() + b":"
        words.append(word())
    resolution, *rest = map(float, words)
    per_metre = 1.0 / resolution
    x_cells, y_cells, z_cells = (int(size * per_metre) for size in rest[:3])
    assert stream.read(1) == b"\n"
    content = io.BytesIO(zlib.decompress(stream.read()))
    cells = np.zeros((x_cells, y_cells, z_cells), bool)
    for x, y, z in product(range(x_cells), range(y_cells), range(0, z_cells, 8)):
        byte = content.read(1)[0]
        for zi in range(min(8, z_cells - z)):
            cells[x, y, z + zi] = byte >> zi & 1
    assert content.read() == b""
    return np.array(rest[3:]), resolution, cells


@pytest.mark.parametrize("channels", [("sdf", "bound"), ("sdf", "hard"), ("sdf", "hard", "bound")])
def test_the_cells_that_a_splat_may_reach_into_are_occupied(
    tmp_path: Path, channels: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planner_grids, "CHUNK", 4 * 22 * 23 * 2)
    grid = ball_grid()
    write_moveit(tmp_path / "field.moveit", replace(grid, channels={name: grid.channels[name] for name in channels}))
    origin, resolution, cells = read_from_stream(tmp_path / "field.moveit")
    assert (origin.tolist(), resolution) == (grid.origin.tolist(), grid.voxel)
    # cells whose cube, seen as the ball around it, the ball reaches
    distance = np.linalg.norm(centers(grid) - (0.1, 0.0, 0.0), axis=-1) - 0.3
    np.testing.assert_array_equal(cells, distance <= np.sqrt(0.75) * grid.voxel + 1e-6)
    assert 0.05 < cells.mean() < 0.5


@pytest.mark.parametrize(
    ("voxel", "shape"), [(0.02, (9, 10, 11)), (0.1, (3, 29, 57)), (0.7, (7, 8, 9)), (1 / 3, (3, 1, 2))]
)
def test_no_rounding_loses_a_cell_and_those_without_a_distance_are_occupied(
    tmp_path: Path, voxel: float, shape: tuple[int, int, int]
) -> None:
    grid = replace(with_unknown(random_grid(shape=shape)), origin=np.array([1e-5, -2.3, 0.0]), voxel=voxel)
    write_moveit(tmp_path / "field.moveit", grid)
    (origin, _, cells), sdf = read_from_stream(tmp_path / "field.moveit"), grid.channels["sdf"]
    assert origin.tolist() == grid.origin.tolist()
    np.testing.assert_array_equal(cells, (grid.channels["bound"] <= 0) | (sdf <= 0) | np.isnan(sdf))


MIDDLE = np.array([0.1, 0.0, 0.0])


def mesh_of(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


@pytest.mark.parametrize(("level", "radius"), [(0.0, 0.3), (0.05, 0.35), (-0.1, 0.2)])
def test_the_surface_of_a_ball_is_where_its_distance_says_and_faces_outwards(level: float, radius: float) -> None:
    grid = ball_grid()
    grid.channels["sdf"] = grid.channels["sdf"] - np.float32(level)
    surface = iso_surface(grid)
    mesh, away = mesh_of(surface), surface.vertices - MIDDLE
    # between two centres the distance is off its chord by at most voxel^2 / (8 r)
    assert np.abs(np.linalg.norm(away, axis=1) - radius).max() <= 0.04**2 / (8 * (radius - 0.04)) + 1e-5
    assert mesh.is_watertight and mesh.euler_number == 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=(0.04 / radius) ** 2)
    assert ((mesh.vertex_normals * away).sum(axis=1) > 0.95 * radius).all()


@pytest.mark.parametrize("shape", [(21, 22, 23), (22, 21, 24)])
def test_slabs_join_to_what_one_piece_gives(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int, int]) -> None:
    grid = ball_grid(shape=shape)
    whole = iso_surface(grid)
    monkeypatch.setattr(module, "CHUNK", 4 * shape[1] * shape[2] * 3)
    pieces = iso_surface(grid)
    np.testing.assert_allclose(pieces.vertices, whole.vertices, atol=1.01 * module.STEP * grid.voxel)
    rolled = [{tuple(np.roll(face, -np.argmin(face))) for face in surface.faces} for surface in (pieces, whole)]
    assert rolled[0] == rolled[1] and mesh_of(pieces).is_watertight


@pytest.mark.parametrize("chunk", [1, 1 << 24])
def test_cells_without_a_distance_make_no_surface(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    monkeypatch.setattr(module, "CHUNK", chunk)
    grid = ball_grid()
    whole = iso_surface(grid)
    blank = np.zeros(grid.channels["sdf"].shape, bool)
    blank[1:5, 9:13, 9:13] = True
    grid.channels["sdf"] = np.where(blank, np.float32(np.nan), grid.channels["sdf"])

    def touches(surface: trimesh.Trimesh) -> np.ndarray:  # type: ignore[type-arg]
        cube = np.floor((surface.vertices[surface.faces].mean(axis=1) - grid.origin) / grid.voxel).astype(int)
        return np.any([blank[tuple((cube + corner).T)] for corner in np.ndindex(2, 2, 2)], axis=0)

    open_surface = iso_surface(grid)
    assert not touches(open_surface).any()
    assert len(open_surface.faces) == len(whole.faces) - touches(whole).sum() < len(whole.faces)
    assert np.isfinite(open_surface.vertices).all()


def test_every_suffix_reads_back_as_the_same_triangles(tmp_path: Path) -> None:
    surface = iso_surface(ball_grid())
    for suffix in (".stl", ".obj", ".ply"):
        write_surface(tmp_path / f"field{suffix}", surface)
        read = trimesh.load_mesh(tmp_path / f"field{suffix}", process=False)
        np.testing.assert_allclose(read.triangles, surface.vertices[surface.faces], atol=1e-6)
    np.testing.assert_allclose(read.vertex_normals, mesh_of(surface).vertex_normals, atol=1e-4)  # sharp triangles


@pytest.mark.parametrize(
    ("sdf", "said"),
    [
        (
            ball_grid().channels["sdf"] + np.float32(1.0),
            r"expected sdf to cross 0 m, got values from 0.71\d+ to 1.\d+ m; b",
        ),
        (np.full((21, 22, 23), np.nan, np.float32), "got no cell that has a distance"),
        (np.ones((1, 4, 4), np.float32), "at least 2 cells along each axis"),
        (np.repeat(np.float32([-1, np.nan, 1]), 72).reshape(6, 6, 6), "expected sdf to cross 0 m"),
    ],
    ids=["far", "blank", "thin", "nothing known between the sides"],
)
def test_a_grid_without_a_surface_is_told_with_its_range(sdf: NDArray[np.float32], said: str) -> None:
    grid = DistanceGrid(origin=np.zeros(3), voxel=0.1, channels={"sdf": sdf}, header={})
    expect_refusal(said, iso_surface, grid, error=NotEvaluableError)
