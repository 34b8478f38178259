"""Gaussians as PLY of the reference layout; and points of a PLY file."""

import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.ply import is_mesh, read_points, read_positions
from splatctrl_cli.formats.splat.gaussian_ply import NAMES, read_gaussian_ply, write_gaussian_ply
from splatctrl_cli.formats.splat.splats import read_ply
from splatctrl_cli.records import GaussianSet, SplatSet


def gaussian_set(num: int = 40, *, degree: int = 3, seed: int = 0) -> GaussianSet:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(num, 4))
    return GaussianSet(
        centers=rng.normal(size=(num, 3)).astype(np.float32),
        scales=rng.uniform(1e-3, 3e-2, (num, 3)).astype(np.float32),
        quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0.01, 0.99, num).astype(np.float32),
        harmonics=rng.uniform(-0.8, 0.8, (num, (degree + 1) ** 2, 3)).astype(np.float32),
        labels=np.zeros(num, np.uint8),
    )


def ascii_ply(path: Path, names: list[str], rows: list[list[object]]) -> Path:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {name}" for name in names)]
    path.write_text("\n".join([*lines, "end_header", *(" ".join(map(str, row)) for row in rows)]) + "\n")
    return path


def assert_equal_bits(a: GaussianSet | SplatSet, b: GaussianSet | SplatSet) -> None:
    for field in fields(a):
        left, right = getattr(a, field.name), getattr(b, field.name)
        assert left.dtype == right.dtype, field.name
        assert np.array_equal(left, right), field.name


def test_one_gaussian_has_the_bytes_of_the_reference_layout(tmp_path: Path) -> None:
    harmonics = np.arange(48, dtype=np.float32).reshape(1, 16, 3)  # coefficient k of channel c is 3 k + c
    one = GaussianSet(
        centers=np.array([[1, 2, 3]], np.float32),
        scales=np.array([[0.01, 0.02, 0.03]], np.float32),
        quats_wxyz=np.array([[0.5, -0.5, 0.5, -0.5]], np.float32),
        opacities=np.array([0.5], np.float32),
        harmonics=harmonics,
        labels=np.zeros(1, np.uint8),
    )
    write_gaussian_ply(tmp_path / "a.ply", one, {})
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[2] == "element vertex 1"  # where readers of a fixed layout look for it
    assert [line for line in lines if line.startswith("property")] == [f"property float {name}" for name in NAMES]
    red, green, blue = ([3.0 * k + channel for k in range(1, 16)] for channel in range(3))
    expected = [1, 2, 3, 0, 0, 0, 0, 1, 2, *red, *green, *blue, 0, *np.log([0.01, 0.02, 0.03]), 0.5, -0.5, 0.5, -0.5]
    np.testing.assert_allclose(struct.unpack("<62f", body), expected, rtol=1e-6)


def test_ascii_in_any_order_with_a_quaternion_of_any_length_reads_the_same(tmp_path: Path) -> None:
    names = ["rot_3", "rot_0", "rot_2", "rot_1", "z", "y", "x", "scale_2", "scale_1", "scale_0", "opacity"]
    names += ["f_dc_2", "f_dc_1", "f_dc_0", *(f"f_rest_{index}" for index in reversed(range(9)))]
    row: list[object] = [0, 2, 0, 2, 3, 2, 1, -5, -4, -3, 0, 0.3, 0.2, 0.1, *reversed(range(1, 10))]
    g, _ = read_gaussian_ply(ascii_ply(tmp_path / "a.ply", names, [row]))
    np.testing.assert_allclose(g.centers, [[1, 2, 3]])
    np.testing.assert_allclose(g.scales, np.exp([[-3, -4, -5]]), rtol=1e-6)
    np.testing.assert_allclose(g.quats_wxyz, [[np.sqrt(0.5), np.sqrt(0.5), 0, 0]], rtol=1e-6)
    np.testing.assert_allclose(g.harmonics[0], [[0.1, 0.2, 0.3], [1, 4, 7], [2, 5, 8], [3, 6, 9]], rtol=1e-6)


def test_degrees_that_are_zero_throughout_are_left_out(tmp_path: Path) -> None:
    gaussians = gaussian_set(degree=2)
    gaussians.harmonics[:, 1:] = 0
    gaussians.harmonics[3, 2, 1] = 1e-20  # one coefficient of degree 1
    write_gaussian_ply(tmp_path / "a.ply", gaussians, {})
    back = read_gaussian_ply(tmp_path / "a.ply")[0].harmonics
    assert back.shape[1] == 4
    assert np.array_equal(back, gaussians.harmonics[:, :4])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"centers": [[0, 0, 0], [0, np.nan, 0]]}, r"splat 1: center: expected finite, got \[ 0. nan  0.\]"),
        ({"scales": [[1, 1, 1], [1, 0, 1]]}, r"splat 1: sigma: expected more than 0 m, got \[1. 0. 1.\]"),
        ({"opacities": [0.5, 1.5]}, "splat 1: opacity: expected 0 to 1, got 1.5"),
        ({"quats_wxyz": [[1, 1, 0, 0], [1, 0, 0, 0]]}, "splat 0: rotation: expected a unit quaternion w x y z"),
        ({"harmonics": np.zeros((2, 5, 3))}, "harmonics: expected 1, 4, 9 or 16 coefficients, got 5"),
        ({"harmonics": np.zeros((1, 4, 3))}, "harmonics: expected 2 values, got 1"),
    ],
)
def test_a_set_that_the_format_cannot_hold_is_refused(
    tmp_path: Path, change: dict[str, list[float]], message: str
) -> None:
    bad = replace(gaussian_set(2), **{name: np.array(values, np.float32) for name, values in change.items()})
    with pytest.raises(InputError, match=message):
        write_gaussian_ply(tmp_path / "a.ply", bad, {})
    assert not (tmp_path / "a.ply").exists()


