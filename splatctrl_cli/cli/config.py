"""``splatctrl config``, ``completion``, ``help``: settings and their sources, shell scripts, pages."""

import argparse
import json
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import shtab

from splatctrl_cli.cli.commands import build_parser
from splatctrl_cli.cli.common import Console
from splatctrl_cli.cli.parser import Parser
from splatctrl_cli.cli.reports import SCHEMA_FILE
from splatctrl_cli.config.load import resolved_settings, template_of, toml_of
from splatctrl_cli.config.ranges import format_value
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_if


def run(args: argparse.Namespace, console: Console) -> int:
    if args.schema:
        text = SCHEMA_FILE.read_text(encoding="utf-8")
        return console.result({"json_schema": json.loads(text)}, text.splitlines())
    settings = resolved_settings(args.file, args.set)
    return console.result(
        {"settings": {setting.name: setting.as_dict() for setting in settings}},
        template_of(settings) if args.template else toml_of(settings),
    )


def run_completion(args: argparse.Namespace, console: Console) -> int:
    parser = build_parser()
    _complete_files(parser)
    script = shtab.complete(parser, shell=args.shell).rstrip("\n")
    return console.result({"shell": args.shell, "script": script}, [script])


def _pages_about(word: str, texts: Mapping[str, Callable[[], str]]) -> str:
    """A remedy: pages with a heading that has the word, else all."""
    heading = re.compile(rf"^#.*{re.escape(word.removesuffix('s'))}", re.IGNORECASE | re.MULTILINE)
    pages = [name for name, text in texts.items() if name != "settings" and heading.search(text())]
    return f"see {', '.join(pages)}" if pages else f"give one of: {', '.join(sorted(texts))}"


def run_help(args: argparse.Namespace, console: Console) -> int:
    """Print a page, an example, every setting, or a command's options."""
    roots = Path(__file__).parents[1:3]  # of a wheel, of the repository
    folder = next(place / "docs" for place in roots if (place / "docs" / "README.md").is_file())
    commands, topic = build_parser().actions, args.topic or "README"
    assert commands is not None
    texts: dict[str, Callable[[], str]] = {name: one.format_full_help for name, one in commands.choices.items()}
    texts["settings"] = lambda: "\n".join(template_of(resolved_settings(None, ())))
    pages = [*folder.glob("examples/*.toml"), *folder.glob("*.md")]
    texts |= {page.stem: partial(page.read_text, encoding="utf-8") for page in pages}
    refuse_if(
        topic not in texts,
        f"help: no page {format_value(topic)}",
        remedy=did_you_mean(topic, sorted(texts), _pages_about(topic, texts), cutoff=0.7),
        error=UsageError,
    )
    text = texts[topic]()
    return console.result({"topic": topic, "text": text}, text.splitlines())


def _complete_files(parser: Parser) -> None:
    for action in parser._actions:
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    for below in parser.actions.choices.values() if parser.actions is not None else ():
        _complete_files(below)
