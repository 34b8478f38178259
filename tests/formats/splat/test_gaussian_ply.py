"""PLY files of Gaussians, of round splats and of points: what is written, what is read back, what is refused."""

import struct
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.formats.ply import is_mesh, read_points, read_positions
from splatctrl_cli.formats.splat.gaussian_ply import NAMES, read_gaussian_ply, write_gaussian_ply
from splatctrl_cli.formats.splat.splats import DTYPE, read_ply, write_ply
from splatctrl_cli.records import GaussianSet, Label, SplatSet
from tests.plain import plain_splats
from tests.refused import expect_refusal


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


def splat_set(num: int = 50, seed: int = 0) -> SplatSet:
    rng = np.random.default_rng(seed)
    return SplatSet(
        centers=rng.normal(size=(num, 3)).astype(np.float32),
        radii=rng.uniform(1e-3, 2e-2, num).astype(np.float32),
        colors=rng.uniform(-0.1, 1.1, (num, 3)).astype(np.float32),
        opacities=rng.uniform(0.001, 0.999, num).astype(np.float32),
        labels=rng.integers(0, 3, num).astype(np.uint8),
        density=rng.uniform(0, 40, num).astype(np.float32),
    )


def changed(sets: Any, **changes: Any) -> Any:
    """The set with other values, in float32."""
    return replace(sets, **{name: np.array(values, np.float32) for name, values in changes.items()})


def ascii_ply(path: Path, names: list[str], rows: list[list[object]]) -> Path:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {name}" for name in names)]
    path.write_text("\n".join([*lines, "end_header", *(" ".join(map(str, row)) for row in rows)]) + "\n")
    return path


def parts_of(path: Path) -> tuple[list[str], bytes]:
    """The lines of the header, and what follows it."""
    header, body = path.read_bytes().split(b"end_header\n")
    return header.decode("ascii").splitlines(), body


def test_one_gaussian_has_the_bytes_of_the_reference_layout(tmp_path: Path) -> None:
    one = changed(
        gaussian_set(1),
        centers=[[1, 2, 3]],
        scales=[[0.01, 0.02, 0.03]],
        quats_wxyz=[[0.5, -0.5, 0.5, -0.5]],
        opacities=[0.5],
        harmonics=np.arange(48).reshape(1, 16, 3),  # coefficient k of channel c is 3 k + c
    )
    write_gaussian_ply(tmp_path / "a.ply", one, {})
    lines, body = parts_of(tmp_path / "a.ply")
    properties = [line for line in lines if line.startswith("property")]  # the number: where fixed layouts have it
    assert (lines[2], properties) == ("element vertex 1", [f"property float {name}" for name in NAMES])
    red, green, blue = ([3.0 * k + channel for k in range(1, 16)] for channel in range(3))
    expected = [1, 2, 3, 0, 0, 0, 0, 1, 2, *red, *green, *blue, 0, *np.log([0.01, 0.02, 0.03]), 0.5, -0.5, 0.5, -0.5]
    np.testing.assert_allclose(struct.unpack("<62f", body), expected, rtol=1e-6)


MINIMAL = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
STANDARD = [*MINIMAL[:3], "nx", "ny", "nz", *MINIMAL[3:], "rot_0", "rot_1", "rot_2", "rot_3"]


def test_one_splat_has_the_properties_and_bytes_that_a_stock_viewer_expects(tmp_path: Path) -> None:
    one = plain_splats([1, 2, 3], 0.01, colors=[0.5, 1.0, 0.0], opacities=0.5, labels=Label.HUMAN)
    write_ply(tmp_path / "a.ply", changed(one, density=[7.0]), {"source": "run 7"})
    lines, body = parts_of(tmp_path / "a.ply")
    properties = [*(f"property float {name}" for name in STANDARD), "property uchar label", "property float density"]
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines if line.startswith("property")] == properties
    assert {"comment frame: world", "comment units: metre", "comment source: run 7"} <= set(lines)
    half = 0.5 / 0.28209479177387814
    expected = [1, 2, 3, 0, 0, 0, 0, half, -half, 0, *[np.log(0.01)] * 3, 1, 0, 0, 0, 2, 7]
    np.testing.assert_allclose(struct.unpack("<17fBf", body), expected, rtol=1e-6)