GOOD: list[object] = [0, 0, 0, 0, 0, 0, 0, -4, -4, -6, 1, 0, 0, 0]
PLAIN = [name for name in NAMES if name[0] != "n" and not name.startswith("f_rest_")]


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (1, "nan", r"splat 1: y: expected a finite number, got nan \(1 of 2 are not finite\)"),
        (12, "inf", "splat 1: rot_2: expected a finite number, got inf"),
        (8, 200, r"splat 1: scale_1: expected a radius that float32 holds \[m\]"),
        (10, 0, "splat 1: rotation: expected a quaternion that is not zero"),
    ],
)
def test_a_row_that_is_no_gaussian_is_named_by_its_index(
    tmp_path: Path, index: int, value: object, message: str
) -> None:
    bad = GOOD.copy()
    bad[index] = value
    with pytest.raises(InputError, match=message):
        read_gaussian_ply(ascii_ply(tmp_path / "a.ply", PLAIN, [GOOD, bad]))


@pytest.mark.parametrize("names", [[f"f_rest_{i}" for i in range(10)], [f"f_rest_{i}" for i in range(1, 10)]])
def test_harmonics_of_no_degree_are_refused(tmp_path: Path, names: list[str]) -> None:
    row: list[object] = [*GOOD, *[0] * len(names)]
    with pytest.raises(InputError, match=r"f_rest_\*: expected 0, 9, 24, 45 of them in a row from 0, got"):
        read_gaussian_ply(ascii_ply(tmp_path / "a.ply", [*PLAIN, *names], [row]))


def test_a_compressed_ply_is_refused_by_name(tmp_path: Path) -> None:
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1", "property float min_x", "element vertex 1"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    (tmp_path / "a.ply").write_bytes("\n".join([*header, "end_header", ""]).encode() + bytes(20))
    for read in (read_ply, read_gaussian_ply):
        with pytest.raises(InputError, match=r"compressed PLY of SuperSplat .*; export it there as an uncompr"):
            read(tmp_path / "a.ply")


def test_open3d_finds_the_same_values(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed: its reader was not compared")
    gaussians = gaussian_set(30)
    write_gaussian_ply(tmp_path / "a.ply", gaussians, {})
    points = open3d.t.io.read_point_cloud(str(tmp_path / "a.ply")).point
    assert np.array_equal(points["positions"].numpy(), gaussians.centers)
    assert np.array_equal(points["rot"].numpy(), gaussians.quats_wxyz)
    assert np.array_equal(points["f_dc"].numpy(), gaussians.harmonics[:, 0])
    assert np.array_equal(points["f_rest"].numpy(), gaussians.harmonics[:, 1:])
    np.testing.assert_allclose(points["scale"].numpy(), gaussians.scales, rtol=1e-6)


COLOURED = ["x", "y", "z", "red", "green", "blue"]
ROWS: list[list[object]] = [[1, 2, 3, 255, 0, 51], [4, 5, 6, 0, 255, 0]]


def test_points_are_read_in_metres_with_colours_from_0_to_1(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", COLOURED, ROWS)
    cloud = read_points(path)
    assert np.array_equal(cloud.points, np.float32([[1, 2, 3], [4, 5, 6]]))
    assert cloud.colors == pytest.approx(np.array([[1, 0, 0.2], [0, 1, 0]]))
    assert read_positions(path).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert not is_mesh(path)


@pytest.mark.parametrize(
    ("names", "rows", "said"),
    [
        (["x", "y", "z", "red", "blue"], [[1, 2, 3, 1, 1]], "no coloured point cloud: missing properties green"),
        (COLOURED, [], "has no points"),
        (COLOURED, [[*ROWS[0][:3], 256, 1, 1]], "expected 0 to 255, got up to 256"),
    ],
)
def test_what_is_no_coloured_point_cloud_is_refused(
    tmp_path: Path, names: list[str], rows: list[list[object]], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        read_points(ascii_ply(tmp_path / "a.ply", names, rows))


def test_positions_need_no_colours_but_three_axes_and_a_point(tmp_path: Path) -> None:
    assert read_positions(ascii_ply(tmp_path / "a.ply", ["x", "y", "z"], [[1000, 2, 3]])).tolist() == [[1000, 2, 3]]
    with pytest.raises(InputError, match="no point cloud: missing properties z"):
        read_positions(ascii_ply(tmp_path / "a.ply", ["x", "y"], [[1, 2]]))
    with pytest.raises(InputError, match="has no points"):
        read_positions(ascii_ply(tmp_path / "a.ply", ["x", "y", "z"], []))


@pytest.mark.parametrize("num", [0, 3])
def test_a_file_with_faces_is_a_mesh(tmp_path: Path, num: int) -> None:
    path = ascii_ply(tmp_path / "a.ply", COLOURED, ROWS)
    path.write_text(path.read_text().replace("end_header", f"element face {num}\nend_header"))
    assert is_mesh(path) == (num > 0)
    assert is_mesh(tmp_path / "a.obj")
    with pytest.raises(InputError, match=r"none.ply: cannot be read: No such file"):
        is_mesh(tmp_path / "none.ply")
