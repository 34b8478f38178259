"""The completion scripts: each shell takes its own, and it completes; and words that are gone."""

import ast
import dataclasses
import importlib
import inspect
import shutil
import subprocess
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
from tests.cli.test_command_line import leaves
from tests.robot.shapes import written
from tests.test_docs import leaves as parsers_of


@pytest.fixture(scope="module")
def bash(tmp_path_factory: pytest.TempPathFactory) -> Path:
    script = here.splatctrl("completion", "bash").stdout
    return written(tmp_path_factory.mktemp("completion"), script, "splatctrl.bash")


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


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("sdf-bake --dist", ["--distance"]),
        ("sdf-bake --distance sa", ["safe", "safe_gpdf"]),
        ("robot sph", ["spheres"]),
        ("robot spheres --max-d", ["--max-deficit"]),
    ],
)
def test_bash_completes_options_and_choices(bash: Path, words: str, offered: list[str]) -> None:
    assert completed(bash, "splatctrl", *words.split()) == offered


def test_bash_completes_commands_and_files(bash: Path) -> None:
    (bash.parent / "scene.toml").touch()
    assert set(completed(bash, "splatctrl", "")) == set(COMMANDS)
    for option in ([], ["--config"]):
        assert "scene.toml" in completed(bash, "splatctrl", "reconstruct", *option, "sce")


@pytest.mark.parametrize("shell", [shell for shell in SHELLS if shell != "bash"])
def test_the_other_shells_accept_theirs_where_they_are_installed(shell: str, tmp_path: Path) -> None:
    script = here.splatctrl("completion", shell).stdout
    assert "max-splats" in script  # tcsh adds the dashes
    if shutil.which(shell) is not None:
        assert subprocess.run([shell, "-n", written(tmp_path, script, "script")], check=False).returncode == 0


@pytest.mark.parametrize("words", GONE)
def test_what_left_names_its_successor(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words.removeprefix("splatctrl ").split(), "x"]) == 2
    assert f"run {GONE[words]} instead" in capsys.readouterr().err


TABLES = ("DECIDING_OPTIONS",)  # of the names that a command reads by getattr


def declared(words: list[str]) -> dict[str, set[str]]:
    """Names by option, of which a command reads at least one: its own and those of its fields."""
    (parser,) = (each for each in parsers_of(build_parser(words[0])) if each.prog.split()[1:] == words)
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


@pytest.mark.parametrize(("words", "command"), [*leaves(COMMANDS)], ids=lambda value: str(value)[:20])
def test_every_declared_option_is_read(words: list[str], command: Command) -> None:
    module, _, function = command.run.partition(":")
    room = importlib.import_module(f"splatctrl_cli.cli.{module}")
    read = read_by(room, function, set()) | read_by(main_module, "_run", set())
    assert not [option for option, names in declared(words).items() if not names & read]
