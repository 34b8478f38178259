"""The tool's word on a run."""

from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.errors import SplatCtrlError
from splatctrl_cli.evaluate.verdict import Outcome, Verdict
from splatctrl_cli.jobs.replay.evidence_criteria import LIMITS
from splatctrl_cli.jobs.replay.request import Trace

WORDS = ("safe", "waived", "failed", "contact", "not evaluable", "refused")
LONGEST = 90  # characters of a reason


@dataclass(frozen=True, kw_only=True)
class Word:
    """One of `WORDS`. reason: the first reason's criterion, a colon and its sentence. only: the only limit of
    evidence that prevents safe, or "".
    """

    word: str
    reason: str
    only: str = ""


def word_of(verdict: Verdict, trace: Trace, margin: float) -> Word:
    """A failure other than contact is `failed`; a pass by a waiver is `waived`. trace: with evidence within `margin`
    [m] of the arm.
    """
    broken = [limit.name for limit in LIMITS if limit.is_broken(trace, margin)]
    only = broken[0] if len(broken) == 1 == len(verdict.decisive) else ""
    first = verdict.decisive[0] if verdict.decisive else None
    reason = "" if first is None else f"{first.criterion}: {first.sentence}"[:LONGEST]
    if verdict.outcome is Outcome.FAILED:
        return Word(word="contact" if verdict.label == "contact" else "failed", reason=reason)
    if verdict.outcome is Outcome.PASSED:
        return Word(word="waived" if verdict.how == "waived" else "safe", reason=reason)
    return Word(word="not evaluable", reason=reason, only=only)


def refused(error: SplatCtrlError, folder: Path) -> Word:
    """What a refusal says, without the scratch folder of the run."""
    message = error.message.replace(f"{folder}/", "")
    return Word(word="refused", reason=f"{type(error).__name__}: {message}"[:LONGEST])