def test_what_is_written_reads_back_within_float32_and_then_bit_for_bit(tmp_path: Path) -> None:
    splats = splat_set(2000)
    write_ply(tmp_path / "a.ply", splats, {})
    first, _ = read_ply(tmp_path / "a.ply")
    for name in ("centers", "labels", "density"):
        assert np.array_equal(getattr(first, name), getattr(splats, name)), name
    np.testing.assert_allclose(first.radii, splats.radii, rtol=1e-6)
    np.testing.assert_allclose(first.opacities, splats.opacities, rtol=1e-6)
    np.testing.assert_allclose(first.colors, splats.colors, atol=1e-7)
    write_ply(tmp_path / "b.ply", first, {})
    again = read_ply(tmp_path / "b.ply")[0]
    for field in fields(first):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(first, field.name), strict=True)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_opacities_of_exactly_0_and_1_are_finite_logits_and_read_back_exactly(tmp_path: Path) -> None:
    edges = np.array([0.0, 1.0, np.nextafter(np.float32(1), np.float32(0)), 1e-30], np.float32)
    write_ply(tmp_path / "a.ply", replace(splat_set(4), opacities=edges), {})
    assert np.isfinite(np.frombuffer(parts_of(tmp_path / "a.ply")[1], DTYPE)["opacity"]).all()
    back = read_ply(tmp_path / "a.ply")[0].opacities
    assert back[:3].tolist() == edges[:3].tolist() and back[3] == pytest.approx(1e-30, rel=1e-5)


def test_an_empty_set_is_a_file_and_comments_come_back(tmp_path: Path) -> None:
    path, said = tmp_path / "a.ply", {"scene": "C: and more", "note": "", "place": "Zürich"}
    write_ply(path, splat_set(5).select(np.zeros(5, dtype=bool)), said)
    splats, comments = read_ply(path)
    assert len(splats) == len(read_gaussian_ply(path)[0]) == 0
    assert (said | {"place": "Z\\xfcrich", "frame": "world"}).items() <= comments.items()


@pytest.mark.parametrize("comments", [{"a": "two\nlines"}, {"a:b": "c"}, {"": "c"}])
def test_a_comment_that_would_break_the_header_is_refused(tmp_path: Path, comments: dict[str, str]) -> None:
    expect_refusal("comment", lambda: write_ply(tmp_path / "a.ply", splat_set(1), comments), error=UsageError)
    assert not (tmp_path / "a.ply").exists()


def test_ascii_in_any_order_with_a_quaternion_of_any_length_reads_the_same(tmp_path: Path) -> None:
    names = ["rot_3", "rot_0", "rot_2", "rot_1", "z", "y", "x", "scale_2", "scale_1", "scale_0", "opacity"]
    names += ["f_dc_2", "f_dc_1", "f_dc_0", *(f"f_rest_{index}" for index in reversed(range(9)))]
    row: list[object] = [0, 2, 0, 2, 3, 2, 1, -5, -4, -3, 0, 0.3, 0.2, 0.1, *reversed(range(1, 10))]
    g, _ = read_gaussian_ply(ascii_ply(tmp_path / "a.ply", names, [row]))
    np.testing.assert_allclose(g.centers, [[1, 2, 3]])
    np.testing.assert_allclose(g.scales, np.exp([[-3, -4, -5]]), rtol=1e-6)
    np.testing.assert_allclose(g.quats_wxyz, [[np.sqrt(0.5), np.sqrt(0.5), 0, 0]], rtol=1e-6)
    np.testing.assert_allclose(g.harmonics[0], [[0.1, 0.2, 0.3], [1, 4, 7], [2, 5, 8], [3, 6, 9]], rtol=1e-6)


