"""Image messages: encodings, byte order, row step."""

import struct
import zlib
from functools import partial
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.formats.image_file import decode_file
from splatctrl_cli.recording.log.decoder import COMPRESSED_IMAGE, IMAGE, UndecodableMessageError
from splatctrl_cli.recording.log.messages import ImageMessage, color_of, depth_of, num_invalid, read_image
from tests.formats.test_image_file import png_chunk
from tests.recording.log.make_log import header, image

RGB = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)

BGR = RGB[..., ::-1]
COUNTS = np.array([[0, 1, 500], [1000, 40000, 65534]], dtype=np.uint16)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", BGR),
        ("rgba8", np.dstack([RGB, RGB[..., 0]])),
        ("bgra8", np.dstack([BGR, RGB[..., 0]])),
        ("mono8", RGB[..., 1]),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_color_encodings_give_the_same_rgb(encoding: str, pixels: np.ndarray[Any, Any], padding: int) -> None:
    read = of_image(encoding, pixels, padding=padding)
    assert (read.kind, of_image("p010", pixels).kind) == ("color", "other")
    assert np.array_equal(color_of(read), np.repeat(RGB[..., 1:2], 3, axis=2) if encoding == "mono8" else RGB)


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 4])
def test_integer_depth_is_millimetres_in_either_byte_order(encoding: str, big: bool, padding: int) -> None:
    read = of_image(encoding, COUNTS, big=big, padding=padding)
    assert (read.kind, depth_of(read, None)) == ("depth", pytest.approx(COUNTS * 1e-3, rel=1e-6))
    assert depth_of(read, 1e-4) == pytest.approx(COUNTS * 1e-4, rel=1e-6)


def test_float_depth_is_metres_and_what_was_not_measured_is_zero() -> None:
    values, wanted = np.float32([[1.5, np.nan], [np.inf, -2.0]]), np.float32([[1.5, 0], [0, 0]])
    read = of_image("32FC1", values)
    assert np.array_equal(depth_of(read, None), wanted) and np.array_equal(depth_of(read, 0.5), wanted / 2)
    tiff = of_file("32FC1; tiff compressed ", packed(".tiff", np.where(np.isfinite(values), values, 0)))
    assert (tiff.kind, tiff.compressed, depth_of(tiff, None).tolist()) == ("depth", None, wanted.tolist())
    counts = np.uint16([[1000, 65535], [0, 65534]])  # a D415 and an OAK write 65535 where they measured nothing
    assert depth_of(of_image("16UC1", counts), None) == pytest.approx(np.float32([[1, 0], [0, 65.534]]), rel=1e-6)
    assert num_invalid(counts) == 1


@pytest.mark.parametrize(("suffix", "error"), [("png", 0), ("jpeg", 1), ("webp", 0)])
def test_compressed_color_keeps_its_bytes_and_is_refused_where_it_is_cut(suffix: str, error: int) -> None:
    rgb = np.full((16, 16, 3), (200, 60, 20), dtype=np.uint8)  # one colour comes back from JPEG
    data = packed(
        f".{suffix}", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), *(cv2.IMWRITE_WEBP_QUALITY, 101) * (suffix == "webp")
    )
    read = of_file(suffix, data)
    assert read.kind == "color" and read.compressed == bytes(data)
    assert np.abs(color_of(read).astype(int) - rgb).max() <= error
    for length in (len(data) * 3 // 4, len(data) - 4):
        with pytest.raises(UndecodableMessageError, match="not an image file"):  # not filled with grey
            of_file(suffix, data[:length])


def mosaic(rgb: tuple[int, int, int], pattern: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """8x8 pixels of one colour, of which each tells only one channel."""
    values = dict(zip("RGB", rgb, strict=True))
    return np.tile(np.array([values[letter] for letter in pattern], np.uint8).reshape(2, 2), (4, 4))


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GBRG", "GRBG"])
def test_a_bayer_mosaic_of_one_colour_is_that_colour(pattern: str) -> None:
    pixels, form = mosaic((200, 100, 30), pattern), f"bayer_{pattern.lower()}"
    for bits, deep in ((8, pixels), (16, pixels.astype(np.uint16) * 257)):
        recorded = of_image(f"{form}{bits}", deep, padding=4)
        assert recorded.kind == "color"
        in_files = partial(of_file, f"{form}{bits}; png compressed {form}{bits}", packed(".png", deep))
        for read in (recorded, in_files(lazily=False), in_files(lazily=True)):
            assert (color_of(read)[2:-2, 2:-2] == [200, 100, 30]).all() and read.compressed is None


DEEP = RGB.astype(np.uint16) * 257


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb16", DEEP),
        ("bgr16", DEEP[..., ::-1]),
        ("16UC3", DEEP[..., ::-1]),
        ("rgba16", np.dstack([DEEP, DEEP[..., 0]])),
        ("bgra16", np.dstack([DEEP[..., ::-1], DEEP[..., 0]])),
    ],
)
@pytest.mark.parametrize("big", [False, True])
def test_colour_of_sixteen_bits_becomes_eight(encoding: str, pixels: np.ndarray[Any, Any], big: bool) -> None:
    read = of_image(encoding, pixels, big=big, padding=2)
    assert read.kind == "color" and np.array_equal(color_of(read), RGB)
    half = of_image(encoding, pixels - (pixels > 300).astype(np.uint16) * 100, big=big)
    assert np.array_equal(color_of(half), RGB)  # rounded, not cut


