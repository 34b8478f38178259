"""What left the command line is refused by an error that names what takes its place."""

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.cli.parser import GONE


@pytest.mark.parametrize("words", GONE)
def test_what_left_names_its_successor(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words.removeprefix("splatctrl ").split(), "x"]) == 2
    assert f"run {GONE[words]} instead" in capsys.readouterr().err
