"""The completion scripts: each shell takes its own, and it completes; and words that are gone."""

import shutil
import subprocess
from pathlib import Path

import pytest
import shtab

from splatctrl_cli.cli.commands import COMMANDS, SHELLS
from splatctrl_cli.cli.main import main
from splatctrl_cli.cli.parser import GONE
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


def test_the_shells_are_those_of_the_library() -> None:
    assert set(SHELLS) <= set(shtab.SUPPORTED_SHELLS)


def test_bash_accepts_its_script(bash: Path) -> None:
    assert subprocess.run(["bash", "-n", bash], capture_output=True, check=False).returncode == 0


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