Y, U, V = 120, 90, 170  # BT.601, video range

EXPECTED = np.array([1.164 * (Y - 16) + 1.596 * (V - 128), 1.164 * (Y - 16) - 0.813 * (V - 128) - 0.391 * (U - 128)])


@pytest.mark.parametrize(
    ("encoding", "four"),
    [("yuv422", (U, Y, V, Y)), ("uyvy", (U, Y, V, Y)), ("yuv422_yuy2", (Y, U, Y, V)), ("yuyv", (Y, U, Y, V))],
)
def test_yuv_422_is_read_in_either_order(encoding: str, four: tuple[int, ...]) -> None:
    rgb = color_of(of_image(encoding, np.tile(np.array(four, np.uint8).reshape(1, 2, 2), (4, 3, 1)), padding=2))
    assert rgb[..., :2] == pytest.approx(np.broadcast_to(EXPECTED, (4, 6, 2)), abs=1.5)


@pytest.mark.parametrize(
    ("encoding", "pair", "num_rows", "padding"),
    [
        *((*form, padding) for form in (("nv12", (U, V), 6), ("nv21", (V, U), 6)) for padding in (0, 2)),
        ("nv24", (U, V), 12, 0),  # colour for every pixel
    ],
)
def test_planar_yuv_is_read_with_the_rows_of_colour_behind_those_of_grey(
    encoding: str, pair: tuple[int, int], num_rows: int, padding: int
) -> None:
    rows = np.full((num_rows, 6), Y, np.uint8)
    rows[4:] = np.tile(np.array(pair, np.uint8), 3)
    planar = image(5, "optical", encoding, rows, padding=padding)
    planar.height = 4
    read = read_image(planar, IMAGE)
    assert (read.width, read.height, read.kind) == (6, 4, "color")
    assert color_of(read)[..., :2] == pytest.approx(np.broadcast_to(EXPECTED, (4, 6, 2)), abs=1.5)
    planar.data = planar.data[: -1 - padding]
    with pytest.raises(UndecodableMessageError, match="do not hold it"):
        read_image(planar, IMAGE)


@pytest.mark.parametrize("lazily", [False, True])
def test_float_depth_of_the_compressed_transport_is_inverse_depth(lazily: bool) -> None:
    depth = np.where(COUNTS > 2, 100.0 / (COUNTS.astype(np.float64) - 2.0), 0)
    data = struct.pack("<iff", 0, 100.0, 2.0) + packed(".png", COUNTS).tobytes()
    read = of_file("32FC1; compressedDepth png", data, lazily=lazily)
    assert (depth_of(read, None), read.compressed) == (
        pytest.approx(depth, rel=1e-6),
        None,
    )  # its counts are no depth


FORMS = [  # of image_transport's plugins, as the distributions write them, and of drivers
    ("jpeg", ".jpg", "color"),
    ("png", ".png", "color"),
    ("bgr8; jpeg compressed bgr8", ".jpg", "color"),
    ("rgb8; jpeg compressed bgr8", ".jpg", "color"),
    ("rgb8; png compressed ", ".png", "color"),
    ("rgba8; png compressed rgba8", ".png", "color"),
    ("mono8; jpeg compressed ", ".jpg", "color"),
    ("16UC1; png compressed ", ".png", "depth"),
    ("16UC1; png compressed", ".png", "depth"),
    ("16UC1; png", ".png", "depth"),
    ("mono16; png compressed mono16", ".png", "depth"),
    ("png", ".png", "depth"),
    ("16UC1; compressedDepth", ".png", "transport"),
    ("16UC1; compressedDepth png", ".png", "transport"),
    ("mono16; compressedDepth png", ".png", "transport"),
]


