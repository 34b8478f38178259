"""``splatctrl batch``: a suite, its verdict, and its ledger."""

import argparse
import importlib
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from splatctrl_cli.cli.commands import build_parser
from splatctrl_cli.cli.common import Console, remarks, request_of, table
from splatctrl_cli.cli.parser import Parser
from splatctrl_cli.cli.reports import publish
from splatctrl_cli.config import load_config
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_if
from splatctrl_cli.jobs.batch.batch import (
    BatchRequest,
    BatchResult,
    batch,
    dry_run,
    plan_batch,
    suites_of,
)
from splatctrl_cli.jobs.batch.graph import TABLES, columns_of, text_of
from splatctrl_cli.jobs.batch.ledger import NAME, Ledger, Run, write_csv
from splatctrl_cli.jobs.batch.run import DONE, FAILED, describe_run
from splatctrl_cli.jobs.batch.suite import Table

PRELOADED = (  # of a runner
    *("check", "reconstruct.reconstruct", "export.export", "bake.bake", "score.score", "replay.replay"),
)
MOST_ROWS = 40  # recordings that are all printed
OWN = ("out", "force", "resume", "threads")  # options a batch gives itself
NOT_OF_A_NODE = (*OWN, "help", "help-all", "json", "verbose", "quiet", "junit", "preset")  # the last is in --set


