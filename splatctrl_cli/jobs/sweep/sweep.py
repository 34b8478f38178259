"""A sweep: replay with other values until the verdict flips."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import NotEvaluableError, UsageError, refuse_faults, refuse_if
from splatctrl_cli.evaluate.verdict import EXIT_CODES, Outcome, Result
from splatctrl_cli.files.output import MARKERS, check_can_be_written, write_durably, write_json
from splatctrl_cli.jobs.batch.batch import scheduling, write_batch
from splatctrl_cli.jobs.batch.graph import CommandLine, Node, nodes_of
from splatctrl_cli.jobs.batch.ledger import FILE as BATCH
from splatctrl_cli.jobs.batch.ledger import Ledger, Run
from splatctrl_cli.jobs.batch.run import ERROR, SKIPPED, Scheduler
from splatctrl_cli.jobs.batch.suite import Recording, Suite
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.runs.run_folder import REPLAY, RunFolder, open_run
from splatctrl_cli.jobs.sweep.keys import Chain, Key, chain_of, key_of
from splatctrl_cli.jobs.sweep.search import Flip, LeastChange, find_flip, find_least

FORMAT, VERSION = "splatctrl-sweep", 1
TOLERANCE = 1 / 64  # of a range
FILE = "sweep.json"
REFUSED, BY_ITS_VALUES = "refused", (2, 4)  # an outcome, and the exit codes it stands for


@dataclass(frozen=True, kw_only=True)
class SweepRequest:
    """Repetitions of a replay over ranges KEY=A:B.

    tolerance: distance of a flip's two sides, as a share of the range. out: an earlier sweep there is continued.
    workers: number of parallel runs. dask: address of a Dask scheduler.
    """

    replay: Path
    over: Sequence[str]
    out: Path = Path("sweep")
    tolerance: float = TOLERANCE
    workers: int = 1
    dask: str | None = None


@dataclass(frozen=True, kw_only=True)
class Tried:
    """A run of the sweep: values by key, result, and folder.

    outcome: of the verdict, or REFUSED if a command rejected the values or the changed recording.
    """

    values: Mapping[str, float]
    outcome: str
    label: str
    sentence: str
    folder: str


@dataclass(frozen=True, kw_only=True)
class KeyFlip(Flip[Tried]):
    """Effect of one key alone: runs at both ends, and around the flip."""

    key: Key

    @property
    def sentence(self) -> str:
        unit = f" {self.key.unit}" if self.key.unit else ""
        name, num = self.key.name, len(self.tried)
        a, b, labels = self.start.values[name], self.end.values[name], [each.label.upper() for each in self.tried]
        if self.last is None or self.first is None:
            every = " or ".join(dict.fromkeys(labels))
            return f"{name}: no flip between {a:g} and {b:g}{unit}: {every} at all {num} values tried"
        last, first, way = self.last.values[name], self.first.values[name], "up" if b > a else "down"
        before, after = self.last.label.upper(), self.first.label.upper()
        later = labels[self.tried.index(self.first) + 1 :]
        others = [label for label in dict.fromkeys(later) if label != after]
        beyond = f"; beyond it also {', '.join(others)}" if others else ""
        return f"{name}: {before} {way} to {last:.6g}{unit}, {after} at {first:.6g}{beyond}"


@dataclass(frozen=True, kw_only=True, repr=False)
class SweepResult(Result):
    """Content of ``sweep.json``; before: verdict of the swept replay."""

    out: Path
    before: Mapping[str, Any]
    flips: Sequence[KeyFlip]
    least: LeastChange[Tried] | None = None
    num_runs: int = 0
    num_new: int = 0

    def as_dict(self) -> dict[str, Any]:
        return {
            "before": {name: self.before[name] for name in ("outcome", "label", "sentence")},
            "keys": {
                flip.key.name: {
                    "unit": flip.key.unit,
                    "is_declared_monotone": flip.key.is_monotone,
                    "sentence": flip.sentence,
                    **{name: value for name, value in asdict(flip).items() if name != "key"},
                }
                for flip in self.flips
            },
            "least": None if self.least is None else asdict(self.least),
        }


def sweep(request: SweepRequest, command_line: CommandLine, progress: Progress = SILENT) -> SweepResult:
    """Find the flips, continuing an earlier sweep.

    Raises UsageError for invalid ranges or another sweep's output, InputError for an invalid run or changed inputs,
    NotEvaluableError without a verdict to flip.
    """
    run, ranges = open_run(request.replay), ranges_of(request.over)
    refuse_if(
        run.command != REPLAY,
        f"{run.path}: a run of {run.command}, expected one of replay",
        remedy="sweep the replay of it",
        error=UsageError,
    )
    _check_judged(str(run.path), run.verdict)
    keys = {name: key_of(name) for name in ranges}
    for name, (a, b) in ranges.items():
        refuse_if(
            keys[name].is_whole and not (a.is_integer() and b.is_integer()),
            f"--over {name}: expected whole numbers, got {a:g}:{b:g}",
            error=UsageError,
        )
    chain, out = chain_of(run, keys, command_line), request.out.absolute()
    requested = {
        "run": run.path.absolute().name,
        "arguments": run.arguments,
        "inputs": dict(run.run.get("inputs", {})),
        "over": {name: list(ends) for name, ends in ranges.items()},
        "tolerance": request.tolerance,
    }
    check_can_be_written(out)
    _check_same(out, requested)
    runs = Runs(run=run, chain=chain, out=out, command_line=command_line)
    starts = {name: a for name, (a, _) in ranges.items()}
    runs.nodes_at(starts | {name: b for name, (_, b) in ranges.items()})  # refuses what an option does not take
    began = time.time()
    with (
        Ledger(out) as ledger,
        scheduling(
            ledger, command_line.entry, progress, workers=request.workers, dask=request.dask
        ) as runs.scheduler,
    ):
        _write(out, requested, {})
        start = runs.at([starts])[0]
        _check_judged(_words(starts), vars(start))
        refuse_if(
            start.outcome == REFUSED,
            f"{_words(starts)}: is refused: {start.sentence}",
            remedy="begin at a value that is not",
        )
        _check_settings(run, open_run(out / start.folder), chain)
        flips = [_vary_alone(name, starts, b, runs, request.tolerance) for name, (_, b) in ranges.items()]
        least = _vary_together(flips, ranges, runs, request.tolerance) if len(flips) > 1 else None
        num_new = sum(each.started >= began for each in runs.scheduler.runs.values())
        result = SweepResult(
            out=request.out, before=run.verdict, flips=flips, least=least, num_runs=len(runs.nodes), num_new=num_new
        )
        _write(out, requested, {"is_done": True, **result.as_dict()})
        write_batch(out, runs.suite(starts), [*runs.nodes.values()], ledger.latest(), runs.keys)
    return result


def _check_same(out: Path, requested: Mapping[str, Any]) -> None:
    file = out / FILE
    if not file.is_file():
        refuse_if(
            any((out / other).exists() for other in (*MARKERS, BATCH)),
            f"{out}: is no sweep, but something else",
            remedy="give another --out",
            error=UsageError,
        )
        return
    with refuse_faults(
        lambda _: f"{file}: is not what a sweep writes",
        *(OSError, ValueError, KeyError, TypeError, AttributeError),
        remedy="give another --out",
    ):
        before = json.loads(file.read_text(encoding="utf-8"))["asked"]
        differs = [key for key in requested if before.get(key) != requested[key]]
    refuse_if(
        differs,
        f"{out}: was begun with other settings: {', '.join(differs)}",
        remedy="give them again, or another --out",
        error=UsageError,
    )


def ranges_of(over: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Ends by name of each ``KEY=A:B``. Raises UsageError for an invalid range."""
    ranges: dict[str, tuple[float, float]] = {}
    for text in over:
        name, _, span = text.partition("=")
        try:
            start, end = (float(f"{float(each):.6g}") for each in span.split(":"))
        except ValueError:
            start = end = math.nan
        refuse_if(
            not name or not (math.isfinite(start) and math.isfinite(end)),
            f"--over {text}: expected KEY=A:B",
            remedy="write it like --over margin=0.02:0.08",
            error=UsageError,
        )
        refuse_if(start == end, f"--over {text}: both ends are {start:g}", remedy="give two values", error=UsageError)
        refuse_if(name in ranges, f"--over {text}: {name} is given twice", remedy="leave one out", error=UsageError)
        ranges[name] = start, end
    refuse_if(not ranges, "sweep: expected --over KEY=A:B, got none", remedy="say what is varied", error=UsageError)
    return ranges


