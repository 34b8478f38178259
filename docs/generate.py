"""Writes docs/cli.md from the parser, docs/config.md from what the configuration declares, and the tables that the
registries of formats, layouts and checks make in other pages, for `make docs`.

The pages are made from the parser itself and not from its printed help, whose wrapping depends on the terminal and on
the version of Python.
"""

import inspect
import re
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

from splatctrl_cli import config
from splatctrl_cli.checks.finding import CHECKS, Check
from splatctrl_cli.cli.commands import COMMANDS, EXIT_CODES, build_parser
from splatctrl_cli.cli.parser import Parser, invocation
from splatctrl_cli.config.load import type_name
from splatctrl_cli.config.ranges import OneOf, Section
from splatctrl_cli.evaluate.metrics import Better, Scale
from splatctrl_cli.evaluate.verdict import Criterion
from splatctrl_cli.formats.grid.grid_format import GridFormat
from splatctrl_cli.formats.grid.grid_formats import FORMATS as GRID_FORMATS
from splatctrl_cli.formats.splat.splat_format import SplatFormat
from splatctrl_cli.formats.splat.splats import FORMATS as SPLAT_FORMATS
from splatctrl_cli.jobs.compare.judged_runs import scales
from splatctrl_cli.jobs.replay.criteria import Judged
from splatctrl_cli.jobs.replay.evidence_criteria import LIMITS, PROOF, Limit
from splatctrl_cli.jobs.replay.verdict import CRITERIA
from splatctrl_cli.recording.folder.image_folder import LAYOUTS
from splatctrl_cli.recording.folder.layout import Layout
from splatctrl_cli.voxels import EvidenceClass

DOCS = Path(__file__).parent
NOTICE = "<!-- Made by docs/generate.py; `make docs` writes it again. -->"
SHARED_BY = 2  # commands with the same option, in the same words, from which on it is explained once
INPUT = "input"  # the group of options that say how a recording is read
HELP = ("help", "help_all")
SIMPLE = ("int", "float", "str")  # types that a default shows
TABLE = re.compile(r"(<!-- Rows of (\w+); `make docs` writes them again. -->\n\n)((?:[|-].*\n)*)")
WORDS = {  # of a name in the documentation, for those that it stands for
    "FIELD": ("exact", "barrier", "certified"),
    "REGION": ("seen", "all", "masked"),
    "CLASS": tuple(kind.name.lower() for kind in EvidenceClass),
}


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Figures of a command that are compared alike, as the documentation's table has them."""

    command: str
    names: tuple[str, ...]
    scale: Scale

    @property
    def docs(self) -> str:
        """The row of the table, its cells separated by |."""
        scale, shown = self.scale, ", ".join(f"`{name}`" for name in self.names)
        parts = [f"{scale.absolute:g} {scale.unit}".rstrip()] if scale.absolute else []
        parts += [f"{100 * scale.relative:g} %"] if scale.relative else []
        return f"{self.command} | {shown} | {scale.unit or '-'} | {scale.better} | {' + '.join(parts) or '0'}"


def documented() -> Iterator[Compared]:
    """The rows of the documentation's table: figures that have a direction, alike ones together."""
    for command, of_name in scales().items():
        alike: dict[Scale, list[str]] = {}
        for name, scale in of_name.items():
            if scale.better is not Better.NEITHER:
                alike.setdefault(scale, []).append(_general(name, of_name))
        for scale, names in alike.items():
            yield Compared(command=command, names=tuple(dict.fromkeys(names)), scale=scale)


def _general(name: str, names: Container[str]) -> str:
    """A name with a word for what is one of several among `names`: ``seen.FIELD.BAND.rmse``, ``psnr_REGION``."""
    name = name.removesuffix("_corrected")
    if name.startswith(("everywhere.", "seen.")):
        where, *_, figure = name.split(".")
        return f"{where}.FIELD.BAND.{figure}"
    for word, choices in WORDS.items():
        for choice in choices:
            head, tail = name.removeprefix(f"{choice}_"), name.removesuffix(f"_{choice}")
            if head != name and sum(f"{other}_{head}" in names for other in choices) > 1:
                return f"{word}_{head}"
            if tail != name and sum(f"{tail}_{other}" in names for other in choices) > 1:
                return f"{tail}_{word}"
    return name


