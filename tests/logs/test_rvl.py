"""RVL, the other depth code of compressed_depth_image_transport, against an encoder told here number by number."""

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.logs.decoder import COMPRESSED_IMAGE, UndecodableMessageError
from splatctrl_cli.logs.messages import decode_rvl, depth_of, read_image
from tests.logs.make_log import header

COUNTS = np.array([[0, 1, 500], [1000, 40000, 65535]], dtype=np.uint16)


def encoded_rvl(pixels: np.ndarray[Any, np.dtype[np.uint16]]) -> bytes:
    """Wilson's encoder, number by number."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            low, value = value & 7, value >> 3
            nibbles.append(low | (8 if value else 0))
            if not value:
                return

    flat, previous, index = pixels.ravel().astype(int).tolist(), 0, 0
    while index < len(flat):
        zeros = next((k for k, v in enumerate(flat[index:]) if v), len(flat) - index)
        values = next((k for k, v in enumerate(flat[index + zeros :]) if not v), len(flat) - index - zeros)
        put(zeros)
        put(values)
        for value in flat[index + zeros : index + zeros + values]:
            delta, previous = value - previous, value
            put((delta << 1) ^ (delta >> 63))
        index += zeros + values
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    return struct.pack(f"<{len(words)}I", *words)


@pytest.mark.parametrize("seed", range(6))
def test_rvl_gives_back_what_its_encoder_took(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = np.where(rng.random((13, 17)) < seed / 6, 0, rng.integers(1, 65536, (13, 17))).astype(np.uint16)
    assert np.array_equal(decode_rvl(encoded_rvl(pixels), pixels.size), pixels.ravel())


def test_an_rvl_stream_has_the_bits_of_the_paper() -> None:
    """By hand: 1 zero, 2 values: +4 is 8 = nibbles 8+0, 1; -1 is 1."""
    assert decode_rvl(struct.pack("<I", 0x12811000), 3).tolist() == [0, 4, 3]


def test_the_rvl_transport_is_depth_and_a_cut_or_bloated_one_is_refused() -> None:
    stream = struct.pack("<iffii", 0, 0.0, 0.0, COUNTS.shape[1], COUNTS.shape[0]) + encoded_rvl(COUNTS)
    form = "16UC1; compressedDepth rvl"

    def read(data: bytes) -> Any:
        return read_image(SimpleNamespace(header=header(5, "o"), format=form, data=data), COMPRESSED_IMAGE)

    assert depth_of(read(stream), None) == pytest.approx(COUNTS * 1e-3, rel=1e-6)
    with pytest.raises(UndecodableMessageError, match="RVL"):
        read(stream[:-4])
    with pytest.raises(UndecodableMessageError, match="an image of 2147483647x2147483647"):
        read(stream[:12] + b"\xff\xff\xff\x7f" * 2 + stream[20:])
    with pytest.raises(UndecodableMessageError, match="33 bits"):
        read(stream[:20] + b"\xff" * 36 + bytes(4))
