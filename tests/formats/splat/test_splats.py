"""3D-GS PLY files: what is written, what is read back, what is refused."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.splat.gaussian_ply import read_gaussian_ply
from splatctrl_cli.formats.splat.splats import DTYPE, read_ply, write_ply
from splatctrl_cli.records import Label, SplatSet
from tests.formats.splat.test_gaussian_ply import ascii_ply, assert_equal_bits
from tests.plain import plain_splats

MINIMAL = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
STANDARD = [*MINIMAL[:3], "nx", "ny", "nz", *MINIMAL[3:], "rot_0", "rot_1", "rot_2", "rot_3"]


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


def header_of(path: Path) -> list[str]:
    return path.read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()


def test_what_is_written_reads_back_within_float32_and_then_bit_for_bit(tmp_path: Path) -> None:
    splats = splat_set(2000)
    write_ply(tmp_path / "a.ply", splats, {})
    first, _ = read_ply(tmp_path / "a.ply")
    assert np.array_equal(first.centers, splats.centers)
    assert np.array_equal(first.labels, splats.labels)
    assert np.array_equal(first.density, splats.density)
    np.testing.assert_allclose(first.radii, splats.radii, rtol=1e-6)
    np.testing.assert_allclose(first.opacities, splats.opacities, rtol=1e-6)
    np.testing.assert_allclose(first.colors, splats.colors, atol=1e-7)
    write_ply(tmp_path / "b.ply", first, {})
    assert_equal_bits(read_ply(tmp_path / "b.ply")[0], first)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_the_header_has_the_standard_properties_in_the_reference_order(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", splat_set(3), {"source": "run 7"})
    lines = header_of(tmp_path / "a.ply")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines if line.startswith("property")] == [
        *(f"property float {name}" for name in STANDARD),
        "property uchar label",
        "property float density",
    ]
    assert "comment frame: world" in lines
    assert "comment units: metre" in lines
    assert "comment source: run 7" in lines


def test_one_splat_has_the_bytes_a_stock_viewer_expects(tmp_path: Path) -> None:
    one = plain_splats([1, 2, 3], 0.01, colors=[0.5, 1.0, 0.0], opacities=0.5, labels=Label.HUMAN)
    one = replace(one, density=np.array([7.0], np.float32))
    write_ply(tmp_path / "a.ply", one, {})
    body = tmp_path.joinpath("a.ply").read_bytes().split(b"end_header\n")[1]
    values = struct.unpack("<17fBf", body)
    half = 0.5 / 0.28209479177387814
    expected = [1, 2, 3, 0, 0, 0, 0, half, -half, 0, *[np.log(0.01)] * 3, 1, 0, 0, 0, 2, 7]
    np.testing.assert_allclose(values, expected, rtol=1e-6)


def test_opacities_of_exactly_0_and_1_are_finite_logits_and_read_back_exactly(tmp_path: Path) -> None:
    edges = np.array([0.0, 1.0, np.nextafter(np.float32(1), np.float32(0)), 1e-30], np.float32)
    write_ply(tmp_path / "a.ply", replace(splat_set(4), opacities=edges), {})
    rows = np.frombuffer(tmp_path.joinpath("a.ply").read_bytes().split(b"end_header\n")[1], DTYPE)
    assert np.isfinite(rows["opacity"]).all()
    back = read_ply(tmp_path / "a.ply")[0].opacities
    assert back[:3].tolist() == edges[:3].tolist()
    assert back[3] == pytest.approx(1e-30, rel=1e-5)


def test_an_empty_set_is_a_file(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", splat_set(5).select(np.zeros(5, dtype=bool)), {})
    assert len(read_ply(tmp_path / "a.ply")[0]) == len(read_gaussian_ply(tmp_path / "a.ply")[0]) == 0


def test_comments_come_back(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", splat_set(1), {"scene": "C: and more", "note": "", "place": "Zürich"})
    comments = read_ply(tmp_path / "a.ply")[1]
    assert comments["scene"] == "C: and more"
    assert comments["note"] == ""
    assert comments["place"] == "Z\\xfcrich"
    assert comments["frame"] == "world"


@pytest.mark.parametrize("comments", [{"a": "two\nlines"}, {"a:b": "c"}, {"": "c"}])
def test_a_comment_that_would_break_the_header_is_refused(tmp_path: Path, comments: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="comment"):
        write_ply(tmp_path / "a.ply", splat_set(1), comments)
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radii": [0.01, np.nan, 0.01]}, r"splat 1: radius: expected finite, got nan"),
        ({"radii": [0.01, 0.01, 0.0]}, r"splat 2: radius: expected more than 0 m, got 0"),
        ({"opacities": [0.5, 1.01, 0.5]}, r"splat 1: opacity: expected 0 to 1, got 1.01"),
        ({"opacities": [-0.1, 0.5, 0.5]}, r"splat 0: opacity: expected 0 to 1, got -0.1"),
        ({"density": [0.0, 0.0, np.inf]}, r"splat 2: density: expected finite"),
        ({"density": [0.0, 0.0]}, r"density: expected 3 values, got 2"),
    ],
)
def test_a_set_that_the_format_cannot_hold_is_refused(
    tmp_path: Path, change: dict[str, list[float]], message: str
) -> None:
    splats = replace(splat_set(3), **{name: np.array(values, np.float32) for name, values in change.items()})
    with pytest.raises(InputError, match=message):
        write_ply(tmp_path / "a.ply", splats, {})
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
    with pytest.raises(InputError, match=rf"a\.ply: .*{message}"):
        read_ply(path)
    path.unlink()
    with pytest.raises(InputError, match=r"a\.ply: cannot be read: No such file"):
        read_ply(path)


def test_ascii_in_any_order_with_extra_properties_reads_the_same(tmp_path: Path) -> None:
    names = ["confidence", *reversed(MINIMAL)]
    row: list[object] = [0.25, -4, -4, -4, 0, 0.1, 0.2, 0.3, 3, 2, 1]
    path = ascii_ply(tmp_path / "a.ply", names, [row, row])
    path.write_text(path.read_text().replace("ascii 1.0\n", "ascii 1.0\ncomment made by hand\n"))
    splats, comments = read_ply(path)
    np.testing.assert_allclose(splats.centers, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(splats.radii, np.exp(-4), rtol=1e-6)
    np.testing.assert_allclose(splats.colors[0], 0.5 + 0.28209479 * np.array([0.3, 0.2, 0.1]), rtol=1e-6)
    assert splats.opacities.tolist() == [0.5, 0.5]
    assert splats.labels.tolist() == [Label.OBJECT] * 2
    assert splats.density.tolist() == [0, 0]
    assert comments == {"made by hand": ""}


def test_big_endian_doubles_and_other_elements_read_the_same(tmp_path: Path) -> None:
    header = ["ply", "format binary_big_endian 1.0", "element camera 1", "property int id", "element vertex 1"]
    header += [f"property double {name}" for name in MINIMAL] + ["end_header", ""]
    values = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, -4.0, -4.0, -4.0]
    (tmp_path / "a.ply").write_bytes("\r\n".join(header).encode() + struct.pack(">i10d", 5, *values))
    assert read_ply(tmp_path / "a.ply")[0].centers.tolist() == [[1, 2, 3]]


GOOD: list[object] = [0, 0, 0, 0, 0, 0, 0, -4, -4, -4]


@pytest.mark.parametrize(
    ("names", "rows", "message"),
    [
        (MINIMAL[:6], [[0] * 6], r"missing properties opacity scale_0 \(it has x y z f_dc_0"),
        (MINIMAL, [GOOD, *[[*GOOD[:9], -6]] * 2], r"expected isotropic splats .* got 2 of 3 whose scales differ"),
        (MINIMAL, [GOOD, ["nan", *GOOD[1:]]], "splat 1: x: expected a finite number, got nan"),
        (MINIMAL, [GOOD, [*GOOD[:8], "nan", -4]], "splat 1: scale_1: expected a finite number, got nan"),
        (MINIMAL, [[*GOOD[:7], *[-200] * 3]], "splat 0: scale_0: expected a radius that float32 holds"),
        (MINIMAL, [[*GOOD[:7], *[200] * 3]], "splat 0: scale_0: expected a radius that float32 holds"),
        ([*MINIMAL, "label"], [[*GOOD, 1.5]], "splat 0: label: expected a whole number 0 to 255, got 1.5"),
        (MINIMAL, [GOOD[:9]], "vertex 0: expected 10 numbers, got 9"),
        (MINIMAL, [[*GOOD[:9], "four"]], "property scale_2: could not convert"),
    ],
)
def test_values_that_are_no_round_splats_are_refused(
    tmp_path: Path, names: list[str], rows: list[list[object]], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        read_ply(ascii_ply(tmp_path / "a.ply", names, rows))


def test_ascii_with_a_line_missing_is_refused(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", MINIMAL, [GOOD] * 3)
    path.write_text(path.read_text().replace("element vertex 3", "element vertex 4"))
    with pytest.raises(InputError, match="expected 4 lines of data, got 3"):
        read_ply(path)
