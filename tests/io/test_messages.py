"""Image messages: encodings, byte order, row step."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.io.decoder import COMPRESSED_IMAGE, IMAGE, UndecodableMessageError
from splatctrl_cli.io.messages import color_of, depth_of, read_image
from tests.io.make_log import header

RGB = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
COUNTS = np.array([[0, 1, 500], [1000, 40000, 65535]], dtype=np.uint16)


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


def test_too_few_bytes_are_refused_not_padded() -> None:
    short = message(COUNTS, "16UC1")
    short.data = short.data[:-1]
    with pytest.raises(UndecodableMessageError, match="do not hold it"):
        read_image(short, IMAGE)


@pytest.mark.parametrize("suffix", ["png", "jpeg"])
def test_compressed_color_keeps_its_bytes(suffix: str) -> None:
    data = cv2.imencode(f".{suffix}", cv2.cvtColor(RGB, cv2.COLOR_RGB2BGR))[1].ravel()
    image = read_image(SimpleNamespace(header=header(5, "o"), format=suffix, data=data), COMPRESSED_IMAGE)
    assert image.compressed == bytes(data)
    assert np.abs(color_of(image).astype(int) - RGB).max() <= (0 if suffix == "png" else 255)
    assert image.kind == "color"


def test_a_sixteen_bit_png_is_depth() -> None:
    data = cv2.imencode(".png", COUNTS)[1].ravel()
    image = read_image(SimpleNamespace(header=header(5, "o"), format="16UC1; png", data=data), COMPRESSED_IMAGE)
    assert image.kind == "depth"
    assert depth_of(image, None) == pytest.approx(COUNTS * 1e-3, rel=1e-6)


def test_compressed_depth_transport_is_read() -> None:
    png = cv2.imencode(".png", COUNTS)[1].tobytes()
    data = np.frombuffer(bytes(12) + png, dtype=np.uint8)
    form = "16UC1; compressedDepth png"
    image = read_image(SimpleNamespace(header=header(5, "o"), format=form, data=data), COMPRESSED_IMAGE)
    assert depth_of(image, None) == pytest.approx(COUNTS * 1e-3, rel=1e-6)


def test_an_unknown_encoding_is_neither_color_nor_depth() -> None:
    assert read_image(message(RGB[..., 0], "bayer_rggb8"), IMAGE).kind == "other"


def test_bytes_that_are_no_image_are_refused() -> None:
    broken = SimpleNamespace(header=header(5, "o"), format="jpeg", data=np.zeros(40, np.uint8))
    with pytest.raises(UndecodableMessageError, match="no image file"):
        read_image(broken, COMPRESSED_IMAGE)


@pytest.mark.parametrize("suffix", ["png", "jpeg"])
def test_a_cut_image_is_refused_not_filled_with_grey(suffix: str) -> None:
    data = cv2.imencode(f".{suffix}", np.zeros((64, 64, 3), np.uint8) + RGB[0, 0])[1].ravel()
    cut = SimpleNamespace(header=header(5, "o"), format=suffix, data=data[: len(data) * 3 // 4])
    with pytest.raises(UndecodableMessageError, match="no image file"):
        read_image(cut, COMPRESSED_IMAGE)
