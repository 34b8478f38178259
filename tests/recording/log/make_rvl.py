"""Depth in RVL, by an encoder of our own."""

import struct
from typing import Any

import numpy as np


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
