"""RVL: the run-length code of 16-bit depth images that compressed_depth_image_transport offers beside PNG.

A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017 (its listing is the definition): the image is runs of
zeros and of values in turn, each value the zigzag-coded difference to the last one that was not zero; every number
is written in groups of three bits, low ones first, in four-bit nibbles whose high bit says that another follows;
nibbles fill 32-bit words from the top.
"""

import numpy as np
from numpy.typing import NDArray

UInt16 = NDArray[np.uint16]


def decode_rvl(data: bytes, num_pixels: int) -> UInt16:
    """The pixels (num_pixels,) of an RVL stream of little-endian words.

    Raises ValueError where it holds no such image. Memory is that of the image and a few times that of `data`.
    """
    numbers = _numbers(data)
    runs: list[tuple[int, int, int]] = []  # first pixel, first number, length
    pixel = position = 0
    while pixel < num_pixels:
        if position + 1 >= len(numbers):
            raise ValueError(f"RVL: {len(data)} bytes end after {pixel} of {num_pixels} pixels")
        zeros, values = int(numbers[position]), int(numbers[position + 1])
        pixel += zeros
        runs.append((pixel, position + 2, values))
        pixel, position = pixel + values, position + 2 + values
        if pixel > num_pixels or position > len(numbers) or zeros + values == 0:
            raise ValueError(f"RVL: runs of {len(data)} bytes do not fit {num_pixels} pixels")
    image = np.zeros(num_pixels, dtype=np.uint16)
    coded = np.concatenate([numbers[first : first + length] for _, first, length in runs] or [numbers[:0]])
    depth = np.cumsum((coded >> 1) ^ -(coded & 1))
    if depth.size and not (depth.min() >= 0 and depth.max() <= 65535):
        raise ValueError("RVL: values outside 0 to 65535")
    start = 0
    for first_pixel, _, length in runs:
        image[first_pixel : first_pixel + length] = depth[start : start + length]
        start += length
    return image


def _numbers(data: bytes) -> NDArray[np.int64]:
    """All numbers of a stream, those of the filling at its end too."""
    words = np.frombuffer(data, dtype="<u4", count=len(data) // 4)
    nibbles = ((words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32)) & 15).astype(np.int64).ravel()
    ends = np.flatnonzero(nibbles < 8)
    if not ends.size:
        return np.zeros(0, dtype=np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    if place.max() > 10:  # a number of more than 33 bits
        raise ValueError("RVL: a number of more than 33 bits")
    result: NDArray[np.int64] = np.add.reduceat((nibbles[: ends[-1] + 1] & 7) << (3 * place), starts)
    return result
