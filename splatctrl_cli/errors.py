"""Errors of the library; only the command line turns them into exit codes.

Wording is ``thing: expected X, got Y``; the remedy follows a semicolon.
"""

import difflib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

DAMAGED = 3  # exit code: done, but part of the recording is damaged
DAMAGE = "part of the recording is damaged and left out"
T = TypeVar("T")


def did_you_mean(word: str, known: Iterable[str], otherwise: str, *, prefix: str = "", cutoff: float = 0.6) -> str:
    """A remedy with the nearest known word after a prefix, else `otherwise`."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=cutoff)
    return f"did you mean {prefix}{near[0]}?" if near else otherwise


class SplatCtrlError(Exception):
    """An expected failure: `message` names the object, `remedy` the action."""

    exit_code = 70

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(f"{message}; {remedy}" if remedy else message)
        self.message = message
        self.remedy = remedy


class UsageError(SplatCtrlError):
    """Usage, configuration, or output that exists or is not writable (exit code 2)."""

    exit_code = 2


class InputError(SplatCtrlError):
    """The input is missing or unusable (exit code 4)."""

    exit_code = 4


def refuse_if(is_bad: object, what: str, *, remedy: str = "", error: Callable[..., Exception] = InputError) -> None:
    """Raise an error that says `what` if the condition holds."""
    if is_bad:
        raise error(what, remedy=remedy) if remedy else error(what)


def require(value: T | None, what: str, *, remedy: str = "", error: Callable[..., Exception] = InputError) -> T:
    """The value. Raises an error that says `what` if it is None."""
    if value is None:
        raise error(what, remedy=remedy) if remedy else error(what)
    return value


@contextmanager
def refuse_faults(
    what: str | Callable[[Any], str],
    *faults: type[BaseException],
    remedy: str = "",
    error: Callable[..., Exception] = InputError,
) -> Iterator[None]:
    """Raise ``what: fault``, or ``what(fault)``, for one of `faults` in the block."""
    try:
        yield
    except faults as fault:
        message = f"{what}: {fault}" if isinstance(what, str) else what(fault)
        raise (error(message, remedy=remedy) if remedy else error(message)) from None


class NotEvaluableError(SplatCtrlError):
    """The input cannot answer the question, e.g. a path leaves known space (exit code 5)."""

    exit_code = 5


class WriteError(SplatCtrlError):
    """Writing failed, e.g. on a full disk (exit code 6)."""

    exit_code = 6


class DeviceFault(SplatCtrlError):  # noqa: N818  (the run can go on elsewhere)
    """A card failed or was lost during computation (exit code 70); the run can resume."""


class DeviceFull(DeviceFault):
    """A card has too little memory (exit code 2)."""

    exit_code = 2
