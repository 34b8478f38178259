"""What `check` says about a recording, one finding at a time, and what it keeps of a long one."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, TypeVar

T = TypeVar("T")


class Severity(StrEnum):
    """error: a later command fails or its result is wrong; warning: something is lost or doubtful; note: no fault."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


ORDER = tuple(Severity)  # worst first


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing about a recording: `code` names its kind (docs/check.md), `where` the topic, camera or joint.

    value: the figure that was judged, in `unit`; stamp_ns: the first time it was met; both None where there is none.
    """

    severity: Severity
    code: str
    where: str
    what: str
    remedy: str = ""
    value: float | None = None
    unit: str = ""
    stamp_ns: int | None = None


def error(code: str, where: str, what: str, remedy: str = "", **figure: object) -> Finding:
    """A finding of that severity; figure: value, unit, stamp_ns."""
    return _finding(Severity.ERROR, code, where, what, remedy, **figure)


def warning(code: str, where: str, what: str, remedy: str = "", **figure: object) -> Finding:
    """A finding of that severity; figure: value, unit, stamp_ns."""
    return _finding(Severity.WARNING, code, where, what, remedy, **figure)


def note(code: str, where: str, what: str, remedy: str = "", **figure: object) -> Finding:
    """A finding of that severity; figure: value, unit, stamp_ns."""
    return _finding(Severity.NOTE, code, where, what, remedy, **figure)


def _finding(
    severity: Severity,
    code: str,
    where: str,
    what: str,
    remedy: str,
    value: object = None,
    unit: object = "",
    stamp_ns: object = None,
) -> Finding:
    return Finding(
        severity=severity,
        code=code,
        where=where,
        what=what,
        remedy=remedy,
        value=None if value is None else round(float(str(value)), 6),
        unit=str(unit),
        stamp_ns=None if stamp_ns is None else int(str(stamp_ns)),
    )


def worst_first(findings: list[Finding]) -> list[Finding]:
    """By severity, then as they were found."""
    return sorted(findings, key=lambda finding: ORDER.index(finding.severity))


class Thinned(Generic[T]):
    """Every k-th of a long row of values, at most `limit` of them; k doubles where they would be more."""

    def __init__(self, limit: int) -> None:
        self._limit, self._step, self._num = limit, 1, 0
        self._kept: list[T] = []

    def is_next(self) -> bool:
        """Whether the value that comes now is kept; to be asked once for each value, before `add`."""
        is_kept = self._num % self._step == 0
        self._num += 1
        return is_kept

    def add(self, value: T) -> None:
        """Keep it."""
        self._kept.append(value)
        if len(self._kept) > self._limit:
            self._kept = self._kept[::2]
            self._step *= 2

    def change(self, by: Callable[[T], T]) -> None:
        """Put something else in the place of each value."""
        self._kept = [by(value) for value in self._kept]

    def __iter__(self) -> Iterator[T]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)
