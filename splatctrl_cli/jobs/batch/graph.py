"""Graph of a suite: one node per recording, job and variant."""

import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, ClassVar, Protocol

from splatctrl_cli.errors import UsageError, refuse_faults, refuse_if
from splatctrl_cli.jobs.batch.suite import Job, Recording, Suite, Table, jobs_for

RECORDING, NAME = "recording", "name"  # placeholders {…} in an option, besides job names
ENDINGS = {"ingest": ".capture", "export": ".ply"}  # of the output's name
CAPTURE, SCENE = "ingest", "reconstruct"
ROLES: Mapping[str, Mapping[str, str]] = {  # defaults of options: the only job of a command, or the recording
    "simulate": {},
    "ingest": {"source": RECORDING},
    "check": {"source": RECORDING},
    "info": {"path": RECORDING},
    "reconstruct": {"source": CAPTURE},
    "export": {"scene": SCENE},
    "sdf-bake": {"scene": SCENE},
    "score": {"scene": SCENE, "reference": CAPTURE},
    "replay": {"log": CAPTURE, "scene": SCENE},
}
COMMANDS = tuple(ROLES)
TABLES = ("set", "perturb")  # options a matrix varies by entry: set.SECTION.KEY, perturb.NAME
_PLACE = re.compile(r"\{([\w.+-]+)\}")

Variant = Mapping[str, Any]


