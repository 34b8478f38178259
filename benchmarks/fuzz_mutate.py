"""Changes to a valid file's bytes that find values that a reader does not check."""

import random
import re
import struct

NUMBERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 1 << 20, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, 100 << 30, (1 << 64) - 1)
TEXTS = (
    *(b"nan", b"inf", b"-1", b"0", b"1e308", b"-0.0", b"99999999999", b"1e-320", b"true", b"[]", b"{}", b"null"),
    *(b"../../../evil", b"/etc/passwd", b"package://../../evil", b"\x00", b"\xff\xfe", b"%s%s", b"a" * 5000, b""),
)
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?")
_STRING = re.compile(rb"[A-Za-z_/.]{3,}")


def mutated(data: bytes, rng: random.Random) -> bytes:
    """`data` with one to four changes; text is mostly changed as text."""
    is_text = b"\x00" not in data[:4096]
    for _ in range(rng.choice([1, 1, 2, 4])):
        pool = _TEXT if is_text and rng.random() < 0.8 else _BINARY
        data = rng.choice(pool)(data, rng)
    return data


def _place(data: bytes, rng: random.Random) -> int:
    """A place in the data; often near its start or end, where headers and indexes are."""
    if not data:
        return 0
    where = rng.random()
    if where < 0.3:
        return rng.randrange(min(len(data), 256))
    if where < 0.5:
        return max(0, len(data) - 1 - rng.randrange(min(len(data), 1024)))
    return rng.randrange(len(data))


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice([1, 2, 8, 32])):
        if changed:
            changed[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: _place(data, rng)]


def _blank(data: bytes, rng: random.Random) -> bytes:
    at, length = _place(data, rng), rng.choice([1, 8, 64, 1024])
    return data[:at] + bytes([rng.choice([0, 255])]) * min(length, len(data) - at) + data[at + length :]


def _length(data: bytes, rng: random.Random) -> bytes:
    """Another number of two, four or eight bytes."""
    size = rng.choice([2, 4, 4, 8])
    at = min(_place(data, rng), max(0, len(data) - size))
    number = rng.choice([*NUMBERS, len(data), rng.randrange(1 << 16)]) % (1 << (8 * size))
    return data[:at] + struct.pack("<Q", number)[:size] + data[at + size :]


def _shift(data: bytes, rng: random.Random) -> bytes:
    """A piece taken out, or put in twice."""
    at, length = _place(data, rng), rng.choice([1, 4, 16, 200])
    piece = data[at : at + length]
    return data[:at] + piece * rng.choice([0, 2, 3]) + data[at + length :]


def _splice(data: bytes, rng: random.Random) -> bytes:
    """A piece of the file in another place."""
    a, b, length = _place(data, rng), _place(data, rng), rng.choice([8, 64, 1024])
    return data[:a] + data[b : b + length] + data[a + length :]


def _append(data: bytes, rng: random.Random) -> bytes:
    return data + rng.choice([data, bytes(100), rng.randbytes(100), data[: len(data) // 2]])


def _number(data: bytes, rng: random.Random) -> bytes:
    return _replaced(data, _NUMBER, rng)


def _word(data: bytes, rng: random.Random) -> bytes:
    return _replaced(data, _STRING, rng)


def _replaced(data: bytes, pattern: re.Pattern[bytes], rng: random.Random) -> bytes:
    found = list(pattern.finditer(data))
    if not found:
        return data
    match = rng.choice(found)
    return data[: match.start()] + rng.choice(TEXTS) + data[match.end() :]


def _line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at : at + 1] = [lines[at]] * rng.choice([0, 2, 200])
    return b"\n".join(lines)


def _nest(data: bytes, rng: random.Random) -> bytes:
    """Deep nesting, or entities that multiply."""
    at = _place(data, rng)
    deep = rng.choice([b"[", b"{", b"<a>", b"- ", b"("]) * rng.choice([50, 5000])
    if rng.random() < 0.5:
        return data[:at] + deep + data[at:]
    rows = b"".join(b'<!ENTITY a%d "%s">' % (i, b"&a%d;" % (i - 1) * 10) for i in range(1, 10))
    return b'<!DOCTYPE robot [<!ENTITY a0 "ha">' + rows + b"]>" + data.replace(b"name=", b"x='&a9;' name=", 1)


_BINARY = (_flip, _cut, _blank, _length, _length, _shift, _splice, _append)
_TEXT = (_number, _number, _word, _line, _nest, _cut, _flip)
