"""``.splat`` files: the bytes, and what is refused."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.splat.packed_splats import read_splat, write_splat
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