class CommandLine(Protocol):
    """Command line of batch nodes; `entry`: MODULE:FUNCTION from words to exit code."""

    entry: ClassVar[str]

    def parsed(self, command: str, options: Table, folder: Path) -> tuple[tuple[str, ...], tuple[Path, ...]]:
        """Words for options with paths relative to `folder`, and the files they read.

        Raises UsageError for an unknown option.
        """

    def options_of(self, words: Sequence[str]) -> dict[str, Any]:
        """Options in a command's words, as for `parsed`, without options that a batch sets."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """Job on one recording; name: RECORDING/JOB.

    variant: matrix choices of this and earlier jobs, by JOB.OPTION. words: the command line. inputs: files that
    decide the result. needs: nodes to run first. out: None for a command that only prints.
    """

    name: str
    recording: str
    job: Job
    words: tuple[str, ...]
    variant: Variant = field(default_factory=dict)
    inputs: tuple[Path, ...] = ()
    needs: tuple[str, ...] = ()
    out: Path | None = None


def nodes_of(suite: Suite, out: Path, command_line: CommandLine) -> list[Node]:
    """All nodes, by recording, each after the nodes it needs.

    Raises UsageError for a cycle, an unknown placeholder or option.
    """
    nodes: list[Node] = []
    for recording in sorted(suite.recordings, key=lambda each: each.name):
        jobs = jobs_for(recording, suite.jobs, COMMANDS)
        full_jobs = {job.name: _add_roles(job, jobs, recording) for job in jobs}
        nodes += _nodes_of(recording, _sort_jobs(full_jobs, recording), suite.folder, out, command_line)
    return nodes


def select_shard(nodes: Sequence[Node], shard: tuple[int, int]) -> list[Node]:
    index, count = shard
    chosen = set(list(dict.fromkeys(node.recording for node in nodes))[index - 1 :: count])
    return [node for node in nodes if node.recording in chosen]


def columns_of(columns: Iterable[tuple[str, str]], jobs: Sequence[str]) -> list[str]:
    """Distinct columns of (job, column) pairs, in the order of `jobs`."""
    job_of = {name: job for job, name in columns}
    return sorted(job_of, key=lambda name: jobs.index(job_of[name]) if job_of[name] in jobs else len(jobs))


def _add_roles(job: Job, jobs: Sequence[Job], recording: Recording) -> Job:
    set_options = {*job.options, *job.matrix}
    set_options |= {"field", "lockstep"} & set_options and {"scene"}  # with either, no scene is needed
    roles = {option: role for option, role in ROLES[job.command].items() if option not in set_options}
    if job.command in {"reconstruct", "score"} and "dtu" in set_options:
        roles = {option: role for option, role in roles.items() if option == "scene"}
    filled = {option: _fill(job, role, jobs, recording) for option, role in roles.items()}
    return replace(job, options={**filled, **job.options})


def _where(job: Job, recording: Recording) -> str:
    return f"[jobs.{job.name}] of {recording.name}"


def _fill(job: Job, role: str, jobs: Sequence[Job], recording: Recording) -> str:
    where = _where(job, recording)
    makers = [other.name for other in jobs if other.command == role and other.name != job.name]
    example = " or ".join(f"'{{{name}}}'" for name in makers)
    refuse_if(
        len(makers) > 1,
        f"{where}: {len(makers)} jobs of {role} come before it",
        remedy=f"say {example}",
        error=UsageError,
    )
    refuse_if(
        not makers and role == SCENE,
        f"{where}: expected a job of {SCENE} before it",
        remedy="or give scene = PATH",
        error=UsageError,
    )
    return f"{{{makers[0] if makers else RECORDING}}}"


def _sort_jobs(jobs: Mapping[str, Job], recording: Recording) -> list[tuple[Job, tuple[str, ...]]]:
    needs = {name: _needs(job, jobs, recording) for name, job in jobs.items()}
    with refuse_faults(
        lambda error: f"[jobs]: {' needs '.join(error.args[1][::-1])}",
        CycleError,
        remedy="break the circle",
        error=UsageError,
    ):
        TopologicalSorter(needs).prepare()
    ordered: dict[str, None] = {}

    def add(name: str) -> None:
        for need in needs[name]:
            add(need)
        ordered.setdefault(name)

    for name in jobs:
        add(name)
    return [(jobs[name], needs[name]) for name in ordered]


def _needs(job: Job, jobs: Mapping[str, Job], recording: Recording) -> tuple[str, ...]:
    texts = json.dumps([job.options, job.matrix], ensure_ascii=False, default=str)
    needs = dict.fromkeys(_PLACE.findall(texts))
    for place in needs:
        known = (RECORDING, NAME, *jobs)
        refuse_if(
            place not in known,
            f"{_where(job, recording)}: {{{place}}} is no job",
            remedy=f"known here: {', '.join(known)}",
            error=UsageError,
        )
    return tuple(place for place in needs if place in jobs)


def _nodes_of(
    recording: Recording,
    jobs: Sequence[tuple[Job, tuple[str, ...]]],
    folder: Path,
    out: Path,
    command_line: CommandLine,
) -> list[Node]:
    nodes_by_job: dict[str, list[Node]] = {}
    for job, needs in jobs:
        nodes_by_job[job.name] = []
        for before in itertools.product(*(nodes_by_job[name] for name in needs)):
            inherited = _join([node.variant for node in before])
            if inherited is None:
                continue
            for picked in itertools.product(*job.matrix.values()):
                chosen = dict(zip(job.matrix, picked, strict=True))
                variant = {**inherited, **{f"{job.name}.{option}": value for option, value in chosen.items()}}
                suffix = _suffix(variant, (each for each, _ in jobs))
                place = re.sub(r"[^\w.+=-]", "_", job.name + suffix)[:120]
                only_prints = job.command in ("check", "info")
                its = None if only_prints else out / recording.name / (place + ENDINGS.get(job.command, ""))
                values: dict[str, Any] = {
                    **{each.job.name: str(each.out) for each in before},
                    RECORDING: [str(path) for path in recording.paths],
                    NAME: recording.name,
                }
                options = _fill_places(_merge(job.options, chosen), values.__getitem__)
                options |= {} if its is None else {"out": str(its), "force": True, "resume": True}
                try:
                    words, read = command_line.parsed(job.command, options, folder)
                except UsageError as error:
                    raise UsageError(f"{_where(job, recording)}: {error.message}", remedy=error.remedy) from None
                outs = [each.out for each in before if each.out is not None]
                inputs = (path for path in read if not any(out in (path, *path.parents) for out in outs))
                nodes_by_job[job.name].append(
                    Node(
                        name=f"{recording.name}/{place}",
                        recording=recording.name,
                        job=job,
                        words=words,
                        variant=variant,
                        inputs=tuple(inputs),
                        needs=tuple(each.name for each in before),
                        out=its,
                    )
                )
    nodes = [node for each in nodes_by_job.values() for node in each]
    by_name: dict[str, Node] = {}
    for node in nodes:
        refuse_if(
            by_name.setdefault(node.name.lower(), node) is not node,
            f"two outputs are called {node.name}",
            remedy="rename a job, or a value of its matrix",
            error=UsageError,
        )
    return nodes


def _short(values: Sequence[Any]) -> list[str]:
    parts = [text_of(value).strip("/").split("/") for value in values]
    least = min(map(len, parts)) - 1
    first = min(_num_alike(parts), least)
    last = min(_num_alike([each[::-1] for each in parts]), least - first)
    return ["/".join(each[first : len(each) - last]) for each in parts]


def _num_alike(lists: Sequence[Sequence[str]]) -> int:
    return sum(1 for _ in itertools.takewhile(lambda each: len(set(each)) == 1, zip(*lists, strict=False)))


def text_of(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(text_of, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _suffix(variant: Variant, jobs: Iterable[Job]) -> str:
    chosen = {
        f"{job.name}.{option}": (option.removeprefix("set."), values)
        for job in jobs
        for option, values in job.matrix.items()
        if f"{job.name}.{option}" in variant
    }
    count = Counter(option for option, _ in chosen.values())
    suffix = ""
    for key, value in variant.items():
        option, values = chosen[key]
        text = next(text for each, text in zip(values, _short(values), strict=True) if each is value)
        suffix += f"+{option if count[option] == 1 else key}={text}"
    return suffix


def _join(variants: Sequence[Variant]) -> Variant | None:
    """Union of variants; None if two choose differently."""
    joined: dict[str, Any] = {}
    for variant in variants:
        if any(joined.setdefault(key, value) != value for key, value in variant.items()):
            return None
    return joined


def _merge(options: Table, chosen: Variant) -> dict[str, Any]:
    """Add matrix choices to options; ``set.SECTION.KEY`` and ``perturb.NAME`` add to their table."""
    merged = dict(options)
    for key, value in chosen.items():
        table, dot, entry = key.partition(".")
        if dot and table in TABLES:
            before = merged.get(table, {})
            merged[table] = {**(before if isinstance(before, Mapping) else {}), entry: value}
        else:
            merged[key] = value
    return merged


def _fill_places(value: Any, filled: Callable[[str], Any]) -> Any:
    if isinstance(value, str):
        if alone := _PLACE.fullmatch(value):
            return filled(alone[1])
        return _PLACE.sub(lambda match: one[0] if isinstance(one := filled(match[1]), list) else str(one), value)
    if isinstance(value, Mapping):
        return {key: _fill_places(each, filled) for key, each in value.items()}
    return [_fill_places(each, filled) for each in value] if isinstance(value, list) else value
