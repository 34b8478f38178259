"""Verdicts of judging commands: outcome and criteria; requirements on metrics."""

import inspect
import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import asdict, dataclass, field, fields, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from splatctrl_cli.errors import DAMAGE, DAMAGED, UsageError, did_you_mean, refuse_if

E = TypeVar("E")  # what a criterion looks at


class Outcome(StrEnum):
    """Result of a claim, given the evidence."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_EVALUABLE = "not evaluable"


EXIT_CODES = {Outcome.PASSED: 0, Outcome.FAILED: 1, Outcome.NOT_EVALUABLE: 5}
_WORST_FIRST = (Outcome.FAILED, Outcome.NOT_EVALUABLE, Outcome.PASSED)  # a definite failure outranks missing evidence


@dataclass(frozen=True, kw_only=True)
class Reason:
    """One criterion's finding; `Criterion.reasons` fills in `criterion`.

    value, threshold: in `unit`, or None. time_s [s]: as in the output's files. place (3,) [m]: world. who: link,
    sphere, joint or camera. cause: appended to the sentence. count: states, views or points behind the value. label:
    the outcome's name if this reason decides, such as "contact". is_note: only printed, without effect on the
    verdict.
    """

    criterion: str = ""
    outcome: Outcome
    sentence: str
    value: float | None = None
    threshold: float | None = None
    unit: str = ""
    time_s: float | None = None
    place: tuple[float, float, float] | None = None
    who: str = ""
    cause: str = ""
    remedy: str = ""
    count: int | None = None
    label: str = ""
    is_note: bool = False

    def __str__(self) -> str:
        when = "" if self.time_s is None else f" at {self.time_s:.2f} s"
        near = f", {self.cause}" if self.cause else ""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{self.criterion}: {self.sentence}{when}{near}{remedy}"


failed = partial(Reason, outcome=Outcome.FAILED)
not_evaluable = partial(Reason, outcome=Outcome.NOT_EVALUABLE)
"""A reason whose evidence does not suffice."""
note = partial(Reason, outcome=Outcome.PASSED, is_note=True)
"""A reason that is printed, but does not affect the verdict."""


def passed_reason(sentence: str, value: float, threshold: float, unit: str, count: int) -> Reason:
    """A passed criterion, not printed."""
    return Reason(outcome=Outcome.PASSED, sentence=sentence, value=value, threshold=threshold, unit=unit, count=count)


@dataclass(frozen=True, kw_only=True)
class Criterion(Generic[E]):
    """One criterion of a verdict.

    find: its reasons, if it applies. meaning: its description in the docs, by default the first paragraph of find's
    docstring. broken: description of a violation.
    """

    name: str
    find: Callable[[E], Iterable[Reason]]
    broken: str
    meaning: str = ""

    def reasons(self, evidence: E) -> Iterator[Reason]:
        return (replace(reason, criterion=reason.criterion or self.name) for reason in self.find(evidence))

    @property
    def docs(self) -> str:
        """The table's row, its cells separated by |."""
        words = self.meaning or (inspect.getdoc(self.find) or "").split("\n\n")[0]
        meaning = " ".join(words.split()).removesuffix(".")
        return f"{self.name} | {meaning[0].lower()}{meaning[1:]} | {self.broken}"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The outcome of a command and its reasons, deciding ones first.

    label: the command's word for the outcome, such as "safe"; how: such as "proven"; scope: what was judged; notes:
    do not affect the outcome. is_damaged: part of the input was lost. counts: states, views or points by metric.
    """

    command: str
    outcome: Outcome
    label: str
    scope: str
    reasons: tuple[Reason, ...]
    how: str = ""
    notes: tuple[str, ...] = ()
    is_damaged: bool = False
    counts: Mapping[str, int] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<{self.sentence}>"

    @property
    def exit_code(self) -> int:
        """0 passed, 1 failed, 3 passed on damaged input, 5 not evaluable."""
        return EXIT_CODES[self.outcome] or (DAMAGED if self.is_damaged else 0)

    def exit_code_of(self, criteria: tuple[str, ...] | None) -> int:
        """`exit_code` by criteria whose names begin with one of `criteria` (None: all)."""
        if criteria is None:
            return self.exit_code
        outcomes = [reason.outcome for reason in self.reasons if reason.criterion.startswith(criteria)]
        return EXIT_CODES[min(outcomes, key=_WORST_FIRST.index, default=Outcome.PASSED)]

    @property
    def decisive(self) -> tuple[Reason, ...]:
        """Reasons that did not pass, the outcome's first."""
        return tuple(reason for reason in self.reasons if reason.outcome is not Outcome.PASSED)

    @property
    def shown(self) -> tuple[Reason, ...]:
        return tuple(reason for reason in self.reasons if reason.is_note and reason.outcome is Outcome.PASSED)

    @property
    def sentence(self) -> str:
        scope = f" ({self.scope})" if self.scope else ""
        scope = f", {DAMAGE}{scope}" if self.is_damaged else scope
        if not self.decisive:
            how = f", {self.how}" if self.how else ""
            return f"{self.command}: {self.label.upper()}{how}{scope}" + "".join(f"; {note}" for note in self.notes)
        more = len(self.decisive) - 1
        others = f"; and {more} more reason{'s' if more > 1 else ''}" if more else ""
        return f"{self.command}: {self.label.upper()}{scope}: {self.decisive[0]}{others}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; non-finite numbers are None."""
        return {
            "outcome": str(self.outcome),
            "label": self.label,
            "how": self.how if self.outcome is Outcome.PASSED else "",
            "sentence": self.sentence,
            "scope": self.scope,
            "exit_code": self.exit_code,
            "is_damaged": self.is_damaged,
            "reasons": [_plain(reason) for reason in self.reasons],
            "notes": list(self.notes),
            "counts": dict(self.counts),
        }


