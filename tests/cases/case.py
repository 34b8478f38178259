"""One small input: how to make it, and what is wanted of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.cli.here import splatctrl


@dataclass(frozen=True)
class Result:
    """What one call of the command line printed, and its exit code."""

    code: int
    out: str
    err: str

    @property
    def text(self) -> str:
        """Both streams, as one line without line breaks: messages are wrapped."""
        return " ".join((self.out + " " + self.err).split())


Run = Callable[[Sequence[str | Path]], Result]


@dataclass(frozen=True, kw_only=True)
class Case:
    """An input by name. `make` writes it into an empty folder, with this project's own writers.

    `examine` gets the folder of the input, an empty one to write to, and what runs the command line. It asserts.
    `has_shared`: a folder of the same name, made with other people's libraries, may lie beside the real recordings.
    """

    name: str
    make: Callable[[Path], None]
    examine: Callable[[Path, Path, Run], None]
    has_shared: bool = False


def run(words: Sequence[str | Path]) -> Result:
    """Call the command line in this process."""
    done = splatctrl(*words)
    return Result(code=done.returncode, out=done.stdout, err=done.stderr)


def expect_result(run: Run, words: Sequence[str | Path], *parts: str, code: int = 0) -> Result:
    """Run a command and return its result, which must have this exit code and contain all parts."""
    result = run(words)
    assert result.code == code, result.text
    assert all(part in result.text for part in parts), result.text
    return result