def _check_judged(what: str, verdict: Mapping[str, Any]) -> None:
    refuse_if(
        verdict.get("outcome") == Outcome.NOT_EVALUABLE,
        f"{what}: there is no verdict to flip: {verdict.get('sentence')}",
        remedy="give it the evidence that it lacks first",
        error=NotEvaluableError,
    )


@dataclass(kw_only=True)
class Runs:
    """Runs of a sweep as batch nodes, each made once."""

    run: RunFolder
    chain: Chain
    out: Path
    command_line: CommandLine
    scheduler: Scheduler | None = None
    nodes: dict[str, Node] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    tried: dict[tuple[float, ...], Tried] = field(default_factory=dict)

    def suite(self, values: Mapping[str, float]) -> Suite:
        name = f"{self.run.path.absolute().name}-swept"
        return Suite(
            name=name,
            folder=Path.cwd(),
            out=self.out,
            recordings=(Recording(name=name, paths=(self.run.path,)),),
            jobs=self.chain.jobs(values),
        )

    def nodes_at(self, values: Mapping[str, float]) -> list[Node]:
        """Nodes at values, the replay last. Raises UsageError for a rejected value."""
        return nodes_of(self.suite(values), self.out, self.command_line)

    def at(self, points: Sequence[Mapping[str, float]]) -> list[Tried]:
        """Make the runs at points, in parallel. Raises InputError if a run fails."""
        new = {tuple(point.values()): point for point in points if tuple(point.values()) not in self.tried}
        new_nodes = {values: self.nodes_at(point) for values, point in new.items()}
        nodes: dict[str, Node] = {}
        for node in (node for each in new_nodes.values() for node in each):
            refuse_if(
                nodes.setdefault(node.name, self.nodes.get(node.name, node)).words != node.words,
                f"two runs are called {node.name}",
                remedy="vary fewer keys at once",
                error=UsageError,
            )
        assert self.scheduler is not None
        runs = self.scheduler.run(list(nodes.values())) if nodes else {}
        self.nodes |= nodes
        self.keys |= self.scheduler.keys
        for values, each in new_nodes.items():
            self.tried[values] = self._read_tried(new[values], [runs[node.name] for node in each])
        return [self.tried[tuple(point.values())] for point in points]

    def _read_tried(self, values: Mapping[str, float], runs: Sequence[Run]) -> Tried:
        """Read a run's result. Raises InputError if it failed for another cause than its values."""
        last, unknown = runs[-1], str(Outcome.NOT_EVALUABLE)
        tried = partial(Tried, values=dict(values))
        if not last.outcome and last.exit_code == EXIT_CODES[Outcome.NOT_EVALUABLE]:
            return tried(outcome=unknown, label=unknown, sentence=last.sentence, folder=last.out)
        if last.outcome and last.state not in (ERROR, SKIPPED):
            return tried(outcome=last.outcome, label=last.label, sentence=last.sentence, folder=last.out)
        wrong = next(run for run in runs if run.state in (ERROR, SKIPPED) or run is last)
        refuse_if(
            wrong.cause or wrong.exit_code not in BY_ITS_VALUES,
            f"{_words(values)}: {wrong.job} came to no verdict: {wrong.cause or wrong.sentence}",
            remedy=f"see {self.out / wrong.log}",
        )
        return tried(outcome=REFUSED, label=REFUSED, sentence=f"{wrong.job}: {wrong.sentence}", folder="")


