"""Writes docs/cli.md from the parser, docs/config.md from what the configuration declares, and the tables that the
registries of formats, layouts and checks make in other pages, for `make docs`.

The pages are made from the parser itself and not from its printed help, whose wrapping depends on the terminal and on
the version of Python.
"""

import argparse
import inspect
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from splatctrl_cli import config
from splatctrl_cli.checks.finding import CHECKS, Check
from splatctrl_cli.cli.main import EXIT_CODES, build_parser
from splatctrl_cli.config.declared import OneOf, Section
from splatctrl_cli.config.load import type_name
from splatctrl_cli.datasets.layout import Layout
from splatctrl_cli.datasets.layouts import LAYOUTS
from splatctrl_cli.evaluate.verdict import Criterion
from splatctrl_cli.grid_files.grid_format import GridFormat
from splatctrl_cli.grid_files.grid_formats import FORMATS as GRID_FORMATS
from splatctrl_cli.jobs.replays.judged import Judged
from splatctrl_cli.jobs.replays.verdict import CRITERIA
from splatctrl_cli.splat_files.splat_format import SplatFormat
from splatctrl_cli.splat_files.splat_formats import FORMATS as SPLAT_FORMATS

DOCS = Path(__file__).parent
NOTICE = "<!-- Made by docs/generate.py; `make docs` writes it again. -->"
SHARED_BY = 3  # commands with the same option, in the same words, from which on it is explained once
INPUT = "input"  # the group of options that say how a recording is read
SIMPLE = ("int", "float", "str")  # types that a default shows
TABLE = re.compile(r"(<!-- Rows of (\w+); `make docs` writes them again. -->\n\n)((?:\|.*\n)*)")
REGISTRIES: dict[
    str, tuple[tuple[str, ...], Iterable[SplatFormat | GridFormat | Layout | Check | Criterion[Judged]]]
] = {
    "splat_files": (("suffix", "what it is", "rounds to", "does not hold"), SPLAT_FORMATS.values()),
    "grid_files": (("`--formats`", "file", "who opens it", "checked", "cost"), GRID_FORMATS.values()),
    "datasets": (("layout", "known by", "poses", "depth", "intrinsics"), LAYOUTS),
    "criteria": (("criterion", "holds where", "broken:"), CRITERIA),
    "checks": (("code", "what it means", "severity"), CHECKS.values()),
}


