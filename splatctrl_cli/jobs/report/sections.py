"""Sections of a page on one run, and its changes."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatctrl_cli.config import Config
from splatctrl_cli.control.columns import INTERVENTIONS, SHOWN
from splatctrl_cli.jobs.compare.compare import Change, CompareRequest, FigureChange, compare
from splatctrl_cli.jobs.runs.run_folder import RunFolder
from splatctrl_cli.report.page import Cell, Row, RunSection, Table, picture
from splatctrl_cli.report.timeline import legend, timeline

PASSED = "passed"
WIDTH = 900  # pixels of a picture at most
PICTURES = {  # captions by start of file name
    "worst_": "a camera image at small clearance, with the arm as replayed",
    "clearance": "clearance over time",
    "evidence": "what the cameras knew of the space within the margin of the arm",
    "commands": "what the controller commanded",
    "open_loop": "commanded less logged velocity",
    "divergence": "distance of the driven arm from the log",
    "methods": "clearance of every method",
    "slices": "slices of the distance",
    "gradient": "length of the gradient",
    "probability": "probability of collision",
    "reliability": "predicted and true collisions",
}


def section_of(
    run: RunFolder, *, anchor: str, title: str, most_pictures: int | None = None, width: int = WIDTH
) -> RunSection:
    """Section of a run without its 3-D scene; width: of the pictures [px]."""
    verdict = run.verdict
    states = run.states
    replayed: dict[str, Any] = {}
    if states is not None and len(states.seconds):
        described = (run.json_of("summary.json") or {}).get("about", {})
        drawn = timeline(
            states.seconds, states.clearance, float(described.get("margin", 0.0)), _events(run), states.rungs
        )
        replayed = {"timeline": drawn, "legend": legend(states.clearance)}
    lines = (run.json_of("summary.json") or {}).get("when_and_why", []) if states is not None else []
    passed = _reasons(verdict, holds=True)
    figures = [((name, value), "") for name, value in run.metrics.items() if not isinstance(value, dict | list)]
    return RunSection(
        anchor=anchor,
        title=title,
        state=str(verdict.get("outcome", "done")),
        sentence=str(verdict.get("sentence", f"{run.command}: done; it judges nothing")),
        reasons=_reasons(verdict, holds=False),
        lines=[str(line) for line in lines],
        pictures=_pictures(run, most_pictures, width, has_timeline=states is not None),
        details=[
            *_separation(run),
            *([replace(passed, title=f"Criteria that hold ({len(passed.rows)})")] if passed.rows else []),
            Table(title="Figures", header=("name", "value"), rows=figures[:400]),
            _settings(run),
            _provenance(run),
        ],
        **replayed,
    )


def _reasons(verdict: Mapping[str, Any], *, holds: bool) -> Table:
    rows = list[Row]()
    for reason in verdict.get("reasons", []):
        when = "" if reason["time_s"] is None else f" at {reason['time_s']:.2f} s"
        words = "; ".join(part for part in (reason["sentence"] + when, reason["cause"], reason["remedy"]) if part)
        if (reason["outcome"] == PASSED) is holds:
            rows.append(((reason["criterion"], reason["outcome"], words), reason["outcome"]))
    return Table(header=("criterion", "outcome", "found"), rows=rows)


def _separation(run: RunFolder) -> list[Table]:
    separation = run.json_of("separation.json")
    if separation is None:
        return []
    figures = [((each["meaning"], each["value"], each["unit"]), "") for each in separation["figures"]]
    assumed_first = sorted(separation["inputs"], key=lambda each: str(each["source"]))
    inputs = [
        ((each["symbol"], each["value"], each["unit"], each["source"], each["how"]), "") for each in assumed_first
    ]
    return [
        Table(
            title="Separation from people",
            header=("figure", "value", "unit"),
            rows=figures,
            text=f"{separation['standard']}. {separation['claim']}",
        ),
        Table(
            title="Inputs of the separation: measured, declared or assumed",
            header=("input", "value", "unit", "source", "how"),
            rows=inputs,
        ),
    ]


def _events(run: RunFolder) -> dict[str, list[tuple[float, float]]]:
    intervals: dict[str, list[tuple[float, float]]] = {}
    shown = [event for event in (run.json_of("events.json") or {}).get("events", []) if event["source"] in SHOWN]
    for event in sorted(shown, key=lambda event: event["kind"] in INTERVENTIONS):
        name = f"{event['kind']}{SHOWN[event['source']]}"
        intervals.setdefault(name, []).append((float(event["start_s"]), float(event["end_s"])))
    return intervals


def _pictures(run: RunFolder, most: int | None, width: int, *, has_timeline: bool) -> list[Any]:
    files = [path for path in run.pictures() if not (has_timeline and path.name == "clearance.png")]
    files.sort(key=lambda path: not path.name.startswith("worst_"))
    words = {path: next((w for start, w in PICTURES.items() if path.name.startswith(start)), "") for path in files}
    return [picture(path, f"{path.name}: {words[path]}".removesuffix(": "), width) for path in files[:most]]


def _settings(run: RunFolder) -> Table:
    used, default = run.run.get("config", {}), Config().as_dict()
    rows = [
        ((f"{section}.{key}", json.dumps(value), json.dumps(default[section].get(key))), "")
        for section, values in used.items()
        if isinstance(values, dict) and section in default
        for key, value in values.items()
        if value != default[section].get(key)
    ]
    return Table(
        title="Settings",
        header=("setting", "value", "default"),
        rows=rows,
        text=f"splatctrl {shlex.join(run.arguments)}" + ("" if rows else "\nevery setting as by default"),
    )


def _provenance(run: RunFolder) -> Table:
    origin = {
        "splatctrl": run.run.get("splatctrl"),
        "python": run.run.get("python"),
        "machine": run.run.get("machine"),
        "seed": run.run.get("seed"),
        **dict(run.run.get("versions", {})),
        **{f"seconds: {name}": value for name, value in dict(run.run.get("seconds", {})).items()},
        **{f"sha256 of {name}": value for name, value in dict(run.run.get("inputs", {})).items()},
    }
    return Table(
        title="Versions and provenance", header=("what", "value"), rows=[(item, "") for item in origin.items()]
    )


HEADER = ("job", "what", "before", "now", "", "allowed", "unit", "where")
STATES: Mapping[str, str] = {Change.WORSE: "failed"}  # of a row


def changes_since(before: Path | None, after: Path, *, has_links: bool) -> tuple[list[Table], frozenset[str]]:
    """Tables of changes, the second folded, and the jobs with a regression or another verdict.

    before: a folder or baseline; None for no tables. has_links: link each job to its section. Raises InputError if
    the runs cannot be compared.
    """
    if before is None:
        return [], frozenset()
    is_folder = before.is_dir()
    comparison = compare(
        CompareRequest(runs=(before, after) if is_folder else (after,), against=None if is_folder else before)
    )

    def job(name: str) -> Cell:
        return Cell(text=name, link=name if has_links else "")

    def rows(figures: Sequence[FigureChange]) -> list[Row]:
        return [
            (
                (
                    job(one.run),
                    one.metric,
                    one.before,
                    one.after,
                    one.change,
                    one.allowed,
                    one.unit,
                    None if one.where is None else f"{one.where.time_s:.2f} s, {one.where}",
                ),
                STATES.get(one.change, ""),
            )
            for one in figures
        ]

    worse = [one for one in comparison.figures if one.change is Change.WORSE]
    better = rows([one for one in comparison.figures if one.change is Change.BETTER])
    first = [
        (
            (job(one["run"]), "verdict", one["before"], one["after"], one["change"], None, None, None),
            STATES.get(one["change"], ""),
        )
        for one in comparison.verdicts
    ]
    unlike = [(("", name, *values, "not alike", "", "", ""), "") for name, values in comparison.differences.items()]
    changed = Table(
        title="What changed",
        header=HEADER,
        rows=[*first, *rows(worse), *unlike],
        text=". ".join([comparison.verdict.sentence, *map(str, comparison.verdict.shown)]),
    )
    improved = Table(title=f"Figures that got better ({len(better)})", header=HEADER, rows=better, is_folded=True)
    tables = [changed, improved] if better else [changed]
    return tables, frozenset([one["run"] for one in comparison.verdicts] + [one.run for one in worse])
