"""Ranges of configuration keys, declared with their defaults; checks and docs follow."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar, get_args, get_type_hints

from splatctrl_cli.errors import UsageError, refuse_if

MOST_SHOWN = 60  # characters of a refused value
MAX_PLACE = 1e6  # [m] of a place from the world's origin
POSE = "x,y,z,qx,qy,qz,qw"
MAX_SEED = 2**31 - 1  # fits every 32-bit integer, signed or not


@dataclass(frozen=True)
class Within:
    """A number from `low` to `high`, inclusive, in `unit`; `or_zero`: or 0, which switches off.

    Positional, so that a declaration reads like a table's row.
    """

    low: float
    high: float
    unit: str
    reason: str
    or_zero: bool = False

    @property
    def expected(self) -> str:
        """The range as text, ``0.001 to 0.5 m``."""
        span = f"{'0 or ' if self.or_zero else ''}{self.low:.12g} to {self.high:.12g}"
        return f"{span} {self.unit}" if self.unit else span

    def holds(self, value: Any) -> bool:
        """True if a number, or each of a tuple, is in range; NaN never."""
        numbers = value if isinstance(value, tuple) else (value,)
        is_within = numbers != () and all(self.low <= number <= self.high for number in numbers)
        return is_within or (self.or_zero and value == 0)


@dataclass(frozen=True)
class OneOf:
    """One of a few words."""

    words: tuple[str, ...]
    reason: str
    unit: ClassVar[str] = ""

    @property
    def expected(self) -> str:
        return f"{', '.join(self.words[:-1])} or {self.words[-1]}"

    def holds(self, value: Any) -> bool:
        return value in self.words


Declared = Within | OneOf


T = TypeVar("T")


def copy_unchecked(original: T, **values: Any) -> T:
    """A copy with unchecked values from a recording, in their units."""
    copied = copy.copy(original)
    for key, value in values.items():
        object.__setattr__(copied, key, value)
    return copied


class Section:
    """A table of the configuration, checked when created."""

    section: ClassVar[str]
    declared: ClassVar[dict[str, Declared]]
    ordered: ClassVar[tuple[tuple[str, str], ...]] = ()  # pairs of keys, of which the first is at most the second

    def __init_subclass__(cls, *, section: str) -> None:
        """Raises TypeError for a key without a range."""
        hints = get_type_hints(cls, include_extras=True)
        cls.section, cls.declared = section, {key: _declare(hints[key]) for key in cls.__annotations__}

    derived = copy_unchecked

    def __post_init__(self) -> None:
        for key, declared in self.declared.items():
            value = getattr(self, key)
            check(declared.holds(value), f"{self.section}.{key}", declared.expected, value)
        for low, high in self.ordered:
            least, most = getattr(self, low), getattr(self, high)
            expected = f"at most {self.section}.{high} = {most:g} {self.declared[high].unit}".rstrip()
            check(least <= most, f"{self.section}.{low}", expected, least)


def _declare(hint: Any) -> Declared:
    for note in get_args(hint)[1:]:
        if isinstance(note, Within | OneOf):
            return note
    raise TypeError(f"{hint}: expected Annotated with a range or words")


def check(holds: bool, name: str, expected: str, value: object) -> None:
    """Raise UsageError with key, expectation and value, unless `holds`."""
    refuse_if(
        not holds,
        f"{name}: expected {expected}, got {format_value(value)}",
        remedy="see splatctrl config --template",
        error=UsageError,
    )


def format_value(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return f"{type(value).__name__} too long to show"
    return shorten(text)


def shorten(text: str) -> str:
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."


def checked_pose(values: Sequence[float]) -> tuple[float, ...]:
    """Return the pose `POSE` unchanged. Raises ValueError for a wrong length or quaternion norm."""
    refuse_if(len(values) != 7, f"expected 7 numbers {POSE}, got {len(values)}", error=ValueError)
    refuse_if(
        not all(math.isfinite(value) for value in values),
        f"expected finite numbers, got {','.join(map(str, values))}",
        error=ValueError,
    )
    length = math.hypot(*values[3:])
    refuse_if(
        abs(length - 1.0) > 0.01,
        f"expected a unit quaternion qx,qy,qz,qw, got one of length {length:.3f}",
        error=ValueError,
    )
    return tuple(values)
