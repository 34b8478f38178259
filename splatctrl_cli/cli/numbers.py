"""Numbers on the command line: argparse types with ranges, which refuse NaN and nonsense before any work."""

import argparse
from collections.abc import Callable
from typing import TypeVar

from splatctrl_cli.config.declared import OneOf, Section, Within, shown

T = TypeVar("T", int, float)

MAX_SECONDS = 1e8  # [s] of a recording: three years
MAX_LENGTH = 1e6  # [m, px] of a place: as of poses in files
MAX_SEED = 2**31 - 1  # fits every 32-bit integer, signed or not


def real(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """A number from `low` to `high`, both allowed, in `unit`."""
    return _bounded(float, Within(low, high, unit, ""))


def whole(low: int, high: int, unit: str = "") -> Callable[[str], int]:
    """A whole number from `low` to `high`, both allowed."""
    return _bounded(int, Within(low, high, unit, ""))


def setting(section: type[Section], key: str) -> Callable[[str], float]:
    """A number that stands for a key of the configuration: its type and range."""
    declared = section.declared[key]
    assert isinstance(declared, Within)
    return _bounded(int if type(getattr(section, key)) is int else float, declared)


def several(text: str) -> tuple[float, ...]:
    """Numbers joined by commas; none where one of them is no number, or not within `MAX_LENGTH`."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return values if all(abs(value) <= MAX_LENGTH for value in values) else ()


def words(section: type[Section], key: str) -> tuple[str, ...]:
    """The words that a key of the configuration may be."""
    declared = section.declared[key]
    assert isinstance(declared, OneOf)
    return declared.words


def _bounded(kind: Callable[[str], T], declared: Within) -> Callable[[str], T]:
    def parse(text: str) -> T:
        what = f"expected {'a whole number, ' if kind is int else ''}{declared.expected}, got {shown(text)}"
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(what) from None
        if not declared.holds(value):
            raise argparse.ArgumentTypeError(what)
        return value

    return parse
