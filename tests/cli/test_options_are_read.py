"""Every option that a command declares is read by the function that runs it, or is a field of a request it fills."""

import argparse
import ast
import dataclasses
import importlib
import inspect
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

from splatctrl_cli.cli import main
from splatctrl_cli.cli.commands import COMMANDS, Command, build_parser
from splatctrl_cli.cli.parser import Parser

TABLES = ("DECIDING_OPTIONS", "SETTINGS")  # of the names that a command reads by getattr


def leaves() -> Iterator[tuple[str, ...]]:
    for name, command in COMMANDS.items():
        yield from ((name, action) for action in command.actions) if command.actions else ((name,),)


def command_of(words: tuple[str, ...]) -> Command:
    command = COMMANDS[words[0]]
    return command.actions[words[1]] if command.actions else command


def declared(words: tuple[str, ...]) -> set[str]:
    parser: argparse.ArgumentParser = build_parser(words[0])
    for word in words:
        below = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        parser = below.choices[word]
    assert isinstance(parser, Parser)
    return {action.dest for action in parser._actions} - {"help", "help_all"}


def read_by(module: ModuleType, function: str, seen: set[str]) -> set[str]:
    """Names that a function of the command line reads of `args`, itself or through what it calls in that room."""
    seen.add(function)
    found: set[str] = set()
    named: Any
    for node in ast.walk(ast.parse(inspect.getsource(getattr(module, function)))):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in {"args", "self"}:
            found.add(node.attr)
        if not isinstance(node, ast.Name) or node.id in seen:
            continue
        named = getattr(module, node.id, None)
        home = inspect.getmodule(named)
        if node.id in TABLES:
            found.update(named)
        elif dataclasses.is_dataclass(named):
            found.update(field.name for field in dataclasses.fields(named))
        elif callable(named) and home is not None and home.__name__.startswith("splatctrl_cli.cli."):
            found |= read_by(home, node.id, seen)
    return found


@pytest.mark.parametrize("words", [*leaves()], ids=" ".join)
def test_every_declared_option_is_read(words: tuple[str, ...]) -> None:
    module, _, function = command_of(words).run.partition(":")
    room = importlib.import_module(f"splatctrl_cli.cli.{module}")
    read = read_by(room, function, set()) | read_by(main, "_run", set())
    assert not declared(words) - read
