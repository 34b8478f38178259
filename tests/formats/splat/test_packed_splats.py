"""Splats of 32 bytes and `.spz`: the bytes of one Gaussian, files of other tools, and what is refused."""

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.splat.packed_splats import read_splat, read_spz, spz_bound, write_splat, write_spz
from splatctrl_cli.formats.splat.splat_format import differences
from tests.formats.splat.test_gaussian_ply import gaussian_set

ROW = struct.Struct("<6f8B")


def test_one_gaussian_has_the_32_bytes_that_viewers_expect(tmp_path: Path) -> None:
    one = replace(
        gaussian_set(1),
        centers=np.array([[1, 2, 3]], np.float32),
        scales=np.array([[0.01, 0.02, 0.03]], np.float32),
        quats_wxyz=np.array([[0.5, 0.5, -0.5, 0.5]], np.float32),
        opacities=np.array([0.4], np.float32),
        harmonics=np.array([[[0.0, 0.5 / 0.28209479, -0.3 / 0.28209479]]], np.float32),
    )
    write_splat(tmp_path / "a.splat", one, {})
    row = ROW.unpack((tmp_path / "a.splat").read_bytes())
    np.testing.assert_allclose(row[:6], [1, 2, 3, 0.01, 0.02, 0.03], rtol=1e-6)
    assert row[6:10] == (128, 255, 51, 102)  # 0.5 rounds to even
    assert row[10:] == (64, 64, 192, 64)  # the same rotation, its first component negative


def test_no_rotation_is_exact(tmp_path: Path) -> None:
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1))
    write_splat(tmp_path / "a.splat", replace(gaussian_set(3), quats_wxyz=quats), {})
    assert np.array_equal(np.abs(read_splat(tmp_path / "a.splat")[0].quats_wxyz), quats)


def test_a_file_of_another_tool_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(ROW.pack(1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 255, 255, 128, 128, 128) * 2)
    g, comments = read_splat(tmp_path / "a.splat")
    assert (len(g), comments) == (2, {})
    np.testing.assert_allclose(g.quats_wxyz[0], [1, 0, 0, 0])
    np.testing.assert_allclose(0.5 + 0.28209479 * g.harmonics[0, 0], [1, 0, 0.2], atol=1e-6)
    assert g.opacities[0] == 1


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (ROW.pack(0, float("nan"), 0, 1, 1, 1, *[200] * 8), "splat 1: center: expected finite"),
        (ROW.pack(0, 0, 0, 1, -1, 1, *[200] * 8), "splat 1: sigma: expected more than 0 m"),
        (ROW.pack(0, 0, 0, 1, 1, 1, *[128] * 8), "splat 1: rotation: expected a quaternion that is not zero"),
        (b"tail", "expected a multiple of 32 bytes, one row per splat, got 36"),
    ],
)
def test_rows_that_are_no_gaussians_are_refused(tmp_path: Path, row: bytes, message: str) -> None:
    good = ROW.pack(0, 0, 0, 1, 1, 1, *[200] * 8)
    (tmp_path / "a.splat").write_bytes(good + row)
    with pytest.raises(InputError, match=message):
        read_splat(tmp_path / "a.splat")


HEADER = struct.Struct("<IIIBBBB")
MAGIC = 0x5053474E


def packed(path: Path, *parts: bytes) -> Path:
    path.write_bytes(gzip.compress(b"".join(parts)))
    return path