@pytest.mark.parametrize(("form", "suffix", "kind"), FORMS)
@pytest.mark.parametrize("lazily", [False, True])
def test_every_form_of_a_compressed_image_is_told_apart(form: str, suffix: str, kind: str, lazily: bool) -> None:
    data = packed(suffix, BGR if kind == "color" else COUNTS).tobytes()
    read = of_file(form, bytes(12) + data if kind == "transport" else data, lazily=lazily)
    assert read.kind == ("color" if kind == "color" else "depth")
    if kind != "color":
        assert np.array_equal(depth_of(read, None), COUNTS.astype(np.float32) * np.float32(1e-3))
    elif suffix == ".png":
        assert np.array_equal(color_of(read), RGB)


@pytest.mark.parametrize("lazily", [False, True])
def test_colour_png_of_sixteen_bits_or_with_alpha_keeps_bytes_that_decode_alike(lazily: bool) -> None:
    for pixels in (DEEP[..., ::-1], np.dstack([BGR, RGB[..., 0]])):
        read = of_file("png", packed(".png", pixels), lazily=lazily)
        assert np.array_equal(color_of(read), RGB) and read.compressed is not None
        assert np.array_equal(np.asarray(decode_file(read.compressed, color=True)), RGB)
    with pytest.raises(UndecodableMessageError, match="pixels of float64, neither colour nor depth"):
        of_file("64FC1; tiff compressed ", packed(".tiff", np.ones((4, 4), np.float64)), lazily=lazily)


def with_orientation(jpeg: bytes) -> bytes:
    """With an EXIF segment that says: turn by 90 degrees (6)."""
    tiff = b"II*\x00" + struct.pack("<IH", 8, 1) + struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0) + bytes(4)
    exif = b"Exif\x00\x00" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


@pytest.mark.parametrize("color", [False, True])
def test_a_turned_camera_keeps_the_pixels_that_its_lens_is_of(color: bool) -> None:
    """OpenCV alone would turn the image, and with it leave the intrinsics behind."""
    jpeg = with_orientation(bytes(cv2.imencode(".jpg", RGB)[1]))
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (6, 4, 3)
    assert decode_file(jpeg, color=color).shape == (4, 6, 3)


def test_a_png_that_announces_more_than_its_bytes_unpack_to_is_refused_before_memory_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    png = bytes(cv2.imencode(".png", np.zeros((64, 64), np.uint16))[1])
    assert decode_file(png, color=False) is not None  # a flat image, packed as well as can be
    head = struct.pack(">II", 30_000, 30_000) + png[24:29]
    bomb = png[:8] + png_chunk(b"IHDR", head) + png[33:]
    assert decode_file(png + b"behind the end", color=False) is not None
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    assert decode_file(bomb, color=False) is None and decode_file(png[:20] + png[-12:], color=False) is None
    assert decode_file(png[:33] + b"\x7f" + png[34:], color=False) is None  # a chunk of two gigabytes


@pytest.mark.parametrize("lazily", [False, True])
def test_a_png_with_a_palette_a_gamma_or_interlaced_rows_has_the_values_that_are_written(lazily: bool) -> None:
    """Six colours of a row; a gamma says how to show them, not what was measured. Adam7's seven passes of one row are
    its first, fifth, third, and the even pixels.
    """

    def png(colors: int, passes: int, data: bytes, *more: bytes) -> bytes:
        head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 6, 1, 8, colors, 0, 0, passes))
        parts = (head, *more, png_chunk(b"IDAT", zlib.compress(data)), png_chunk(b"IEND", b""))
        return b"\x89PNG\r\n\x1a\n" + b"".join(parts)

    rows = [RGB[0, columns].tobytes() for columns in ([0], [4], [2], [1, 3, 5])]
    for data in (
        png(3, 0, bytes([0, *range(6)]), png_chunk(b"PLTE", RGB[0].tobytes())),
        png(2, 0, b"\0" + RGB[0].tobytes(), png_chunk(b"gAMA", struct.pack(">I", 100_000))),
        png(2, 1, b"".join(b"\0" + row for row in rows)),
    ):
        assert np.array_equal(color_of(of_file("png", data, lazily=lazily)), RGB[:1])


def of_image(encoding: str, pixels: np.ndarray[Any, Any], **odd: Any) -> ImageMessage:
    """A message of pixels, as it is read."""
    return read_image(image(5, "optical", encoding, pixels, **odd), IMAGE)


def of_file(form: str, data: np.ndarray[Any, Any] | bytes, *, lazily: bool = False) -> ImageMessage:
    """A message of an image file, as it is read."""
    data = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data
    return read_image(SimpleNamespace(header=header(5, "o"), format=form, data=data), COMPRESSED_IMAGE, lazily=lazily)


def packed(suffix: str, pixels: np.ndarray[Any, Any], *flags: int) -> np.ndarray[Any, Any]:
    return cv2.imencode(suffix, pixels, flags)[1].ravel()
