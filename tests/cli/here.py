"""The command line in this process: what one of its own would print and return, without the wait for its start."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import pytest
from jsonschema import Draft202012Validator

from splatctrl_cli.cli.main import main
from splatctrl_cli.cli.reports import SCHEMA_FILE

OUTPUT = Draft202012Validator(json.loads(SCHEMA_FILE.read_text(encoding="utf-8")))


def splatctrl(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command; what compiled modules print is caught too."""
    words = [str(argument) for argument in arguments]
    with (
        tempfile.TemporaryFile("w+") as out,
        tempfile.TemporaryFile("w+") as err,
        pytest.MonkeyPatch.context() as patch,
    ):
        with _sent_to(out, 1), _sent_to(err, 2):
            patch.setattr(sys, "stdout", out)
            patch.setattr(sys, "stderr", err)
            code = main(words)
        texts = [_text(out), _text(err)]
    if "--json" in words:
        checked(texts[0], code)
    return subprocess.CompletedProcess(words, code, *texts)


def checked(stdout: str, code: int) -> dict[str, Any]:
    """The one object of ``--json``, which is as the published schema says."""
    found: dict[str, Any] = json.loads(stdout)
    OUTPUT.validate(found)
    assert found["exit_code"] == code
    return found


@contextmanager
def _sent_to(stream: IO[str], number: int) -> Iterator[None]:
    """File descriptor `number` leads to the stream's file meanwhile."""
    kept = os.dup(number)
    os.dup2(stream.fileno(), number)
    try:
        yield
    finally:
        stream.flush()
        os.dup2(kept, number)
        os.close(kept)


def _text(stream: IO[str]) -> str:
    stream.seek(0)
    return stream.read()