def main() -> None:
    """Write the pages."""
    for name, text in pages().items():
        (DOCS / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of each generated page, by file name."""
    tabled = {
        name: (DOCS / name).read_text(encoding="utf-8")
        for name in ("artefacts.md", "check.md", "input.md", "verdict.md")
    }
    filled = {name: TABLE.sub(_filled, text) for name, text in tabled.items()}
    return {"cli.md": cli_page(), "config.md": config_page(), **filled}


def _filled(found: re.Match[str]) -> str:
    """A mark in a page, and the table of the registry that it names."""
    header, entries = REGISTRIES[found[2]]
    texts = [text for entry in entries for text in entry.docs.split("\n\n") if text]
    rows = [tuple(cell.strip() for cell in " ".join(text.split()).split("|")) for text in texts]
    return found[1] + "\n".join(_table(header, rows)) + "\n"


def cli_page() -> str:
    """One section per subcommand, with every argument that its --help shows."""
    parser = build_parser()
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    summaries = {action.dest: action.help for action in commands._choices_actions}
    lines = [
        NOTICE,
        "# The command line",
        "",
        f"`splatctrl COMMAND ...`: {parser.description}",
        "",
        *_table(("command", "what it does"), [(f"[{n}](#{n})", summaries[n]) for n in commands.choices]),
        "",
        "Results go to stdout, as a table or with `--json` as one JSON object; progress and log lines go to stderr.",
        "An error is one line on stderr with its remedy. Options cannot be abbreviated. Relative paths start at the",
        "folder you are in; missing folders above an output are made. An output that is a link is written where the",
        "link leads to. An output that another run is writing is refused (exit 2); a killed run leaves no lock. With",
        "stdout closed, a command that had something to print ends with 6, its files whole.",
        "",
        EXIT_CODES[0].upper() + EXIT_CODES[1:] + ".",
    ]
    leaves = list(_leaves(commands.choices.values()))
    counts = Counter(row for leaf in leaves for row in _rows(leaf))
    of_recording = {row for leaf in leaves for row in _rows(leaf, INPUT)}
    shared = {row: _kind(row, count == len(leaves), row in of_recording) for row, count in counts.items()}
    shared = {row: kind for row, kind in shared.items() if kind or counts[row] >= SHARED_BY}
    for name, command in commands.choices.items():
        lines += _command_section("##", name, command, shared)
    lines += ["", "## Options of several commands", "", "The same in every command that has them."]
    for kind in sorted(set(shared.values())):
        rows = [row for row, other in shared.items() if other == kind]
        lines += ["", *([f"### {kind}", ""] if kind else []), *_table(("argument", "meaning"), rows)]
    return "\n".join(lines) + "\n"


def _kind(row: tuple[str, str], is_in_all: bool, is_of_recording: bool) -> str:
    """The heading under which an option is explained once for all commands that have it, "" for none of its own."""
    return "Of every command" if is_in_all else "Of a recording" if is_of_recording else ""


def _leaves(parsers: Iterable[argparse.ArgumentParser]) -> Iterator[argparse.ArgumentParser]:
    """The parsers of commands, those of actions in the place of the command that has them."""
    for parser in parsers:
        nested = _nested(parser)
        yield from [parser] if nested is None else _leaves(nested.choices.values())


def _nested(parser: argparse.ArgumentParser) -> "argparse._SubParsersAction[Any] | None":
    return next((a for a in parser._actions if isinstance(a, argparse._SubParsersAction)), None)


def _command_section(
    level: str, name: str, parser: argparse.ArgumentParser, shared: Mapping[tuple[str, str], str]
) -> list[str]:
    """Heading, usage, summary and arguments; of a command with actions, a section for each action below it."""
    lines = ["", f"{level} {name}", "", _usage(name, parser), "", parser.description, ""]
    nested = _nested(parser)
    if nested is None:
        rows = _rows(parser)
        lines += _table(("argument", "meaning"), [row for row in rows if row not in shared])
        names = [shared[row] or re.findall(r"--[a-z][a-z-]*", row[0])[-1] for row in rows if row in shared]
        also = ", ".join(_link(name) for name in dict.fromkeys(names) if name != "Of every command")
        return [*lines, "", f"Also: {also}."] if also else lines
    actions = [(f"`{name} {action.dest}`", action.help) for action in nested._choices_actions]
    lines += _table(("action", "what it does"), actions)
    for action, below in nested.choices.items():
        lines += _command_section(f"{level}#", f"{name} {action}", below, shared)
    return lines


def _link(name: str) -> str:
    """An option, or a heading of several, in the words of a list."""
    return f"`{name}`" if name.startswith("-") else f"those [{name.lower()}](#{name.lower().replace(' ', '-')})"


def _usage(name: str, parser: argparse.ArgumentParser) -> str:
    groups = parser._mutually_exclusive_groups
    grouped = {id(action) for group in groups for action in group._group_actions}
    required = [f"({' | '.join(_invocation(a) for a in group._group_actions)})" for group in groups if group.required]
    required += [_invocation(a) for a in parser._actions if a.option_strings and a.required and id(a) not in grouped]
    places = [_placed(a) for a in parser._actions if not a.option_strings]
    return f"`{' '.join(['splatctrl', name, *places, *required, '[options]'])}`"


def _placed(action: argparse.Action) -> str:
    name = str(action.metavar or action.dest).upper()
    return f"[{name}]" if action.nargs == "?" else name


def _rows(parser: argparse.ArgumentParser, title: str | None = None) -> list[tuple[str, str]]:
    """What --help shows of each argument, or of those in the group `title`."""
    formatter = parser._get_formatter()
    groups = [group for group in parser._action_groups if title in {None, group.title}]
    actions = [a for group in groups for a in group._group_actions if a.dest != "help"]
    return [(f"`{_invocation(a)}`", formatter._expand_help(a) if a.help else "") for a in actions]


def _invocation(action: argparse.Action) -> str:
    """``-o, --out PATH``, the same in every version of Python."""
    if not action.option_strings:
        return _placed(action)
    names = ", ".join(action.option_strings)
    if action.nargs == 0:
        return names
    if action.choices:
        return f"{names} {{{','.join(map(str, action.choices))}}}"
    return f"{names} {action.metavar or action.dest.upper()}"


def config_page() -> str:
    """One table per section of the configuration: key, default, type, range with unit, and reason, as declared."""
    lines = [
        NOTICE,
        "# Configuration",
        "",
        "Give a TOML file with `--config FILE.toml`, single values with `--set section.key=value` (these win). An",
        "unknown key is an error that names the nearest good one. A value of another type, out of its range, not",
        "finite, or in contradiction to another one is refused (exit 2) before any work. What a run used stands in",
        "its `run.json`. A default without a decimal point or exponent is an integer.",
        "",
        "```toml",
        "[scene]",
        f"max_splats = {config.SceneConfig.max_splats}",
        "",
        "[control]",
        f"margin = {config.ControlConfig.margin}",
        "```",
        "",
        "III-C and the like are sections of the paper; see [paper.md](paper.md) for where the defaults leave it.",
    ]
    header = ("key", "default", "range", "meaning")
    for section in fields(config.Config):
        kind: Any = type(getattr(config.Config(), section.name))
        rows = [_setting_row(kind, key) for key in kind.declared]
        lines += ["", f"## [{section.name}]", "", inspect.cleandoc(kind.__doc__), "", *_table(header, rows)]
    return "\n".join(lines) + "\n"


def _setting_row(section: type[Section], key: str) -> tuple[str, ...]:
    declared, hint = section.declared[key], get_type_hints(section)[key]
    quoted = isinstance(declared, OneOf) and ", ".join(f'`"{word}"`' for word in declared.words)
    return (
        f"`{key}`",
        f"`{_toml(getattr(section, key))}`" + ("" if type_name(hint) in SIMPLE else f" ({type_name(hint)})"),
        quoted or declared.expected.replace(" to ", "…"),
        declared.reason,
    )


def _toml(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in [header, *rows]]
    lines = [f"| {' | '.join(row)} |" for row in escaped]
    lines.insert(1, f"|{'---|' * len(header)}")
    return lines


if __name__ == "__main__":
    main()
