"""Judged runs to compare: of a folder, a batch, or a baseline."""

import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.errors import UsageError, refuse_faults, refuse_if
from splatctrl_cli.evaluate import field_accuracy, score
from splatctrl_cli.evaluate.field_accuracy import FIELDS
from splatctrl_cli.evaluate.metrics import Better, Scale
from splatctrl_cli.evaluate.verdict import damage_mark
from splatctrl_cli.files.output import PARTIAL, output_path
from splatctrl_cli.jobs.bake.accuracy import SUMMARY_METRICS
from splatctrl_cli.jobs.batch.run import DONE
from splatctrl_cli.jobs.reconstruct import verdict as reconstruct_verdict
from splatctrl_cli.jobs.replay.metrics import Measure, metric_scales, shown_metrics
from splatctrl_cli.jobs.replay.request import MODES
from splatctrl_cli.jobs.robot import robot
from splatctrl_cli.jobs.runs.run_folder import BatchFolder, is_batch, open_batch, open_run, read_columns, read_object

REPLAY_FIELDS = ("exact", "barrier", "certified")
AUDIT = "audit"


@cache
def scales() -> Mapping[str, Mapping[str, Scale]]:
    by_mode = [
        metric_scales(mode, REPLAY_FIELDS, has_truth=True, has_twists=True, has_separation=True) for mode in MODES
    ]
    return {
        "reconstruct": reconstruct_verdict.GATED,
        "sdf-bake": SUMMARY_METRICS | field_accuracy.metric_scales(FIELDS),
        "score": score.SCALES,
        "replay": {name: scale for scales in by_mode for name, scale in scales.items()},
        "robot": robot.SCALES,
    }


@cache
def shown() -> Mapping[str, Measure]:
    return {name: where for mode in MODES for name, where in shown_metrics(mode, REPLAY_FIELDS).items()}


BASELINE, VERSION = "splatctrl-baseline", 1
HEAD = "# Made by splatctrl compare --update-baseline: review what changed, then commit it.\n"
ANEW = "write it anew with --update-baseline"


@dataclass(frozen=True, kw_only=True)
class JudgedRun:
    """One run with its verdict, figures and output folder.

    name: unique in its batch. job: equal for the same job on other recordings. outcome: empty without a verdict.
    is_green: the run ended as expected. settings: configuration, versions, inputs.
    """

    name: str
    recording: str
    job: str
    command: str
    outcome: str
    label: str
    is_green: bool
    metrics: Mapping[str, float | None]
    settings: Mapping[str, object] = field(default_factory=dict)
    reasons: tuple[Mapping[str, Any], ...] = ()
    folder: Path | None = None


@dataclass(frozen=True, kw_only=True)
class JudgedRuns:
    """Runs to compare, by name; kind: "run" or "batch"."""

    path: Path
    kind: str
    runs: Mapping[str, JudgedRun]
    is_baseline: bool = False


def read_judged(path: Path) -> JudgedRuns:
    """Read the folder of a judging command, audit or batch. Raises InputError for other folders."""
    has_batch, has_run = is_batch(path), (path / "run.json").is_file()
    is_begun = not has_batch and not has_run and path.with_name(path.name + PARTIAL).exists()
    refuse_if(
        path.name.endswith(PARTIAL) or is_begun,
        f"{path}: is still being written, or was interrupted",
        remedy="wait for it, or run it again",
    )
    if has_batch:
        return JudgedRuns(path=path, kind="batch", runs={run.name: run for run in _nodes_of(open_batch(path))})
    what = "no run.json and no batch.json in it" if path.is_dir() else "no such folder"
    refuse_if(not has_run, f"{path}: expected the output folder of a command or a batch, got {what}")
    run = open_run(path)
    files = sorted(path.glob("*/run.json")) if run.command == AUDIT else []
    parts = {file.parent.name: open_run(file.parent) for file in files} or {run.command: run}
    judging = {job: part for job, part in parts.items() if part.verdict and part.command in (*scales(), "demo")}
    refuse_if(
        not judging,
        f"{path}: a run of {run.command}, which judges nothing",
        remedy=f"give one of {', '.join(scales())}, {AUDIT}",
    )
    recording = path.absolute().name
    return JudgedRuns(
        path=path,
        kind="run",
        runs={
            job: _read_run(job, recording, job, part.command, part.run, part.path) for job, part in judging.items()
        },
    )


def _read_run(
    name: str, recording: str, job: str, command: str, document: Mapping[str, Any], folder: Path | None
) -> JudgedRun:
    verdict, known = document["verdict"], scales().get(command, {})
    metrics = document["metrics"] if isinstance(document.get("metrics"), dict) else {}
    return JudgedRun(
        name=name,
        recording=recording,
        job=job,
        command=command,
        outcome=verdict["outcome"],
        label=verdict["label"] + damage_mark(verdict.get("sentence"), verdict.get("exit_code")),
        is_green=verdict["outcome"] == "passed",
        metrics={
            name: float(value) if isinstance(value, int | float) and math.isfinite(value) else None
            for name, value in metrics.items()
            if name in known
        },
        settings={} if folder is None else dict(_settings(document)),
        reasons=tuple(verdict["reasons"]),
        folder=folder,
    )


