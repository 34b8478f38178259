"""Errors the library raises; the command line alone turns them into a line on stderr and an exit code.

Wording is ``thing: expected X, got Y``; the remedy follows on the same line after a semicolon.
"""

import difflib
from collections.abc import Iterable

DAMAGED = 3  # exit code: done, but part of the recording is damaged
DAMAGE = "part of the recording is damaged and left out"


def did_you_mean(word: str, known: Iterable[str], otherwise: str, *, prefix: str = "", cutoff: float = 0.6) -> str:
    """The remedy for an unknown word: the nearest one that is known, after a prefix, and `otherwise` without one."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=cutoff)
    return f"did you mean {prefix}{near[0]}?" if near else otherwise


class SplatCtrlError(Exception):
    """An expected failure: `message` names the thing, `remedy` says what to do about it."""

    exit_code = 70

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(f"{message}; {remedy}" if remedy else message)
        self.message = message
        self.remedy = remedy


class UsageError(SplatCtrlError):
    """Usage, configuration, or an output that exists or cannot be written (exit code 2)."""

    exit_code = 2


class InputError(SplatCtrlError):
    """The input is missing or unusable (exit code 4)."""

    exit_code = 4


class NotEvaluableError(SplatCtrlError):
    """The question cannot be answered from this input, e.g. a path leaves known space (exit code 5)."""

    exit_code = 5


class WriteError(SplatCtrlError):
    """Writing failed, e.g. the disk is full (exit code 6)."""

    exit_code = 6


class DeviceFault(SplatCtrlError):  # noqa: N818  (the run can go on elsewhere)
    """A card failed or was lost while it computed (exit code 70); what was written before can be gone on from."""


class DeviceFull(DeviceFault):
    """A card has too little memory for what was asked (exit code 2)."""

    exit_code = 2