def test_ascii_in_any_order_with_extra_properties_is_read_as_round_splats(tmp_path: Path) -> None:
    row: list[object] = [0.25, -4, -4, -4, 0, 0.1, 0.2, 0.3, 3, 2, 1]
    path = ascii_ply(tmp_path / "a.ply", ["confidence", *reversed(MINIMAL)], [row, row])
    path.write_text(path.read_text().replace("ascii 1.0\n", "ascii 1.0\ncomment made by hand\n"))
    splats, comments = read_ply(path)
    np.testing.assert_allclose(splats.centers, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(splats.radii, np.exp(-4), rtol=1e-6)
    np.testing.assert_allclose(splats.colors[0], 0.5 + 0.28209479 * np.array([0.3, 0.2, 0.1]), rtol=1e-6)
    found = [getattr(splats, name).tolist() for name in ("opacities", "density", "labels")]
    assert (found, comments) == ([[0.5, 0.5], [0, 0], [Label.OBJECT] * 2], {"made by hand": ""})


def test_big_endian_doubles_and_other_elements_read_the_same(tmp_path: Path) -> None:
    header = ["ply", "format binary_big_endian 1.0", "element camera 1", "property int id", "element vertex 1"]
    header += [f"property double {name}" for name in MINIMAL] + ["end_header", ""]
    values = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, -4.0, -4.0, -4.0]
    (tmp_path / "a.ply").write_bytes("\r\n".join(header).encode() + struct.pack(">i10d", 5, *values))
    assert read_ply(tmp_path / "a.ply")[0].centers.tolist() == [[1, 2, 3]]


def test_degrees_that_are_zero_throughout_are_left_out(tmp_path: Path) -> None:
    gaussians = gaussian_set(degree=2)
    gaussians.harmonics[:, 1:] = 0
    gaussians.harmonics[3, 2, 1] = 1e-20  # one coefficient of degree 1
    write_gaussian_ply(tmp_path / "a.ply", gaussians, {})
    back = read_gaussian_ply(tmp_path / "a.ply")[0].harmonics
    np.testing.assert_array_equal(back, gaussians.harmonics[:, :4], strict=True)


TWO, THREE = gaussian_set(2), splat_set(3)


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (changed(TWO, centers=[[0, 0, 0], [0, np.nan, 0]]), "splat 1: center: expected finite, got [ 0. nan  0.]"),
        (changed(TWO, scales=[[1, 1, 1], [1, 0, 1]]), "splat 1: sigma: expected more than 0 m, got [1. 0. 1.]"),
        (changed(TWO, opacities=[0.5, 1.5]), "splat 1: opacity: expected 0 to 1, got 1.5"),
        (
            changed(TWO, quats_wxyz=[[1, 1, 0, 0], [1, 0, 0, 0]]),
            "splat 0: rotation: expected a unit quaternion w x y",
        ),
        (changed(TWO, harmonics=np.zeros((2, 5, 3))), "harmonics: expected 1, 4, 9 or 16 coefficients, got 5"),
        (changed(TWO, harmonics=np.zeros((1, 4, 3))), "harmonics: expected 2 values, got 1"),
        (changed(THREE, radii=[0.01, np.nan, 0.01]), "splat 1: radius: expected finite, got nan"),
        (changed(THREE, radii=[0.01, 0.01, 0.0]), "splat 2: radius: expected more than 0 m, got 0"),
        (changed(THREE, opacities=[0.5, 1.01, 0.5]), "splat 1: opacity: expected 0 to 1, got 1.01"),
        (changed(THREE, opacities=[-0.1, 0.5, 0.5]), "splat 0: opacity: expected 0 to 1, got -0.1"),
        (changed(THREE, density=[0.0, 0.0, np.inf]), "splat 2: density: expected finite"),
        (changed(THREE, density=[0.0, 0.0]), "density: expected 3 values, got 2"),
    ],
)
def test_a_set_that_the_format_cannot_hold_is_refused(
    tmp_path: Path, made: GaussianSet | SplatSet, message: str
) -> None:
    write: Any = write_ply if isinstance(made, SplatSet) else write_gaussian_ply
    expect_refusal(message, write, tmp_path / "a.ply", made, {})
    assert not (tmp_path / "a.ply").exists()