def _nodes_of(batch: BatchFolder) -> Iterator[JudgedRun]:
    for ran in batch.runs:
        variant = ", ".join(f"{key}={value}" for key, value in sorted(json.loads(ran.variant).items()))
        job = f"{ran.job} ({variant})" if variant else ran.job
        command, is_green = ran.command.partition(" ")[0], ran.state == DONE
        folder, printed = batch.path / ran.out, batch.path / ran.result
        has_run = (folder / "run.json").is_file()
        document = open_run(folder).run if has_run else read_object(printed) if printed.is_file() else {}
        if ran.outcome and isinstance(document.get("verdict"), dict):
            yield replace(
                _read_run(ran.node, ran.recording, job, command, document, folder if has_run else None),
                is_green=is_green,
            )
        else:
            yield JudgedRun(
                name=ran.node,
                recording=ran.recording,
                job=job,
                command=command,
                outcome="",
                label=ran.cause or ran.state,
                is_green=is_green,
                metrics={},
            )


def _settings(document: Mapping[str, Any]) -> Iterator[tuple[str, object]]:
    for section, values in (document.get("config") or {}).items():
        if isinstance(values, dict):
            yield from ((f"{section}.{key}", value) for key, value in values.items())
        else:
            yield section, values
    named = ("seed", "splatctrl", "python", "machine")
    yield from ((name, document[name]) for name in named if name in document)
    yield from (document.get("versions") or {}).items()
    yield from ((f"input {name}", str(digest)[:12]) for name, digest in (document.get("inputs") or {}).items())


def read_baseline(path: Path) -> JudgedRuns:
    """Read a baseline. Raises InputError for another format or version, or unknown figures."""
    make = "make one with --update-baseline"
    with (
        refuse_faults(lambda error: f"{path}: cannot be read: {error.strerror}", OSError, remedy=make),
        refuse_faults(f"{path}: expected a baseline in TOML", ValueError, remedy=ANEW),
    ):
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    refuse_if(
        document.get("format") != BASELINE,
        f"{path}: expected a baseline, got another TOML file",
        remedy="give one of --update-baseline",
    )
    refuse_if(
        (file_version := document.get("version")) != VERSION,
        f"{path}: a baseline of version {file_version}, this splatctrl reads {VERSION}",
        remedy="update splatctrl" if (file_version or 0) > VERSION else ANEW,
    )
    version, runs = str(document.get("splatctrl", "")), {}
    with refuse_faults(
        lambda error: f"{path}: damaged: {type(error).__name__}: {error}",
        *(KeyError, TypeError, ValueError, AttributeError),
        remedy=ANEW,
    ):
        kind = str(document["kind"])
        for name, one in document["run"].items():
            metrics = one.pop("metrics", {})
            unknown = [metric for metric in metrics if metric not in scales().get(one["command"], {})]
            refuse_if(
                unknown, f"{path}: {name}: no figures of {one['command']}: {', '.join(unknown[:5])}", remedy=ANEW
            )
            runs[name] = JudgedRun(
                name=name,
                metrics={metric: float(value) for metric, value in metrics.items()},
                settings={"splatctrl": version},
                **one,
            )
    return JudgedRuns(path=path, kind=kind, runs=runs, is_baseline=True)


def write_baseline(path: Path, judged: JudgedRuns) -> None:
    """Write the figures that can be better or worse, sorted, one per line.

    Raises UsageError if `path` exists and is no baseline.
    """
    refuse_if(
        path.exists() and (not path.is_file() or BASELINE.encode() not in path.read_bytes()[:200]),
        f"{path}: exists, and is no baseline",
        remedy="give another --update-baseline",
        error=UsageError,
    )
    head = {"format": BASELINE, "version": VERSION, "splatctrl": __version__, "kind": judged.kind}
    lines = [HEAD, *(f"{name} = {_toml(value)}\n" for name, value in head.items())]
    for name, run in sorted(judged.runs.items()):
        lines.append(f"\n[run.{_key(name)}]\n")
        facts = {key: getattr(run, key) for key in ("recording", "job", "command", "outcome", "label", "is_green")}
        lines += [f"{key} = {_toml(value)}\n" for key, value in facts.items()]
        lines.append(f"\n[run.{_key(name)}.metrics]\n")
        for metric, value in sorted(run.metrics.items()):
            if value is not None and scales()[run.command][metric].better is not Better.NEITHER:
                lines.append(f"{_key(metric)} = {_toml(value)}\n")
    with output_path(path, force=True, is_folder=False) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return f"{value:.9g}"
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


@dataclass(frozen=True, kw_only=True)
class WorstState:
    """State by row (from 0) and time [s] in ``steps.csv``."""

    state: int
    time_s: float
    sphere: str = ""
    obstacle: str = ""

    def __str__(self) -> str:
        near = f", {self.sphere}" if self.sphere else ""
        return f"state {self.state}{near}" + (f" near {self.obstacle}" if self.obstacle else "")


def worst_state(folder: Path | None, metric: str) -> WorstState | None:
    """Replay's worst state by a metric; None if no state shows the metric."""
    where = shown().get(metric)
    if where is None or folder is None or not (folder / "steps.csv").is_file():
        return None
    columns = read_columns(folder / "steps.csv")
    badness = [_badness(where, text) for text in columns.get(where.column, ())]
    if min(badness, default=math.inf) == math.inf:
        return None
    index = badness.index(min(badness))
    nearest = columns.get(f"nearest_{where.column.removeprefix('clearance_')}")
    obstacles = columns.get("obstacle") if where.column == "clearance_exact" else None
    return WorstState(
        state=index,
        time_s=float(columns["time_s"][index]),
        sphere=nearest[index] if nearest else "",
        obstacle=obstacles[index] if obstacles else "",
    )


def _badness(where: Measure, text: str) -> float:
    """Rank a cell: smaller is worse."""
    if where.pick not in ("least", "largest"):
        return 0.0 if text == where.pick else math.inf
    if not text:
        return math.inf
    return float(text) if where.pick == "least" else -float(text)