def test_one_gaussian_has_the_bytes_of_version_3(tmp_path: Path) -> None:
    harmonics = np.zeros((1, 4, 3), np.float32)
    harmonics[0, 0] = [0.0, 1.0, -1.0]
    harmonics[0, 1:] = np.array([[0.5, -0.5, 0.25], [0, 0, 0], [-1, 0.125, 0]])
    one = replace(
        gaussian_set(1),
        centers=np.array([[1, -2, 0.25]], np.float32),
        scales=np.exp(np.array([[-4, -5, -6]])).astype(np.float32),
        quats_wxyz=np.array([[-0.3, 0.8, 0.4, np.sqrt(0.11)]], np.float32),  # x is largest
        opacities=np.array([0.2], np.float32),
        harmonics=harmonics,
    )
    write_spz(tmp_path / "a.spz", one, {})
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert HEADER.unpack_from(content) == (MAGIC, 3, 1, 1, 12, 0, 0)
    body = content[HEADER.size :]
    assert body[:9] == b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (1, -2, 0.25))
    assert body[9] == 51
    assert list(body[10:13]) == [128, 166, 89]  # 38.25 f_dc + 127.5
    assert list(body[13:16]) == [96, 80, 64]
    word = int.from_bytes(body[16:20], "little")
    assert word >> 30 == 0  # x y z w
    assert [word >> shift & 0x3FF for shift in (20, 10, 0)] == [289, 240, 512 + 217]  # y, z, w; 511 is sqrt(1/2)
    assert list(body[20:]) == [192, 64, 160, 128, 128, 128, 0, 144, 128]


def test_files_of_version_2_are_read(tmp_path: Path) -> None:
    centers = b"".join(value.to_bytes(3, "little", signed=True) for value in (256, -512, 3))
    body = [centers, bytes([255]), bytes([127, 128, 0]), bytes([160, 0, 255]), bytes([128, 128, 218])]
    g, _ = read_spz(packed(tmp_path / "a.spz", HEADER.pack(MAGIC, 2, 1, 0, 8, 1, 0), *body))
    np.testing.assert_allclose(g.centers, [[1, -2, 3 / 256]])
    np.testing.assert_allclose(g.scales, np.exp([[0, -10, 255 / 16 - 10]]), rtol=1e-6)
    x, z = 128 / 127.5 - 1, 218 / 127.5 - 1
    np.testing.assert_allclose(g.quats_wxyz, [[np.sqrt(1 - 2 * x * x - z * z), x, x, z]], rtol=1e-6)
    np.testing.assert_allclose(g.harmonics[0, 0], (np.array([127, 128, 0]) / 255 - 0.5) / 0.15, rtol=1e-6)


@pytest.mark.parametrize("index", [0, 1, 2, 3])
@pytest.mark.parametrize("sign", [-1, 1])
def test_every_largest_component_and_sign_keeps_its_rotation(tmp_path: Path, index: int, sign: int) -> None:
    rng = np.random.default_rng(index)
    quats = rng.uniform(-0.9, 0.9, (200, 4))
    quats[:, index] = sign
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    gaussians = replace(gaussian_set(200), quats_wxyz=quats.astype(np.float32))
    write_spz(tmp_path / "a.spz", gaussians, {})
    assert differences(gaussians, read_spz(tmp_path / "a.spz")[0]).rotation <= spz_bound(gaussians).rotation


def test_what_is_farther_than_2_km_is_held_in_larger_steps(tmp_path: Path) -> None:
    gaussians = gaussian_set(50)
    gaussians.centers[7] = [3000.0, -5000.0, 1.0]
    write_spz(tmp_path / "a.spz", gaussians, {})
    bound = spz_bound(gaussians)
    assert bound.center == pytest.approx(0.5 / 1024, rel=1e-3)
    assert differences(gaussians, read_spz(tmp_path / "a.spz")[0]).center <= bound.center


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ((MAGIC, 4, 0, 0, 12, 0, 0), ".spz version: expected 2 or 3 in gzip and 4 in plain, got 4"),
        ((MAGIC, 3, 0, 4, 12, 0, 0), "expected degree 0 to 3"),
        ((MAGIC, 3, 0, 0, 12, 2, 0), "has vendor extensions"),
        ((MAGIC, 3, 1, 0, 12, 0, 0), "expected 20 bytes for 1 splats, got 0"),
        ((7, 3, 0, 0, 12, 0, 0), "no .spz file: expected it to start with 0x5053474e"),
    ],
)
def test_what_is_no_file_of_these_versions_is_refused(tmp_path: Path, header: tuple[int, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_spz(packed(tmp_path / "a.spz", HEADER.pack(*header)))