def run(args: argparse.Namespace, console: Console) -> int:
    console.reports_to_ci = False  # it tells CI of every recording itself
    workers = args.workers or os.cpu_count() or 1
    request = request_of(BatchRequest, args, workers=workers)
    command_line = OfThisProgram(threads=max((os.cpu_count() or 1) // workers, 1))
    if args.list or args.where or args.failed or args.csv is not None:
        return _list_runs(console, args, request, command_line)
    if args.dry_run:
        planned_nodes = dry_run(request, command_line)
        rows = [(node.name, state, ", ".join(node.needs) or "-") for node, state in planned_nodes]
        commands = (f"splatctrl {shlex.join(node.words)}" for node, _ in planned_nodes)
        return console.result(
            {"nodes": [{"id": n.name, "state": s, "needs": n.needs, "words": n.words} for n, s in planned_nodes]},
            [*table(("node", "state", "needs"), rows), "", *commands],
        )
    result = batch(request, command_line, console)
    code = console.show(result, _lines(result, is_long=args.verbose > 0))
    publish(suites_of(result), junit=args.junit, is_fatal=code != 0)
    return code


@dataclass(frozen=True, kw_only=True)
class OfThisProgram:
    """Command line of nodes that run this program, each with `threads`."""

    entry: ClassVar[str] = "splatctrl_cli.cli.batch:run_words"
    threads: int

    def parsed(self, command: str, options: Table, folder: Path) -> tuple[tuple[str, ...], tuple[Path, ...]]:
        """Words for options by long name, and files among them. Raises UsageError for unknown options."""
        parser, places, words = _parser_of(command), list[str](), [command]
        values_by_name = {"threads": self.threads, **options}
        known = [name for name in values_by_name if name not in OWN or f"--{name}" in parser._option_string_actions]
        for name, action in {name: find_action(parser, command, name) for name in known}.items():
            option_words = words_of(name, action, values_by_name[name], folder)
            places += option_words if not action.option_strings else []
            words += option_words if action.option_strings else []
        words += ["--json", *(["--", *places] if places else [])]
        parsed = parser.parse_args(words[1:])
        if hasattr(parsed, "set"):
            load_config(parsed.config, parsed.set)
        values = [value for name, value in vars(parsed).items() if name != "out"]
        flat = [each for value in values for each in (value if isinstance(value, list) else [value])]
        return tuple(words), tuple(path for path in flat if isinstance(path, Path))

    def options_of(self, words: Sequence[str]) -> dict[str, Any]:
        parser = _parser_of(words[0])
        options, parsed_values = dict[str, Any](), vars(parser.parse_args([*words[1:]]))
        for action in parser._actions:
            name = max(action.option_strings, key=len, default=action.dest).removeprefix("--")
            value = parsed_values.get(action.dest)
            if name in NOT_OF_A_NODE or value is None or value == action.default:
                continue
            if name in TABLES:
                value = dict(text.partition("=")[::2] for text in value)
            options[name] = list(value) if isinstance(value, tuple) else value
        return options


def run_words(words: list[str]) -> int:
    return int(importlib.import_module("splatctrl_cli.cli.main").main(words))


def preload() -> None:
    """Import in a runner what all commands need."""
    os.environ.setdefault(
        "OPENCV_IO_MAX_IMAGE_PIXELS", str(importlib.import_module("splatctrl_cli.cli.main").MAX_PIXELS)
    )
    for job in PRELOADED:
        importlib.import_module(f"splatctrl_cli.jobs.{job}")


@cache
def _parser_of(command: str) -> Parser:
    actions = build_parser(command).actions
    assert actions is not None
    return actions.choices[command]


def find_action(parser: Parser, command: str, name: str) -> argparse.Action:
    by_name = {option.removeprefix("--"): action for option, action in parser._option_string_actions.items()} | {
        action.dest: action for action in parser._actions if not action.option_strings
    }
    if name not in by_name:
        raise UsageError(
            f"{command} has no option {name!r}",
            remedy=did_you_mean(name, by_name, f"see splatctrl {command} --help-all"),
        )
    return by_name[name]


def words_of(where: str, action: argparse.Action, value: Any, folder: Path) -> list[str]:
    name = max(action.option_strings, key=len, default="")
    if action.nargs == 0:
        refuse_if(not isinstance(value, bool), f"{where}: expected true or false, got {value!r}", error=UsageError)
        return [name] * value
    several = value if isinstance(value, list) else [value]
    is_table = isinstance(value, Mapping)
    texts = [f"{key}={text_of(each)}" for key, each in _flat(value)] if is_table else [*map(text_of, several)]
    if action.type is Path:
        texts = [str(folder / text) for text in texts]
    if name and not isinstance(action, argparse._AppendAction):
        texts = [",".join(texts)]
    return [f"{name}={text}" if name else text for text in texts]


def _flat(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield before + key, value


def _lines(result: BatchResult, *, is_long: bool) -> list[str]:
    runs = {(run.recording, run.column): run for run in result.runs}
    columns = columns_of(((run.job, column) for (_, column), run in runs.items()), result.jobs)
    recordings = list(dict.fromkeys(recording for recording, _ in runs))
    odd = {run.recording for run in result.runs if run.state != DONE}
    shown = recordings if is_long or len(recordings) <= MOST_ROWS else [name for name in recordings if name in odd]
    rows = [[name, *(_cell(runs.get((name, column))) for column in columns)] for name in shown]
    num = len(recordings) - len(shown)
    return [
        *(table(("recording", *columns), rows) if rows else ()),
        *remarks((f"{num} recordings as expected; -v prints them, too", num)),
        "",
        f"{len(result.runs) - result.num_kept} run, {result.num_kept} as before; wrote {result.out / 'batch.json'}",
    ]


def _cell(run: Run | None) -> str:
    if run is None:
        return "-"
    word = (run.label or run.state) + run.damage
    return word if run.state == DONE else f"{word.upper()} !" if run.state == FAILED else run.state.upper()


def _list_runs(console: Console, args: argparse.Namespace, request: BatchRequest, command_line: OfThisProgram) -> int:
    folder, order = request.suite, dict[str, int]()
    if not folder.is_dir():
        *_, nodes, folder = plan_batch(request, command_line)
        order = {node.name: number for number, node in enumerate(nodes)}
    refuse_if(not (folder / NAME).is_file(), f"{folder}: has no {NAME}", remedy="run the batch first")
    conditions = [*args.where, *(["state!=done"] if args.failed else [])]
    with Ledger(folder) as ledger:
        runs = list(ledger.runs(conditions))
    if not request.suite.is_dir():
        runs = sorted((run for run in runs if run.node in order), key=lambda run: order[run.node])
    if args.csv is not None:
        write_csv(args.csv, runs)
        console.log(f"wrote {len(runs)} runs to {args.csv}")
    rows = [(run.node, run.state, describe_run(run), f"{run.peak_mb:.0f}", run.log) for run in runs]
    return console.result(
        {"nodes": [run.document() for run in runs]},
        table(("node", "state", "outcome", "MB", "log"), rows) if rows else ["no such runs"],
    )
