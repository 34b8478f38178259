"""Heads of JPEG and PNG files against what OpenCV decodes, files that are not whole or not plain, and float maps;
files that are no mesh; and points of a CSV file, each thing that is wrong by its line.
"""

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.formats import ply
from splatctrl_cli.formats.image_file import ImageHead, decode_file, image_head, read_pfm
from splatctrl_cli.formats.mesh import load_mesh
from splatctrl_cli.formats.ply import point_blocks
from tests.refused import expect_refusal

RNG = np.random.default_rng(3)

COLOR = RNG.integers(0, 256, (7, 11, 3), dtype=np.uint8)

GREY, DEPTH = COLOR[..., 0], RNG.integers(0, 65536, (7, 11), dtype=np.uint16)


def encoded(suffix: str, pixels: np.ndarray, *options: int) -> bytes:
    return bytes(cv2.imencode(suffix, pixels, list(options))[1])


def png_chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


@pytest.mark.parametrize(
    ("data", "channels", "bits"),
    [
        (encoded(".jpg", COLOR), 3, 8),
        (encoded(".jpg", COLOR, cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 1), 3, 8),
        (encoded(".jpg", GREY), 1, 8),
        (encoded(".jpg", COLOR) + bytes(8), 3, 8),
        (encoded(".png", COLOR), 3, 8),
        (encoded(".png", GREY), 1, 8),
        (encoded(".png", DEPTH), 1, 16),
    ],
)
def test_the_head_of_a_plain_file_is_that_of_its_pixels(data: bytes, channels: int, bits: int) -> None:
    assert image_head(data) == ImageHead(width=11, height=7, channels=channels, bits=bits)
    pixels = decode_file(data, color=channels == 3)
    assert pixels.shape == ((7, 11, 3) if channels == 3 else (7, 11))
    assert pixels.itemsize * 8 == bits


NO_SIZE = [
    b"\x89PNG\r\n\x1a\n"
    + png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    + png_chunk(b"IDAT", zlib.compress(bytes(8)))
    + png_chunk(b"IEND", b"")
    for width, height in ((0, 4), (1 << 20, 1 << 20))
]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8\xff",
        encoded(".webp", COLOR),
        encoded(".png", np.dstack([COLOR, GREY])),
        encoded(".png", COLOR).replace(b"IEND", b"iEND"),
        encoded(".jpg", COLOR).replace(b"\xff\xc0\x00\x11\x08", b"\xff\xc0\x00\x11\x0c"),
        encoded(".jpg", COLOR).replace(b"\xff\xc0", b"\xff\xc9"),
        *NO_SIZE,
    ],
    ids=["nothing", "a mark", "WebP", "alpha", "no end", "12 bits", "arithmetic", "no size", "an absurd size"],
)
def test_what_is_not_plain_is_left_to_the_decoder(data: bytes) -> None:
    assert image_head(data) is None


def test_a_file_cut_anywhere_or_a_png_with_any_byte_changed_is_not_whole() -> None:
    for suffix, end in ((".jpg", 2), (".png", 4)):  # a PNG's last checksum is that of an empty chunk
        data = encoded(suffix, COLOR)
        assert all(image_head(data[:length]) is None for length in range(len(data) - end + 1))
    data = encoded(".png", DEPTH)
    for at in range(len(data)):
        assert image_head(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]) is None, at


@pytest.mark.parametrize("is_little", [True, False])
def test_pfm_of_either_byte_order_starts_at_the_bottom_row(tmp_path: Path, is_little: bool) -> None:
    rows = np.array([[3, 4], [1, 2]], dtype="<f4" if is_little else ">f4")
    (tmp_path / "a.pfm").write_bytes(f"Pf\n2 2\n{'-1.0' if is_little else '1'}\n".encode() + rows.tobytes())
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P6\n2 2\n255\n", "expected a PFM image"),
        (b"PF\n2 2\n-1.0\n", "expected one channel"),
        (b"Pf\n2 2\n-2.5\n" + b"\0" * 16, "of scale 1, got Pf of scale -2.5"),
        (b"Pf\n2 2\n-1.0\n" + b"\0" * 15, "expected 16 bytes for 2x2, got 15"),
        (b"Pf\n0 " + b"8" * 55 + b"\n-1.0\n", "expected pixels, got 0x888"),
    ],
)
def test_damaged_pfm_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.pfm").write_bytes(content)
    expect_refusal(message, read_pfm, tmp_path / "a.pfm")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("gone.obj", None, "expected a mesh, got no such file"),
        ("words.stl", "nothing of the kind", "expected a mesh, got .*; give"),
        ("cloud.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "expected a mesh, got"),
        ("nan.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "expected finite vertices"),
    ],
)
def test_files_that_are_no_mesh_are_named(tmp_path: Path, name: str, text: str | None, said: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    expect_refusal(f"{name}: {said}", load_mesh, tmp_path / name)


def points_in(text: str) -> list[list[float]]:
    return [row for block in point_blocks(io.StringIO(text), "a.csv") for row in block.tolist()]


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3\n4,5,6\n",
        "x,y,z\n1,2,3\n\n4,5,6",
        "\ufeffx,y,z\r\n1,2,3\r\n4,5,6\r\n",
        'name, Z ,x,y\n"a, b",3,1,2\nc,6,4,5\n',
    ],
)
def test_columns_are_found_with_a_header_and_without(text: str) -> None:
    assert points_in(text) == [[1, 2, 3], [4, 5, 6]]


def test_a_table_comes_in_blocks_that_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "POINTS_PER_BLOCK", 4)
    blocks = [*point_blocks(io.StringIO("x,y,z\n" + "1,2,3\n" * 10), "a.csv")]
    assert [len(block) for block in blocks] == [4, 4, 2]
    assert all(block.dtype == np.float64 for block in blocks)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a.csv: has no points; give"),
        ("x,y,z\n", "a.csv: has a header and no points"),
        ("x,y\n1,2\n", "a.csv: no column z: expected a header with x, y and z, or three numbers a line, got 'x,y'"),
        ("x,y,z,x\n1,2,3,4\n", "a.csv: several columns x"),
        ("1,2\n3,4\n", "a.csv: no column x"),
        ("1,2,3,4\n", "three numbers a line, got '1,2,3,4'"),
        ("x,y,z\n1,2,3\n\n1,2\n", "a.csv: line 4: expected 3 columns, got 2"),
        ("1,2,3\n1,2,3,4\n", "a.csv: line 2: expected 3 columns, got 4"),
        ("1,2,3\n1,nan,3\n", "a.csv: line 2: column y: expected a finite number up to 1e+06 m, got 'nan'"),
        ("z,y,x\n1,2,inf\n", "a.csv: line 2: column x: expected a finite number"),
        ("x,y,z\n1,,3\n", "line 2: column y: expected a finite number up to 1e+06 m, got ''"),
        ("x,y,z\n1,2,3\n1,2,1e7\n", "line 3: column z"),
        ('x,y,z\n1,2,"' + "3" * 200_000 + '"\n', "line 2: no CSV text: field larger"),
    ],
)
def test_what_is_no_table_of_points_is_refused_by_its_line(text: str, said: str) -> None:
    expect_refusal(said, points_in, text)