Entry = SplatFormat | GridFormat | Layout | Check | Criterion[Judged] | Limit | Compared
REGISTRIES: dict[str, tuple[tuple[str, ...], Iterable[Entry]]] = {
    "splat_formats": (("suffix", "what it is", "rounds to", "does not hold"), SPLAT_FORMATS.values()),
    "grid_formats": (("`--formats`", "file", "who opens it", "checked", "cost"), GRID_FORMATS.values()),
    "datasets": (("layout", "known by", "poses", "depth", "intrinsics"), LAYOUTS),
    "criteria": (("criterion", "holds where", "broken:"), CRITERIA),
    "limits": (("evidence", "allowed", "why"), (*LIMITS, PROOF)),
    "metrics": (("command", "figures", "unit", "better", "tolerance"), [*documented()]),
    "checks": ((), CHECKS.values()),  # without a header: a list
}

Row = tuple[str, str]  # an argument, and what it means


def main() -> None:
    """Write the pages."""
    for name, text in pages().items():
        (DOCS / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of each generated page, by file name."""
    tabled = {
        name: (DOCS / name).read_text(encoding="utf-8")
        for name in ("artefacts.md", "check.md", "compare.md", "input.md", "verdict.md")
    }
    filled = {name: TABLE.sub(_filled, text) for name, text in tabled.items()}
    return {"cli.md": cli_page(), "config.md": config_page(), **filled}


def _filled(found: re.Match[str]) -> str:
    """A mark in a page, and the table, or list, of the registry that it names."""
    header, entries = REGISTRIES[found[2]]
    texts = [text for entry in entries for text in entry.docs.split("\n\n") if text]
    rows = [tuple(cell.strip() for cell in " ".join(text.split()).split("|")) for text in texts]
    lines = _table(header, rows) if header else _list((name, meaning) for name, meaning in rows)
    return found[1] + "\n".join(lines) + "\n"


def cli_page() -> str:
    """One section per subcommand, with every argument that its --help-all shows."""
    parser = build_parser()
    assert parser.actions is not None
    commands = parser.actions.choices
    summaries = [(f"[{name}](#{name})", COMMANDS[name].summary) for name in commands]
    lines = [
        NOTICE,
        "# The command line",
        "",
        f"`splatctrl COMMAND ...`: {parser.description}",
        "",
        *_list(summaries),
        "",
        "`--help` shows what people use of a command, `--help-all` everything. Results go to stdout, as a table or",
        "with `--json` as one JSON object; progress, log lines and errors (one line with a remedy) go to stderr.",
        "`--json` prints one object of every outcome, refusals included (`error` with message and remedy); its JSON",
        "Schema is [`splatctrl_cli/report/output.schema.json`](../splatctrl_cli/report/output.schema.json), which",
        "`splatctrl config --schema` prints.",
        "Options cannot be abbreviated. Missing folders above an output are made. A linked output is written where",
        "the link leads to. An output that another run is writing is refused (exit 2). With stdout closed, a command",
        "that had something to print ends with 6, its files complete.",
        "",
        EXIT_CODES[0].upper() + EXIT_CODES[1:] + ".",
    ]
    leaves = [dict(_groups(leaf)) for leaf in _leaves(commands.values())]
    counts = Counter(row for leaf in leaves for rows in leaf.values() for row in rows)
    of_recording = {row for leaf in leaves for row in leaf.get(INPUT, ())}
    shared = {row: _kind(row, count == len(leaves), row in of_recording) for row, count in counts.items()}
    shared = {row: kind for row, kind in shared.items() if kind or counts[row] >= SHARED_BY}
    for command in commands.values():
        lines += _command_section("##", command, shared)
    lines += ["", "## Options of several commands"]
    for kind in sorted(set(shared.values())):
        rows = [row for row, other in shared.items() if other == kind]
        lines += ["", *([f"### {kind}", ""] if kind else []), *_list(rows)]
    return "\n".join(lines) + "\n"


def _kind(row: Row, is_in_all: bool, is_of_recording: bool) -> str:
    """The heading under which an option is explained once for all commands that have it, "" for none of its own."""
    return "Of every command" if is_in_all else "Of a recording" if is_of_recording else ""


def _leaves(parsers: Iterable[Parser]) -> Iterator[Parser]:
    """The parsers of commands, those of actions in the place of the command that has them."""
    for parser in parsers:
        yield from [parser] if parser.actions is None else _leaves(parser.actions.choices.values())


def _command_section(level: str, parser: Parser, shared: Mapping[Row, str]) -> list[str]:
    """Heading, usage and arguments by group; of a command with actions, their summaries and a section for each."""
    name = parser.prog.partition(" ")[2]
    usage = parser.format_usage().strip().removeprefix("usage: ")
    lines = ["", f"{level} {name}", "", f"`{usage}`"]
    if parser.actions is not None:
        below = parser.actions.choices
        summaries = [(f"`{name} {action}`", one.summary) for action, one in (COMMANDS[name].actions or {}).items()]
        lines += ["", *_list(summaries)]
        return [*lines, *(line for one in below.values() for line in _command_section(f"{level}#", one, shared))]
    for title, rows in _groups(parser):
        own = [row for row in rows if row not in shared]
        lines += ["", *([f"{title.capitalize()}:", ""] if title else []), *_list(own)] if own else []
    common = [row for _, rows in _groups(parser) for row in rows if row in shared]
    names = dict.fromkeys(shared[row] or re.findall(r"--[a-z][a-z-]*", row[0])[-1] for row in common)
    also = ", ".join(_link(name) for name in names if name != "Of every command")
    return [*lines, "", f"Also: {also}."] if also else lines


def _link(name: str) -> str:
    """An option, or a heading of several, in the words of a list."""
    return f"`{name}`" if name.startswith("-") else f"those [{name.lower()}](#{name.lower().replace(' ', '-')})"


def _groups(parser: Parser) -> list[tuple[str, list[Row]]]:
    """Argument and meaning, by the title of their group."""
    formatter = parser._get_formatter()
    return [
        (title, [(f"`{invocation(a)}`", formatter._expand_help(a)) for a in actions if a.dest not in HELP])
        for title, actions in parser.groups
    ]


def config_page() -> str:
    """One list per section of the configuration: key, default, type, range with unit, and reason, as declared."""
    lines = [
        NOTICE,
        "# Configuration",
        "",
        "Give a TOML file with `--config FILE.toml`, single values with `--set section.key=value` (these win). An",
        "unknown key, a value of another type or out of its range, and keys that contradict each other are refused",
        "(exit 2) before any work. `run.json` holds what a run used. Each line: key, default, (range), meaning. A",
        "default without a decimal point or exponent is an integer.",
        "",
        "`splatctrl config` prints every value that a run would use, as TOML, with a comment where one comes from a",
        "preset, file or `--set`. `splatctrl config FILE.toml` checks a file, and",
        "`splatctrl config --template` prints one to begin with.",
        "",
        "```toml",
        "[scene]",
        f"max_splats = {config.SceneConfig.max_splats}",
        "",
        "[control]",
        f"margin = {config.ControlConfig.margin}",
        "```",
        "",
        "III-C and the like are sections of the paper; [paper.md](paper.md) says where the defaults leave it.",
        "What is fixed on purpose stands with its reason in `splatctrl_cli/config/fixed.py`, the limits of `check`",
        "in `splatctrl_cli/checks/limits.py`.",
    ]
    for section in fields(config.Config):
        kind: Any = type(getattr(config.Config(), section.name))
        rows = [_setting_row(kind, key) for key in kind.declared]
        lines += ["", f"## [{section.name}]", "", inspect.cleandoc(kind.__doc__), "", *_list(rows)]
    return "\n".join(lines) + "\n"


def _setting_row(section: type[Section], key: str) -> Row:
    """A key with its default and range, and what it means."""
    declared, hint = section.declared[key], get_type_hints(section)[key]
    quoted = isinstance(declared, OneOf) and ", ".join(f'`"{word}"`' for word in declared.words)
    kind = "" if type_name(hint) in SIMPLE else f"{type_name(hint)}: "
    expected = quoted or declared.expected.replace(" to ", "…")
    return f"`{key} = {_toml(getattr(section, key))}` ({kind}{expected})", declared.reason


def _toml(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


def _list(rows: Iterable[Row]) -> list[str]:
    """A line for each row."""
    return [f"- {name}: {meaning}" for name, meaning in rows]


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in [header, *rows]]
    lines = [f"| {' | '.join(row)} |" for row in escaped]
    lines.insert(1, f"|{'---|' * len(header)}")
    return lines


if __name__ == "__main__":
    main()
