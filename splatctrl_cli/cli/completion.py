"""``splatctrl completion``: a script by which a shell completes commands, options, their choices and files."""

import argparse
from pathlib import Path

import shtab

from splatctrl_cli.cli.commands import build_parser
from splatctrl_cli.cli.common import Console
from splatctrl_cli.cli.parser import Parser


def run(args: argparse.Namespace) -> int:
    parser = build_parser()
    _complete_files(parser)
    script = shtab.complete(parser, shell=args.shell).rstrip("\n")
    Console(args).result({"shell": args.shell, "script": script}, [script])
    return 0


def _complete_files(parser: Parser) -> None:
    """Names of files and folders for what is a path."""
    for action in parser._actions:
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    if parser.actions is not None:
        for below in parser.actions.choices.values():
            _complete_files(below)
