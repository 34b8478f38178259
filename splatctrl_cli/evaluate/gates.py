"""Requirements on metrics: ``metric>=value``."""

import math
import operator
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

from splatctrl_cli.errors import UsageError, did_you_mean
from splatctrl_cli.evaluate.verdict import Outcome, Reason

FirstTime = Callable[[str, Callable[[float], bool]], float | None]
"""Metric name, whether a value holds -> the first time [s] that does not."""

_COMPARISONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


def check_gate_names(
    requirements: Sequence[str], names: Collection[str], elsewhere: Mapping[str, Collection[str]] | None = None
) -> None:
    """Raise UsageError for a requirement on a metric that is not among `names`; to be called before the work.

    elsewhere: the metrics that other options would give, by those options.
    """
    for requirement in requirements:
        name, _, _ = parse_gate(requirement)
        for options, others in (elsewhere or {}).items():
            if name not in names and name in others:
                raise UsageError(f"--require {requirement}: a figure of {options}", remedy="give it, or gate another")
        if name not in names:
            remedy = did_you_mean(name, names, f"known here: {', '.join(names)}")
            raise UsageError(f"--require {requirement}: unknown metric", remedy=remedy)


def gate_reasons(
    requirements: Sequence[str],
    metrics: Mapping[str, float | None],
    counts: Mapping[str, int],
    *,
    first_time: "FirstTime | None" = None,
) -> list[Reason]:
    """A reason for each requirement: passed, failed, or not evaluable where its metric has no finite value or rests
    on nothing.

    counts: how many states, views or points each metric rests on. first_time gives the first time [s] at which a
    metric's own states break a requirement, None where it has none.
    """
    check_gate_names(requirements, metrics)
    reasons = []
    for requirement in requirements:
        name, comparison, bound = parse_gate(requirement)
        value, count = metrics[name], counts.get(name, 0)
        is_there = value is not None and math.isfinite(value)
        is_known = is_there and count > 0
        holds = value is not None and is_known and _holds(comparison, bound, value)
        when = None if holds or first_time is None else first_time(name, partial(_holds, comparison, bound))
        shown = f"{value:.6g}" if is_known else "unknown, as it rests on nothing" if is_there else "unknown"
        reasons.append(
            Reason(
                criterion=f"--require {requirement.strip()}",
                outcome=Outcome.PASSED if holds else Outcome.FAILED if is_known else Outcome.NOT_EVALUABLE,
                sentence=f"{name} is {shown}, required {comparison} {bound:g}"
                + ("" if when is None else f", first at {when:.3f} s"),
                value=value,
                threshold=bound,
                count=count,
                label="gate failed",
            )
        )
    return reasons


def _holds(comparison: str, bound: float, value: float) -> bool:
    return bool(_COMPARISONS[comparison](value, bound))


def gate(text: str) -> str:
    """`text` itself, for argparse. Raises UsageError where it is not a requirement."""
    parse_gate(text)
    return text


def parse_gate(requirement: str) -> tuple[str, str, float]:
    """Metric, comparison and bound."""
    match = re.fullmatch(r"\s*([\w.]+)\s*(>=|<=|>|<)\s*(\S+)\s*", requirement)
    try:
        bound = float(match[3]) if match else math.nan
    except ValueError:
        bound = math.nan
    if not match or not math.isfinite(bound):
        raise UsageError(
            f"--require {requirement}: expected METRIC>=NUMBER (or <=, >, <)",
            remedy="quote it for the shell, like --require 'psnr_seen>=20'",
        )
    return match[1], match[2], bound