LABEL = b"property uchar label"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda whole: whole[:-1], r"cut short: expected \d+ bytes .* got \d+"),
        (lambda whole: whole[:-300], "cut short: expected"),
        (lambda whole: whole + b"\0", "longer than its header says"),
        (lambda whole: whole[:100], "no end_header line"),
        (lambda _: b"", "no PLY file"),
        (lambda _: b"plywood\n", "no PLY file"),
        (
            lambda whole: whole.replace(LABEL, b"property quaternion q"),
            "line not understood: 'property quaternion q'",
        ),
        (lambda whole: whole.replace(LABEL, b"element vertex many"), "header line not understood"),
        (lambda whole: whole.replace(LABEL, b"property float x"), "names property x twice"),
    ],
)
def test_a_file_that_is_damaged_or_no_ply_is_refused(
    tmp_path: Path, change: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, splat_set(20), {})
    path.write_bytes(change(path.read_bytes()))
    expect_refusal(rf"a\.ply: .*{message}", read_ply, path)
    path.unlink()
    for read in (read_ply, is_mesh):
        expect_refusal("a.ply: cannot be read: No such file", read, path)


def test_a_compressed_ply_is_refused_by_name(tmp_path: Path) -> None:
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1", "property float min_x", "element vertex 1"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    (tmp_path / "a.ply").write_bytes("\n".join([*header, "end_header", ""]).encode() + bytes(20))
    for read in (read_ply, read_gaussian_ply):
        expect_refusal("compressed PLY of SuperSplat .*; export it there as an uncompr", read, tmp_path / "a.ply")


GOOD: list[object] = [0, 0, 0, 0, 0, 0, 0, -4, -4, -4]
GAUSSIAN: list[object] = [0, 0, 0, 0, 0, 0, 0, -4, -4, -6, 1, 0, 0, 0]
PLAIN = [name for name in NAMES if name[0] != "n" and not name.startswith("f_rest_")]
COLOURED = ["x", "y", "z", "red", "green", "blue"]
NO_DEGREE = "f_rest_*: expected 0, 9, 24, 45 of them in a row from 0, got"


def with_value(row: list[object], index: int, value: object) -> list[object]:
    return [*row[:index], value, *row[index + 1 :]]


