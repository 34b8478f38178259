"""A comparison: regressions between runs, batches, or since a baseline."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.metrics import CONFIDENCE, Better, MeanChange, Scale, mean_change
from splatctrl_cli.evaluate.verdict import JudgedResult, Reason, failed, not_evaluable, note, verdict_of
from splatctrl_cli.jobs.compare.judged_runs import (
    JudgedRun,
    JudgedRuns,
    WorstState,
    read_baseline,
    read_judged,
    scales,
    worst_state,
    write_baseline,
)
from splatctrl_cli.jobs.running.progress import SILENT, Progress

MOST_NAMES = 5  # in an error
REGRESSION = "regression"
ROUNDING = 1e-9  # relative: baselines have nine digits


class Change(StrEnum):
    """Change of a figure or verdict."""

    WORSE = "worse"
    BETTER = "better"
    SAME = "same"
    OTHER = "other"  # neither better nor worse


@dataclass(frozen=True, kw_only=True)
class CompareRequest:
    """Comparison of two folders, the earlier first, or one with the baseline `against`.

    update_baseline: file to write from the last, or only, one of `runs`.
    """

    runs: tuple[Path, ...]
    against: Path | None = None
    update_baseline: Path | None = None


@dataclass(frozen=True, kw_only=True)
class FigureChange:
    """Figure of one run; `after` is None if the figure lost its value.

    allowed: tolerance, in `unit`. share: harm in tolerances. where: worst state of a replay.
    """

    run: str
    recording: str
    job: str
    metric: str
    before: float
    after: float | None
    unit: str
    better: Better
    allowed: float
    change: Change
    share: float
    where: WorstState | None = None

    @property
    def sentence(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.after is None:
            return f"from {self.before:.6g}{unit} to no value in {self.recording}"
        off = abs(self.after - self.before)
        words = f"from {self.before:.6g} to {self.after:.6g}{unit} in {self.recording}"
        return f"{words} ({off:.3g} {self.change}, allowed {self.allowed:.3g})"


@dataclass(frozen=True, kw_only=True)
class JobChange:
    """Figure of a job over the recordings: mean harm, and the worst recording."""

    job: str
    metric: str
    harm: MeanChange
    change: Change
    worst: FigureChange


@dataclass(frozen=True, kw_only=True, repr=False)
class CompareResult(JudgedResult):
    """Changes of figures, verdicts and jobs, regressions first.

    verdicts: run, recording, change, and labels before and after. jobs: changes over enough recordings, which decide
    in place of single figures. differences: settings, versions and inputs, before and after. only_before, only_after:
    runs not compared.
    """

    verdicts: tuple[Mapping[str, str], ...]
    figures: tuple[FigureChange, ...]
    jobs: tuple[JobChange, ...]
    differences: Mapping[str, tuple[str, str]]
    only_after: tuple[str, ...]
    only_before: tuple[str, ...] = ()
    baseline: Path | None = None

    def as_dict(self) -> dict[str, Any]:
        return {
            "metrics": dict(self.metrics),
            "verdicts": list(self.verdicts),
            "figures": [
                asdict(one) | {"share": one.share if math.isfinite(one.share) else None} for one in self.figures
            ],
            "jobs": [
                {
                    "job": one.job,
                    "metric": one.metric,
                    "change": one.change,
                    **asdict(one.harm),
                    "worst": one.worst.run,
                }
                for one in self.jobs
            ],
            "differences": {name: list(values) for name, values in self.differences.items()},
            "only_after": list(self.only_after),
            "only_before": list(self.only_before),
            "baseline": None if self.baseline is None else str(self.baseline),
        }


def compare(request: CompareRequest, progress: Progress = SILENT) -> CompareResult:
    """Compare, and write a requested baseline.

    Raises UsageError for a wrong number of runs, InputError for unreadable or unlike runs.
    """
    num_needed = 1 if request.against is not None else 2
    refuse_if(
        len(request.runs) != num_needed and not (len(request.runs) == 1 and request.update_baseline is not None),
        f"compare: expected two runs, or one and --against, got {len(request.runs)}",
        error=UsageError,
    )
    after = read_judged(request.runs[-1])
    before = read_baseline(request.against) if request.against is not None else read_judged(request.runs[0])
    _check_alike(before, after)
    result = _compare(before, after)
    if request.update_baseline is not None:
        write_baseline(request.update_baseline, after)
        progress.log(f"wrote {request.update_baseline}")
    result = replace(result, baseline=request.update_baseline)
    return replace(result, document=result.as_dict())


def _check_alike(before: JudgedRuns, after: JudgedRuns) -> None:
    refuse_if(
        before.kind != after.kind, f"{after.path}: expected a {before.kind} like {before.path}, got a {after.kind}"
    )
    refuse_if(
        before.kind == "run" and before.runs.keys() != after.runs.keys(),
        f"{after.path}: expected a run of {', '.join(before.runs)}, as {before.path} is, got one of"
        f" {', '.join(after.runs)}",
    )
    common = [name for name in before.runs if name in after.runs]
    expected, got = (_list_names([*judged.runs]) or "none" for judged in (before, after))
    refuse_if(
        not common,
        f"{after.path}: expected some of the runs of {before.path} ({expected}), got {got}",
        remedy="compare runs of the same recordings",
    )
    for name in common:
        old, new = before.runs[name], after.runs[name]
        refuse_if(
            old.command != new.command,
            f"{after.path}: {name}: expected a run of {old.command}, got one of {new.command}",
        )
        lost = sorted(old.metrics.keys() - new.metrics.keys())
        refuse_if(
            before.is_baseline and new.outcome and lost,
            f"{before.path}: {name}: has figures that this run has not: {_list_names(lost)}",
            remedy="run it with the options of then, or write the baseline anew with --update-baseline",
        )


def _compare(before: JudgedRuns, after: JudgedRuns) -> CompareResult:
    pairs = [(old, after.runs[name]) for name, old in before.runs.items() if name in after.runs]
    only_before = tuple(sorted(before.runs.keys() - after.runs.keys()))
    verdicts = [change for old, new in pairs if (change := _verdict_change(old, new)) is not None]
    changes = [change for old, new in pairs for change in _figure_changes(old, new)]
    jobs = sorted(_job_changes(changes), key=lambda one: -one.worst.share)
    by_jobs = {(one.job, one.metric) for one in jobs}
    worse = [one for one in changes if one.change is Change.WORSE]
    alone = [one for one in worse if (one.job, one.metric) not in by_jobs or one.after is None]
    only_after = tuple(sorted(after.runs.keys() - before.runs.keys()))
    metrics = {
        "num_runs": len(pairs),
        "num_verdicts": sum(bool(old.outcome and new.outcome) for old, new in pairs),
        "num_figures": sum(one.better is not Better.NEITHER for one in changes),
        "num_verdicts_worse": sum(one["change"] is Change.WORSE for one in verdicts),
        "num_verdicts_better": sum(one["change"] is Change.BETTER for one in verdicts),
        "num_worse": len(alone) + sum(one.change is Change.WORSE for one in jobs),
        "num_better": sum(one.change is Change.BETTER for one in changes),
    }
    num_figures, num_verdicts = metrics["num_figures"], metrics["num_verdicts"]
    counted = f"figures on both sides: {num_figures}, verdicts: {num_verdicts}, runs: {metrics['num_runs']}"
    reasons = [
        note(criterion="comparison", sentence=counted)
        if num_figures or num_verdicts
        else not_evaluable(criterion="comparison", sentence="no run has a verdict or a figure on both sides"),
        *_verdict_reasons(verdicts, after),
        *_regressions(alone, jobs, after.kind),
        *(
            note(criterion="runs", sentence=f"only in {side.path}: {_list_names(names)}")
            for side, names in ((before, only_before), (after, only_after))
            if names
        ),
    ]
    return CompareResult(
        verdict=verdict_of(
            "compare",
            reasons,
            scope=f"{before.path} -> {after.path}",
            passed="no regression",
            notes=[f"not compared, only in {before.path}: {_list_names(only_before)}"] if only_before else [],
            counts=metrics,
        ),
        verdicts=tuple(verdicts),
        figures=tuple(
            sorted(
                (one for one in changes if one.change is not Change.SAME),
                key=lambda one: (one.change is not Change.WORSE, -one.share, one.metric, one.run),
            )
        ),
        jobs=tuple(jobs),
        differences=_differences(pairs),
        only_after=only_after,
        only_before=only_before,
        metrics=metrics,
    )


def _verdict_change(old: JudgedRun, new: JudgedRun) -> dict[str, str] | None:
    is_other = old.is_green != new.is_green
    if not is_other and (old.outcome, old.label) == (new.outcome, new.label):
        return None
    change = Change.OTHER if not is_other else Change.WORSE if old.is_green else Change.BETTER
    return {
        "run": new.name,
        "recording": new.recording,
        "before": old.label,
        "after": new.label,
        "change": change,
    }


def _figure_changes(old: JudgedRun, new: JudgedRun) -> Iterator[FigureChange]:
    for metric, before in old.metrics.items():
        if before is None or metric not in new.metrics or not new.outcome:
            continue
        scale, after = scales()[new.command][metric], new.metrics[metric]
        change, share = _judge(scale, before, after)
        yield FigureChange(
            run=new.name,
            recording=new.recording,
            job=new.job,
            metric=metric,
            before=before,
            after=after,
            unit=scale.unit,
            better=scale.better,
            allowed=scale.tolerance(before),
            change=change,
            share=share,
            where=worst_state(new.folder, metric) if change is Change.WORSE and after is not None else None,
        )


def _judge(scale: Scale, before: float, after: float | None) -> tuple[Change, float]:
    if after is None:
        return (Change.OTHER, 0.0) if scale.better is Better.NEITHER else (Change.WORSE, math.inf)
    harm, allowed = scale.harm(before, after), scale.tolerance(before)
    if scale.better is Better.NEITHER:
        return (Change.SAME if math.isclose(before, after, rel_tol=ROUNDING) else Change.OTHER), 0.0
    if abs(harm) <= allowed + ROUNDING * abs(before):
        return Change.SAME, harm / allowed if allowed else 0.0
    return (Change.WORSE if harm > 0 else Change.BETTER), harm / allowed if allowed else math.copysign(math.inf, harm)


def _job_changes(figure_changes: Sequence[FigureChange]) -> Iterator[JobChange]:
    by_job: dict[tuple[str, str], list[FigureChange]] = {}
    for one in figure_changes:
        if one.better is not Better.NEITHER and one.after is not None:
            by_job.setdefault((one.job, one.metric), []).append(one)
    for (job, metric), changes in by_job.items():
        sign = 1.0 if changes[0].better is Better.LOWER else -1.0
        harm = mean_change([sign * (one.after - one.before) for one in changes if one.after is not None])
        if harm is None:
            continue
        allowed = sum(one.allowed for one in changes) / len(changes)
        is_worse, is_better = harm.low > 0 and harm.mean > allowed, harm.high < 0 and -harm.mean > allowed
        change = Change.WORSE if is_worse else Change.BETTER if is_better else Change.SAME
        yield JobChange(
            job=job, metric=metric, harm=harm, change=change, worst=max(changes, key=lambda one: one.share)
        )


def _verdict_reasons(verdicts: Sequence[Mapping[str, str]], after: JudgedRuns) -> Iterator[Reason]:
    for one in verdicts:
        name = f"verdict of {one['run']}"
        words = f"changed from '{one['before']}' to '{one['after']}'"
        if one["change"] is not Change.WORSE:
            better = ", an improvement" if one["change"] is Change.BETTER else ""
            yield note(criterion=name, sentence=words + better)
            continue
        why = next((reason for reason in after.runs[one["run"]].reasons if reason["outcome"] != "passed"), None)
        yield failed(
            criterion=name,
            sentence=words if why is None else f"{words}: {why['criterion']}: {why['sentence']}",
            time_s=None if why is None else why["time_s"],
            place=None if why is None or why["place"] is None else tuple(why["place"]),
            who=one["recording"],
            cause="" if why is None else why["cause"],
            remedy="" if why is None else why["remedy"],
            label=REGRESSION,
        )


def _regressions(figures: Sequence[FigureChange], jobs: Sequence[JobChange], kind: str) -> Iterator[Reason]:
    """Reasons for figures that got worse, the largest harm first; a note on single recordings."""
    weighed = [
        *((-one.share, one.metric, _figure_reason(one, kind)) for one in figures),
        *((-one.worst.share, one.metric, _job_reason(one)) for one in jobs if one.change is Change.WORSE),
    ]
    yield from (reason for *_, reason in sorted(weighed, key=lambda one: one[:2]))
    single = [one for one in jobs if one.change is not Change.WORSE and one.worst.change is Change.WORSE]
    more = f"; and {len(single) - 1} more figures" if len(single) > 1 else ""
    for one in single[:1]:
        yield note(
            criterion="single recordings", sentence=f"{one.metric} of {one.worst.run}: {one.worst.sentence}{more}"
        )


def _figure_reason(one: FigureChange, kind: str) -> Reason:
    return failed(
        criterion=one.metric if kind == "run" else f"{one.metric} of {one.run}",
        sentence=one.sentence,
        value=one.after,
        threshold=one.before + (one.allowed if one.better is Better.LOWER else -one.allowed),
        unit=one.unit,
        time_s=None if one.where is None else one.where.time_s,
        who=one.recording,
        cause="" if one.where is None else str(one.where),
        label=REGRESSION,
    )


def _job_reason(one: JobChange) -> Reason:
    harm, worst, unit = one.harm, one.worst, f" {one.worst.unit}" if one.worst.unit else ""
    words = f"{one.job}: {one.metric} is worse by {harm.mean:.3g}{unit} in the mean of {harm.num_pairs} recordings"
    interval = f"{100 * CONFIDENCE:g} % interval {harm.low:.3g} to {harm.high:.3g}"
    return failed(
        criterion=f"{one.metric} of {one.job}",
        sentence=f"{words} ({interval}); most in {worst.recording}, {worst.before:.6g} to {worst.after:.6g}{unit}",
        value=harm.mean,
        threshold=0.0,
        unit=worst.unit,
        time_s=None if worst.where is None else worst.where.time_s,
        who=worst.recording,
        cause="" if worst.where is None else str(worst.where),
        count=harm.num_pairs,
        label=REGRESSION,
    )


def _differences(pairs: Sequence[tuple[JudgedRun, JudgedRun]]) -> dict[str, tuple[str, str]]:
    differing: dict[str, tuple[str, str]] = {}
    for old, new in pairs:
        for name, value in old.settings.items():
            values = str(value), str(new.settings.get(name, value))
            if values[0] != values[1]:
                differing.setdefault(name, values)
    return differing


def _list_names(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMES
    return ", ".join(names[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
