"""The tool's word on a run."""

from dataclasses import dataclass

from splatctrl_cli.errors import NotEvaluableError, SplatCtrlError
from splatctrl_cli.jobs.replay import ReplayResult, check_result
from splatctrl_cli.jobs.replay_request import ReplayRequest

WORDS = ("safe", "margin broken", "contact", "not evaluable", "refused")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One of `WORDS`, and the first reason."""

    word: str
    reason: str


def outcome_of(request: ReplayRequest, result: ReplayResult) -> Outcome:
    """What a replay says."""
    metrics = result.metrics
    try:
        check_result(request, result)
    except NotEvaluableError as error:
        return Outcome(word="not evaluable", reason=error.message[:60])
    clearance = metrics["min_clearance"]
    if clearance is not None and clearance < request.config.control.margin:
        return Outcome(word="contact" if clearance < 0 else "margin broken", reason=f"min_clearance {clearance:.3f}")
    if metrics.get("goal_reached") == 0:
        return Outcome(word="margin broken", reason="goal_reached")
    return Outcome(word="safe", reason="")


def refused(error: SplatCtrlError) -> Outcome:
    """What a refusal says."""
    return Outcome(word="refused", reason=error.message[:60])