@pytest.mark.parametrize(
    ("read", "names", "rows", "message"),
    [
        (read_gaussian_ply, PLAIN, [GAUSSIAN, with_value(GAUSSIAN, 1, "nan")], "splat 1: y: .*, got nan .1 of 2 are"),
        (read_gaussian_ply, PLAIN, [GAUSSIAN, with_value(GAUSSIAN, 12, "inf")], "splat 1: rot_2: .* number, got inf"),
        (read_gaussian_ply, PLAIN, [GAUSSIAN, with_value(GAUSSIAN, 8, 200)], "splat 1: scale_1: .* float32 holds"),
        (read_gaussian_ply, PLAIN, [GAUSSIAN, with_value(GAUSSIAN, 10, 0)], "splat 1: rotation: .* that is not zero"),
        (read_gaussian_ply, [*PLAIN, *(f"f_rest_{i}" for i in range(10))], [GAUSSIAN + [0] * 10], NO_DEGREE),
        (read_gaussian_ply, [*PLAIN, *(f"f_rest_{i}" for i in range(1, 10))], [GAUSSIAN + [0] * 9], NO_DEGREE),
        (read_ply, MINIMAL[:6], [[0] * 6], "missing properties opacity scale_0 .*it has x y z f_dc_0"),
        (read_ply, MINIMAL, [GOOD, *[with_value(GOOD, 9, -6)] * 2], "isotropic splats .* got 2 of 3 whose scales"),
        (read_ply, MINIMAL, [GOOD, with_value(GOOD, 0, "nan")], "splat 1: x: expected a finite number, got nan"),
        (read_ply, MINIMAL, [GOOD, with_value(GOOD, 8, "nan")], "splat 1: scale_1: expected a finite number"),
        (read_ply, MINIMAL, [[*GOOD[:7], *[-200] * 3]], "splat 0: scale_0: .* float32 holds"),
        (read_ply, MINIMAL, [[*GOOD[:7], *[200] * 3]], "splat 0: scale_0: .* float32 holds"),
        (read_ply, [*MINIMAL, "label"], [[*GOOD, 1.5]], "splat 0: label: expected a whole number 0 to 255, got 1.5"),
        (read_ply, MINIMAL, [GOOD[:9]], "vertex 0: expected 10 numbers, got 9"),
        (read_ply, MINIMAL, [with_value(GOOD, 9, "four")], "property scale_2: could not convert"),
        (read_points, ["x", "y", "z", "red", "blue"], [[1, 2, 3, 1, 1]], "no coloured point cloud: .* green"),
        (read_points, COLOURED, [], "has no points"),
        (read_points, COLOURED, [[1, 2, 3, 256, 1, 1]], "expected 0 to 255, got up to 256"),
        (read_positions, ["x", "y"], [[1, 2]], "no point cloud: missing properties z"),
        (read_positions, ["x", "y", "z"], [], "has no points"),
    ],
)  # fmt: skip
def test_values_that_are_none_of_these_are_refused(
    tmp_path: Path, read: Callable[[Path], object], names: list[str], rows: list[list[object]], message: str
) -> None:
    expect_refusal(message, read, ascii_ply(tmp_path / "a.ply", names, rows))


def test_ascii_with_a_line_missing_is_refused(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", MINIMAL, [GOOD] * 3)
    path.write_text(path.read_text().replace("element vertex 3", "element vertex 4"))
    expect_refusal("expected 4 lines of data, got 3", read_ply, path)


def test_open3d_finds_the_same_values(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed: its reader was not compared")
    gaussians = gaussian_set(30)
    write_gaussian_ply(tmp_path / "a.ply", gaussians, {})
    points = open3d.t.io.read_point_cloud(str(tmp_path / "a.ply")).point
    harmonics = {"f_dc": gaussians.harmonics[:, 0], "f_rest": gaussians.harmonics[:, 1:]}
    for name, values in {"positions": gaussians.centers, "rot": gaussians.quats_wxyz, **harmonics}.items():
        assert np.array_equal(points[name].numpy(), values), name
    np.testing.assert_allclose(points["scale"].numpy(), gaussians.scales, rtol=1e-6)


def test_points_are_read_in_metres_with_colours_from_0_to_1_and_faces_make_a_mesh(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", COLOURED, [[1000, 2, 3, 255, 0, 51], [4, 5, 6, 0, 255, 0]])
    cloud = read_points(path)
    assert np.array_equal(cloud.points, np.float32([[1000, 2, 3], [4, 5, 6]]))
    assert cloud.colors == pytest.approx(np.array([[1, 0, 0.2], [0, 1, 0]]))
    assert read_positions(path).tolist() == [[1000, 2, 3], [4, 5, 6]]
    assert read_positions(ascii_ply(tmp_path / "b.ply", ["x", "y", "z"], [[1, 2, 3]])).tolist() == [[1, 2, 3]]
    text = path.read_text()
    for num in (0, 3):
        path.write_text(text.replace("end_header", f"element face {num}\nend_header"))
        assert is_mesh(path) == (num > 0)
    assert is_mesh(tmp_path / "a.obj")
