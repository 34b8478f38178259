"""Image messages: encodings, byte order, row step."""

import struct
import zlib
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.formats.image_file import decode_file
from splatctrl_cli.recording.log.decoder import COMPRESSED_IMAGE, IMAGE, UndecodableMessageError
from splatctrl_cli.recording.log.messages import color_of, depth_of, num_invalid, read_image
from tests.recording.log.make_log import header

RGB = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
COUNTS = np.array([[0, 1, 500], [1000, 40000, 65534]], dtype=np.uint16)


def message(pixels: np.ndarray[Any, Any], encoding: str, *, big: bool = False, padding: int = 0) -> SimpleNamespace:
    swapped = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    rows = np.frombuffer(swapped.tobytes(), np.uint8).reshape(pixels.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    return SimpleNamespace(
        header=header(5, "optical"),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.ravel(),
    )


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("rgba8", np.dstack([RGB, RGB[..., 0]])),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., 0]])),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_color_encodings_give_the_same_rgb(encoding: str, pixels: np.ndarray[Any, Any], padding: int) -> None:
    image = read_image(message(pixels, encoding, padding=padding), IMAGE)
    assert image.kind == "color"
    assert np.array_equal(color_of(image), RGB)


def test_grey_becomes_three_equal_channels() -> None:
    image = read_image(message(RGB[..., 1], "mono8"), IMAGE)
    assert np.array_equal(color_of(image), np.repeat(RGB[..., 1:2], 3, axis=2))


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 4])
def test_integer_depth_is_millimetres_in_either_byte_order(encoding: str, big: bool, padding: int) -> None:
    image = read_image(message(COUNTS, encoding, big=big, padding=padding), IMAGE)
    assert image.kind == "depth"
    assert depth_of(image, None) == pytest.approx(COUNTS * 1e-3, rel=1e-6)
    assert depth_of(image, 1e-4) == pytest.approx(COUNTS * 1e-4, rel=1e-6)


def test_float_depth_is_metres_and_what_was_not_measured_is_zero() -> None:
    values = np.array([[1.5, np.nan], [np.inf, -2.0]], dtype=np.float32)
    image = read_image(message(values, "32FC1"), IMAGE)
    assert np.array_equal(depth_of(image, None), np.array([[1.5, 0], [0, 0]], dtype=np.float32))
    assert np.array_equal(depth_of(image, 0.5), np.array([[0.75, 0], [0, 0]], dtype=np.float32))


@pytest.mark.parametrize(("suffix", "error"), [("png", 0), ("jpeg", 1)])
def test_compressed_color_keeps_its_bytes(suffix: str, error: int) -> None:
    rgb = np.full((16, 16, 3), (200, 60, 20), dtype=np.uint8)  # one colour comes back from JPEG
    data = cv2.imencode(f".{suffix}", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].ravel()
    image = read_image(SimpleNamespace(header=header(5, "o"), format=suffix, data=data), COMPRESSED_IMAGE)
    assert image.compressed == bytes(data)
    assert np.abs(color_of(image).astype(int) - rgb).max() <= error
    assert image.kind == "color"


def test_an_unknown_encoding_is_neither_color_nor_depth() -> None:
    assert read_image(message(RGB[..., 0], "p010"), IMAGE).kind == "other"


