"""The completion scripts: each shell takes its own, and it completes; and words that are gone."""

import argparse
import ast
import dataclasses
import importlib
import inspect
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from splatctrl_cli.cli import main as main_module
from splatctrl_cli.cli.commands import COMMANDS, SHELLS, Command, build_parser
from splatctrl_cli.cli.main import main
from splatctrl_cli.cli.parser import GONE, Parser
from splatctrl_cli.config import Config
from tests.cli import here


@pytest.fixture(scope="module")
def bash(tmp_path_factory: pytest.TempPathFactory) -> Path:
    script = tmp_path_factory.mktemp("completion") / "splatctrl.bash"
    script.write_text(here.splatctrl("completion", "bash").stdout)
    return script


def completed(script: Path, *words: str) -> list[str]:
    """What bash offers for the last of the words."""
    program = """
source "$0"
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
"$(complete -p splatctrl | sed 's/.*-F \\([^ ]*\\).*/\\1/')"
printf '%s\\n' "${COMPREPLY[@]}"
"""
    done = subprocess.run(
        ["bash", "-c", program, str(script), *words], capture_output=True, text=True, check=True, cwd=script.parent
    )
    return done.stdout.split()


def test_bash_completes_commands_options_choices_and_files(bash: Path) -> None:
    assert set(completed(bash, "splatctrl", "")) == set(COMMANDS)
    assert completed(bash, "splatctrl", "sdf-bake", "--dist") == ["--distance"]
    assert completed(bash, "splatctrl", "sdf-bake", "--distance", "sa") == ["safe", "safe_gpdf"]
    assert completed(bash, "splatctrl", "robot", "sph") == ["spheres"]
    assert completed(bash, "splatctrl", "robot", "spheres", "--max-d") == ["--max-deficit"]
    (bash.parent / "scene.toml").touch()
    assert "scene.toml" in completed(bash, "splatctrl", "reconstruct", "sce")
    assert "scene.toml" in completed(bash, "splatctrl", "reconstruct", "--config", "sce")


@pytest.mark.parametrize("shell", [shell for shell in SHELLS if shell != "bash"])
def test_the_other_shells_accept_theirs_where_they_are_installed(shell: str, tmp_path: Path) -> None:
    script = here.splatctrl("completion", shell).stdout
    assert "max-splats" in script  # tcsh adds the dashes
    if shutil.which(shell) is not None:
        (tmp_path / "script").write_text(script)
        assert subprocess.run([shell, "-n", tmp_path / "script"], check=False).returncode == 0


@pytest.mark.parametrize("words", GONE)
def test_what_left_names_its_successor(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words.removeprefix("splatctrl ").split(), "x"]) == 2
    assert f"run {GONE[words]} instead" in capsys.readouterr().err


TABLES = ("DECIDING_OPTIONS",)  # of the names that a command reads by getattr


def leaves() -> Iterator[tuple[str, ...]]:
    for name, command in COMMANDS.items():
        yield from ((name, action) for action in command.actions) if command.actions else ((name,),)


def command_of(words: tuple[str, ...]) -> Command:
    command = COMMANDS[words[0]]
    return command.actions[words[1]] if command.actions else command


def declared(words: tuple[str, ...]) -> dict[str, set[str]]:
    """Names by option, of which a command reads at least one: its own and those of its fields."""
    parser: argparse.ArgumentParser = build_parser(words[0])
    for word in words:
        below = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        parser = below.choices[word]
    assert isinstance(parser, Parser)
    actions: Any = parser._actions
    return {a.dest: {a.dest, *a.fields, *(["config"] if a.sets else [])} for a in actions if "help" not in a.dest}


def fields_of(request: Any) -> set[str]:
    """Names of a request's fields, and of those that options make up in turn."""
    found = set[str]()
    for field in dataclasses.fields(request):
        made_by = field.default_factory
        found.add(field.name)
        if made_by is Config:
            found.add("set")
        elif isinstance(made_by, type) and dataclasses.is_dataclass(made_by):
            found |= fields_of(made_by)
    return found


def read_by(module: ModuleType, function: str, seen: set[str]) -> set[str]:
    """Names that a function of the command line reads of `args`, itself or through what it calls in that room."""
    seen.add(function)
    found: set[str] = set()
    named: Any
    for node in ast.walk(ast.parse(inspect.getsource(getattr(module, function)))):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in {"args", "self"}:
            found.add(node.attr)
        if not isinstance(node, ast.Name) or node.id in seen or node.id == "request_of":
            continue
        named = getattr(module, node.id, None)
        home = inspect.getmodule(named)
        if node.id in TABLES:
            found.update(named)
        elif dataclasses.is_dataclass(named):
            found |= fields_of(named)
        elif callable(named) and home is not None and home.__name__.startswith("splatctrl_cli.cli."):
            found |= read_by(home, node.id, seen)
    return found


@pytest.mark.parametrize("words", [*leaves()], ids=" ".join)
def test_every_declared_option_is_read(words: tuple[str, ...]) -> None:
    module, _, function = command_of(words).run.partition(":")
    room = importlib.import_module(f"splatctrl_cli.cli.{module}")
    read = read_by(room, function, set()) | read_by(main_module, "_run", set())
    assert not [option for option, names in declared(words).items() if not names & read]
