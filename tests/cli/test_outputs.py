"""Where the command line writes: refused before any work, and told where it cannot be printed."""

import subprocess
import sys
from pathlib import Path

import pytest

from splatctrl_cli.captures.capture_writer import write_capture
from splatctrl_cli.sources.source import open_source
from tests.cli import here
from tests.cli.test_command_line import assert_refused
from tests.logs.make_log import LogRecipe, make_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of one camera."""
    return make_log(tmp_path_factory.mktemp("log") / "log.mcap", LogRecipe(cameras=("cam0",)))


@pytest.mark.parametrize(
    ("closed", "words", "code", "said"),
    [
        (">&-", ["info", "{log}"], 6, "splatctrl: stdout: closed, so the result was not printed"),
        (">&-", ["info", "absent"], 4, "splatctrl: absent: no such file"),
        ("2>&-", ["info", "absent"], 4, ""),
        ("<&- >&- 2>&-", ["info", "{log}"], 6, ""),
    ],
)
def test_a_stream_that_is_closed_is_told_where_there_was_something_to_print(
    log: Path, closed: str, words: list[str], code: int, said: str
) -> None:
    command = [sys.executable, "-m", "splatctrl_cli", *(word.format(log=log) for word in words)]
    shell = ["sh", "-c", f'"$@" {closed}', "sh", *command]
    done = subprocess.run(shell, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.startswith(said) and done.stderr.count("\n") == bool(said)


def test_an_output_is_written_though_stdout_is_closed(log: Path, tmp_path: Path) -> None:
    capture = tmp_path / "x.capture"
    write_capture(capture, open_source(log))
    command = [
        sys.executable,
        "-m",
        "splatctrl_cli",
        "capture",
        "pack",
        str(capture),
        "-o",
        str(tmp_path / "out.mcap"),
    ]
    shell = ["sh", "-c", '"$@" >&-', "sh", *command]
    done = subprocess.run(shell, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 6 and "stdout: closed" in done.stderr
    assert (tmp_path / "out.mcap").read_bytes().startswith(b"\x89MCAP")


@pytest.mark.parametrize("command", ["reconstruct", "ingest"])
def test_an_output_that_cannot_be_written_is_refused_before_the_input_is_read(tmp_path: Path, command: str) -> None:
    (tmp_path / "file").write_text("x")
    done = here.splatctrl(command, tmp_path / "absent.mcap", "-o", tmp_path / "file" / "a" / "out")
    assert_refused(done, 2, "file/a/out: cannot be written", "file is no folder; give another --out")


def test_a_partial_that_is_an_input_is_not_replaced(log: Path, tmp_path: Path) -> None:
    given = tmp_path / "log.partial"
    given.write_bytes(log.read_bytes())
    assert_refused(here.splatctrl("ingest", given, "-o", tmp_path / "log", "--force"), 2, "would replace the input")
    assert given.read_bytes() == log.read_bytes()