def _check_settings(run: RunFolder, again: RunFolder, chain: Chain) -> None:
    varied = {option.removeprefix("set.") for key in chain.keys.values() for option in key.options.values()}
    differs = [
        f"{section}.{name}"
        for section, values in run.run.get("config", {}).items()
        for name, value in values.items()
        if f"{section}.{name}" not in varied and again.run["config"].get(section, {}).get(name) != value
    ]
    refuse_if(
        differs,
        f"{run.path}: made again it has other settings: {', '.join(differs[:5])}",
        remedy="its --config or the program has changed: make the run again and sweep that",
    )


def _words(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name}={value:g}" for name, value in values.items())


def _vary_alone(name: str, starts: Mapping[str, float], end: float, runs: Runs, tolerance: float) -> KeyFlip:
    key, at = runs.chain.keys[name], dict[float | None, Tried]()

    def judge(values: Sequence[float]) -> list[str]:
        at.update(zip(values, runs.at([{**starts, name: value} for value in values]), strict=True))
        return [at[value].outcome for value in values]

    flip = find_flip(
        judge,
        starts[name],
        end,
        tolerance=tolerance * abs(end - starts[name]),
        is_whole=key.is_whole,
        is_monotone=key.is_monotone,
    )
    return KeyFlip(
        key=key,
        start=at[flip.start],
        end=at[flip.end],
        last=at.get(flip.last),
        first=at.get(flip.first),
        tried=[at[value] for value in flip.tried],
        is_monotone=flip.is_monotone,
        spacing=flip.spacing,
    )


def _vary_together(
    flips: Sequence[KeyFlip], ranges: Mapping[str, tuple[float, float]], runs: Runs, tolerance: float
) -> LeastChange[Tried] | None:
    def values_at(shares: Sequence[float]) -> dict[str, float]:
        values = {n: a + (b - a) * s for (n, (a, b)), s in zip(ranges.items(), shares, strict=True)}
        return {n: float(round(v)) if runs.chain.keys[n].is_whole else float(f"{v:.6g}") for n, v in values.items()}

    def share(flip: KeyFlip) -> float | None:
        a, b = ranges[flip.key.name]
        return None if flip.first is None else (flip.first.values[flip.key.name] - a) / (b - a)

    least = find_least(
        lambda points: [each.outcome for each in runs.at([values_at(point) for point in points])],
        [share(flip) for flip in flips],
        tolerance=tolerance,
    )
    if least is None:
        return None
    last, first = runs.at([values_at(least.last), values_at(least.first)])
    return LeastChange(length=float(f"{least.length:.6g}"), last=last, first=first)


def _write(out: Path, requested: Mapping[str, Any], answer: Mapping[str, Any]) -> None:
    document = {"format": FORMAT, "version": VERSION, "is_done": False, "asked": requested, **answer}
    write_durably(out / FILE, lambda path: write_json(path, document))
