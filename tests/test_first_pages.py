"""The README's and the first page's main claims: their commands are run as written, their sentences and figures read.

`tools.golden` runs every command of both pages. Here are those that the claims rest on.
"""

import json
import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.cli.main import main
from tests.conftest import ROOT
from tests.quick import unpainted
from tests.test_docs import EXAMPLE, commands_on, shown_after

__all__ = ["unpainted"]
README = ROOT / "README.md"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class Said:
    """What the README's commands ended with and printed, by the folder that they write."""

    codes: dict[str, int]
    results: dict[str, dict[str, Any]]


@pytest.fixture(scope="session")
def said(tmp_path_factory: pytest.TempPathFactory) -> Said:
    """The README's way from the log to its two verdicts, once: about a minute on two quiet cores."""
    folder, found = tmp_path_factory.mktemp("readme"), Said({}, {})
    (folder / "sample_data").symlink_to(ROOT / "sample_data")
    before = Path.cwd()
    os.chdir(folder)
    try:
        for command in commands_on(README):
            words = shlex.split(command)
            if words[0] not in ("ingest", "reconstruct", "replay"):
                continue
            out = words[words.index("-o") + 1]
            with pytest.MonkeyPatch.context() as patch, (folder / "printed.json").open("w+") as printed:
                patch.setattr("sys.stdout", printed)
                found.codes[out] = main([*words, "--json", "-q"])
                printed.seek(0)
                found.results[out] = json.loads(printed.read())
    finally:
        os.chdir(before)
    return found


def assert_alike(shown: str, printed: str) -> None:
    """The same words, and figures that differ by no more than other processors may make them differ."""
    start = shown.removesuffix("...").rstrip()
    assert NUMBER.sub("#", printed).startswith(NUMBER.sub("#", start)), printed
    for one, other in zip(NUMBER.findall(start), NUMBER.findall(printed), strict=False):
        assert float(one) == pytest.approx(float(other), rel=0.03, abs=0.06), printed


def test_the_two_verdicts_of_the_readme_are_what_its_commands_say(said: Said) -> None:
    shown = re.findall(r"^    (replay: .*)$", README.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert "The two replays print, with exit code 0:" in README.read_text(encoding="utf-8")
    assert set(said.codes.values()) == {0}
    for line, out in zip(shown, ("out/audit", "out/closed_loop"), strict=True):
        assert_alike(line, said.results[out]["verdict"]["sentence"])


@pytest.mark.parametrize(("shown_as", "out"), [("tour/audit", "out/audit"), ("tour/from_1.8", "out/closed_loop")])
def test_sentences_and_figures_of_the_first_page_are_those_of_the_same_commands(
    said: Said, shown_as: str, out: str
) -> None:
    """Its commands have --truth beside, which changes neither."""
    number = next(i for i, words in enumerate(commands_on(EXAMPLE)) if f"-o {shown_as} " in f"{words} ")
    lines, metrics = shown_after(EXAMPLE)[number], said.results[out]
    assert_alike(next(line for line in lines if line.startswith("replay: ")), metrics["verdict"]["sentence"])
    figures = dict(line.split() for line in lines if re.fullmatch(r"\w+ +-?[\d.]+", line))
    compared = {name: text for name, text in figures.items() if metrics.get(name) is not None}
    assert len(compared) >= 2
    for name, text in compared.items():
        assert float(text) == pytest.approx(metrics[name], rel=0.03, abs=1e-9), name


def test_the_first_page_counts_the_splats_that_its_command_makes(said: Said) -> None:
    (line,) = [text for lines in shown_after(EXAMPLE) for text in lines if text.startswith("reconstruct: ")]
    assert_alike(line, said.results["out/scene"]["verdict"]["sentence"])