def verdict_of(
    command: str,
    reasons: Iterable[Reason],
    *,
    scope: str = "",
    passed: str = "passed",
    how: str = "",
    notes: Iterable[str] = (),
    is_damaged: bool = False,
    counts: Mapping[str, int] | None = None,
) -> Verdict:
    """The verdict: failed if any reason failed, else not evaluable if any is, else passed.

    Without any reason it is not evaluable. passed: the label when passed; a failure's is the first `Reason.label`.
    """
    all_reasons = list(reasons) or [not_evaluable(criterion="evidence", sentence="nothing was judged")]
    ordered = sorted(all_reasons, key=lambda reason: _WORST_FIRST.index(reason.outcome))
    outcome = ordered[0].outcome
    failure = next((r.label for r in ordered if r.outcome is Outcome.FAILED and r.label), "failed")
    return Verdict(
        command=command,
        outcome=outcome,
        label={Outcome.PASSED: passed, Outcome.FAILED: failure}.get(outcome, str(outcome)),
        scope=scope,
        reasons=tuple(ordered),
        how=how,
        notes=tuple(notes),
        is_damaged=is_damaged,
        counts=counts or {},
    )


@dataclass(frozen=True, kw_only=True, repr=False)
class Result:
    """The result of a command; its repr is a few lines.

    out: the written file or folder. metrics: figures by name. document: printed by ``--json``; if empty, `out` and
    the metrics are. notes: to print. seconds: by stage.
    """

    out: Path | None = None
    metrics: Mapping[str, Any] = field(default_factory=dict)
    document: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        shown = []
        for name, value in ((each.name, getattr(self, each.name)) for each in fields(self)):
            text, size = repr(value), f" of {len(value)}" if isinstance(value, Sized) else ""
            is_short = len(text) <= 80 or isinstance(value, Verdict)
            shown.append(f"{name}={text if is_short else f'<{type(value).__name__}{size}>'}")
        return f"{type(self).__name__}({', '.join(shown)})"


@dataclass(frozen=True, kw_only=True, repr=False)
class JudgedResult(Result):
    """The result of a command that judges."""

    verdict: Verdict


def read_verdict(document: Mapping[str, Any]) -> Verdict:
    """A replay's verdict, from the values of `Verdict.as_dict`."""
    rows = [
        row | {"outcome": Outcome(row["outcome"]), "place": row["place"] and tuple(row["place"])}
        for row in document["reasons"]
    ]
    return Verdict(
        command="replay",
        outcome=Outcome(document["outcome"]),
        label=document["label"],
        scope=document["scope"],
        reasons=tuple(Reason(**row) for row in rows),
        how=document["how"],
        notes=tuple(document["notes"]),
        is_damaged=document["is_damaged"],
        counts=document["counts"],
    )


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The first failed verdict, else the first not evaluable one, else the first."""
    return min(verdicts, key=lambda verdict: _WORST_FIRST.index(verdict.outcome))


def damage_mark(sentence: str | None, exit_code: int | None) -> str:
    """The word ", damaged" for a run of a damaged recording, else nothing."""
    return ", damaged" if exit_code == DAMAGED or DAMAGE in (sentence or "") else ""


def plural(number: float, noun: str) -> str:
    """``1 view``, ``2 views``."""
    return f"{number:.0f} {noun}{'' if number == 1 else 's'}"


def _plain(reason: Reason) -> dict[str, Any]:
    plain = asdict(reason) | {"outcome": str(reason.outcome)}
    for name in ("value", "threshold", "time_s"):
        value = plain[name]
        plain[name] = value if value is not None and math.isfinite(value) else None
    return plain


_COMPARISONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


def check_gate_names(
    requirements: Sequence[str], names: Collection[str], elsewhere: Mapping[str, Collection[str]] | None = None
) -> None:
    """Raise UsageError for a metric not in `names`, before the work.

    elsewhere: metrics that other options add, by those options.
    """
    for requirement in requirements:
        name, _, _ = parse_gate(requirement)
        for options, others in (elsewhere or {}).items():
            refuse_if(
                name not in names and name in others,
                f"--require {requirement}: a figure of {options}",
                remedy="give it, or gate another",
                error=UsageError,
            )
        refuse_if(
            name not in names,
            f"--require {requirement}: unknown metric",
            remedy=did_you_mean(name, names, f"known here: {', '.join(names)}"),
            error=UsageError,
        )


def gate_reasons(
    requirements: Sequence[str],
    metrics: Mapping[str, float | None],
    counts: Mapping[str, int],
    *,
    first_time: Callable[[str, Callable[[float], bool]], float | None] | None = None,
) -> list[Reason]:
    """A reason per requirement: passed, failed, or not evaluable without a finite value or count.

    counts: states, views or points by metric. first_time: first time [s] of a violating state, or None.
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
    """`text` itself, for argparse. Raises UsageError unless it is a requirement."""
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