@pytest.mark.parametrize("suffix", ["png", "jpeg"])
def test_a_cut_image_is_refused_not_filled_with_grey(suffix: str) -> None:
    data = cv2.imencode(f".{suffix}", np.zeros((64, 64, 3), np.uint8) + RGB[0, 0])[1].ravel()
    cut = SimpleNamespace(header=header(5, "o"), format=suffix, data=data[: len(data) * 3 // 4])
    with pytest.raises(UndecodableMessageError, match="not an image file"):
        read_image(cut, COMPRESSED_IMAGE)


PATTERNS = {"rggb": "RGGB", "bggr": "BGGR", "gbrg": "GBRG", "grbg": "GRBG"}


def mosaic(rgb: tuple[int, int, int], pattern: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """8x8 pixels of one colour, of which each tells only one channel."""
    values = dict(zip("RGB", rgb, strict=True))
    first = [values[letter] for letter in pattern]
    return np.tile(np.array(first, np.uint8).reshape(2, 2), (4, 4))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_bayer_mosaic_of_one_colour_is_that_colour(pattern: str) -> None:
    pixels = mosaic((200, 100, 30), PATTERNS[pattern])
    for deep, encoding in ((pixels, f"bayer_{pattern}8"), (pixels.astype(np.uint16) * 257, f"bayer_{pattern}16")):
        image = read_image(message(deep, encoding, padding=4), IMAGE)
        assert image.kind == "color"
        assert (color_of(image)[2:-2, 2:-2] == [200, 100, 30]).all()


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
    image = read_image(message(pixels, encoding, big=big, padding=2), IMAGE)
    assert image.kind == "color"
    assert np.array_equal(color_of(image), RGB)
    half = read_image(message(pixels - (pixels > 300).astype(np.uint16) * 100, encoding, big=big), IMAGE)
    assert np.array_equal(color_of(half), RGB)  # rounded, not cut


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("lazily", [False, True])
def test_a_bayer_mosaic_in_an_image_file_is_interpolated_too(bits: int, lazily: bool) -> None:
    pixels = mosaic((200, 100, 30), "GRBG").astype(np.uint16) * (1 if bits == 8 else 257)
    data = cv2.imencode(".png", pixels.astype(f"u{bits // 8}"))[1].ravel()
    form = f"bayer_grbg{bits}; png compressed bayer_grbg{bits}"
    recorded = SimpleNamespace(header=header(5, "o"), format=form, data=data)
    image = read_image(recorded, COMPRESSED_IMAGE, lazily=lazily)
    assert (color_of(image)[2:-2, 2:-2] == [200, 100, 30]).all()
    assert image.compressed is None


Y, U, V = 120, 90, 170  # BT.601, video range
EXPECTED = np.array([1.164 * (Y - 16) + 1.596 * (V - 128), 1.164 * (Y - 16) - 0.813 * (V - 128) - 0.391 * (U - 128)])


@pytest.mark.parametrize(
    ("encoding", "four"),
    [("yuv422", (U, Y, V, Y)), ("uyvy", (U, Y, V, Y)), ("yuv422_yuy2", (Y, U, Y, V)), ("yuyv", (Y, U, Y, V))],
)
def test_yuv_422_is_read_in_either_order(encoding: str, four: tuple[int, ...]) -> None:
    pixels = np.tile(np.array(four, np.uint8).reshape(1, 2, 2), (4, 3, 1))
    rgb = color_of(read_image(message(pixels, encoding, padding=2), IMAGE))
    assert rgb.shape == (4, 6, 3)
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
    planar = message(rows, encoding, padding=padding)
    planar.height = 4
    image = read_image(planar, IMAGE)
    assert (image.width, image.height, image.kind) == (6, 4, "color")
    assert color_of(image)[..., :2] == pytest.approx(np.broadcast_to(EXPECTED, (4, 6, 2)), abs=1.5)
    planar.data = planar.data[: -1 - padding]
    with pytest.raises(UndecodableMessageError, match="do not hold it"):
        read_image(planar, IMAGE)


def test_webp_is_read_and_a_cut_one_refused() -> None:
    data = cv2.imencode(".webp", cv2.cvtColor(RGB, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, 101])[1].ravel()
    whole = SimpleNamespace(header=header(5, "o"), format="webp", data=data)
    assert np.array_equal(color_of(read_image(whole, COMPRESSED_IMAGE)), RGB)
    whole.data = data[:-4]
    with pytest.raises(UndecodableMessageError, match="not an image file"):
        read_image(whole, COMPRESSED_IMAGE)


@pytest.mark.parametrize("lazily", [False, True])
def test_float_depth_of_the_compressed_transport_is_inverse_depth(lazily: bool) -> None:
    a, b = 100.0, 2.0
    depth = np.where(COUNTS > 2, a / (COUNTS.astype(np.float64) - b), 0)
    png = cv2.imencode(".png", COUNTS)[1].tobytes()
    data = np.frombuffer(struct.pack("<iff", 0, a, b) + png, np.uint8)
    form = SimpleNamespace(header=header(5, "o"), format="32FC1; compressedDepth png", data=data)
    image = read_image(form, COMPRESSED_IMAGE, lazily=lazily)
    assert depth_of(image, None) == pytest.approx(depth, rel=1e-6)
    assert image.compressed is None  # its counts are no depth


def file_message(form: str, suffix: str, pixels: np.ndarray[Any, Any], flags: list[int] | None = None) -> Any:
    data = cv2.imencode(suffix, pixels, flags or [])[1].ravel()
    return SimpleNamespace(header=header(5, "o"), format=form, data=data)


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
    recorded = file_message(form, suffix, RGB[..., ::-1] if kind == "color" else COUNTS)
    if kind == "transport":
        recorded.data = np.concatenate([np.zeros(12, np.uint8), recorded.data])
    image = read_image(recorded, COMPRESSED_IMAGE, lazily=lazily)
    assert image.kind == ("color" if kind == "color" else "depth")
    if kind != "color":
        assert np.array_equal(depth_of(image, None), COUNTS.astype(np.float32) * np.float32(1e-3))
    elif suffix == ".png":
        assert np.array_equal(color_of(image), RGB)


def test_the_largest_count_is_no_depth() -> None:
    """A D415 and an OAK write 65535 where they measured nothing."""
    counts = np.array([[1000, 65535], [0, 65534]], np.uint16)
    image = read_image(message(counts, "16UC1"), IMAGE)
    assert depth_of(image, None) == pytest.approx(np.array([[1.0, 0.0], [0.0, 65.534]]), rel=1e-6)
    assert num_invalid(counts) == 1


def test_float_depth_in_a_tiff_is_metres() -> None:
    metres = np.array([[0.5, np.nan], [2.25, 0.0]], np.float32)
    image = read_image(file_message("32FC1; tiff compressed ", ".tiff", metres), COMPRESSED_IMAGE)
    assert image.kind == "depth" and image.compressed is None
    assert np.array_equal(depth_of(image, None), np.array([[0.5, 0], [2.25, 0]], np.float32))


@pytest.mark.parametrize("lazily", [False, True])
def test_colour_png_of_sixteen_bits_or_with_alpha_keeps_bytes_that_decode_alike(lazily: bool) -> None:
    for pixels in (DEEP[..., ::-1], np.dstack([RGB[..., ::-1], RGB[..., 0]])):
        image = read_image(file_message("png", ".png", pixels), COMPRESSED_IMAGE, lazily=lazily)
        assert np.array_equal(color_of(image), RGB)
        assert image.compressed is not None
        again = decode_file(image.compressed, color=True)
        assert again is not None and np.array_equal(again, RGB)


def with_orientation(jpeg: bytes) -> bytes:
    """With an EXIF segment that says: turn by 90 degrees (6)."""
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)
    tiff = b"II*\x00" + struct.pack("<IH", 8, 1) + entry + bytes(4)
    exif = b"Exif\x00\x00" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


@pytest.mark.parametrize("color", [False, True])
def test_a_turned_camera_keeps_the_pixels_that_its_lens_is_of(color: bool) -> None:
    """OpenCV alone would turn the image, and with it leave the intrinsics behind."""
    jpeg = with_orientation(bytes(cv2.imencode(".jpg", RGB)[1]))
    turned = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert turned is not None and turned.shape == (6, 4, 3)
    pixels = decode_file(jpeg, color=color)
    assert pixels is not None and pixels.shape == (4, 6, 3)


def test_other_pixels_in_a_file_are_neither_colour_nor_depth() -> None:
    recorded = file_message("64FC1; tiff compressed ", ".tiff", np.ones((4, 4), np.float64))
    with pytest.raises(UndecodableMessageError, match="pixels of float64, neither colour nor depth"):
        read_image(recorded, COMPRESSED_IMAGE)


def test_a_png_that_announces_more_than_its_bytes_unpack_to_is_refused_before_memory_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    png = bytes(cv2.imencode(".png", np.zeros((64, 64), np.uint16))[1])
    assert decode_file(png, color=False) is not None  # a flat image, packed as well as can be
    head = struct.pack(">II", 30_000, 30_000) + png[24:29]
    bomb = png[:16] + head + struct.pack(">I", zlib.crc32(b"IHDR" + head)) + png[33:]
    assert decode_file(png + b"behind the end", color=False) is not None
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    assert decode_file(bomb, color=False) is None
    assert decode_file(png[:20] + png[-12:], color=False) is None
    assert decode_file(png[:33] + b"\x7f" + png[34:], color=False) is None  # a chunk of two gigabytes


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@pytest.mark.parametrize("lazily", [False, True])
def test_a_png_with_a_palette_a_gamma_or_interlaced_rows_has_the_values_that_are_written(lazily: bool) -> None:
    """Six colours of a row; a gamma says how to show them, not what was measured. Adam7's seven passes of one row are
    its first, fifth, third, and the even pixels.
    """
    signature, row = b"\x89PNG\r\n\x1a\n", bytes([0, *range(6)])
    palette = signature + chunk(b"IHDR", struct.pack(">IIBBBBB", 6, 1, 8, 3, 0, 0, 0))
    palette += chunk(b"PLTE", RGB[0].tobytes()) + chunk(b"IDAT", zlib.compress(row)) + chunk(b"IEND", b"")
    plain = signature + chunk(b"IHDR", struct.pack(">IIBBBBB", 6, 1, 8, 2, 0, 0, 0))
    plain += chunk(b"gAMA", struct.pack(">I", 100_000))
    plain += chunk(b"IDAT", zlib.compress(b"\0" + RGB[0].tobytes())) + chunk(b"IEND", b"")
    passes = [RGB[0, columns].tobytes() for columns in ([0], [4], [2], [1, 3, 5])]
    interlaced = signature + chunk(b"IHDR", struct.pack(">IIBBBBB", 6, 1, 8, 2, 0, 0, 1))
    interlaced += chunk(b"IDAT", zlib.compress(b"".join(b"\0" + rows for rows in passes))) + chunk(b"IEND", b"")
    for data in (palette, plain, interlaced):
        recorded = SimpleNamespace(header=header(5, "o"), format="png", data=np.frombuffer(data, np.uint8))
        image = read_image(recorded, COMPRESSED_IMAGE, lazily=lazily)
        assert np.array_equal(color_of(image), RGB[:1])
