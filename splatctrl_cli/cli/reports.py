"""Output for other programs: ``--json`` envelope, ``--junit FILE``, GitHub annotations."""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.errors import SplatCtrlError
from splatctrl_cli.report.junit import Suite, cases_of, error_case, tell_github, write_junit

RECORDINGS = ("log", "source", "reference", "dtu", "scene", "data", "output", "urdf")  # logs before maps
JUNIT = "--junit"
SCHEMA = "splatctrl-output 1"
SCHEMA_FILE = Path(__file__).parent.parent / "report" / "output.schema.json"


def wrap_result(result: Mapping[str, Any], code: int) -> dict[str, Any]:
    """Put the schema's name and the exit code in front of a result."""
    first = {"schema": SCHEMA, "exit_code": code}
    return {**first, **result, **first}


def report_command(args: argparse.Namespace, verdict: Mapping[str, Any] | None, code: int, line: str = "") -> None:
    """Report a verdict, else the command's error line, to --junit and GitHub.

    Raises UsageError or WriteError if the file is unwritable.
    """
    action = getattr(args, "action", None)
    command = f"{args.command} {action}" if action else args.command
    recording = next((value for name in RECORDINGS if (value := getattr(args, name, None))), "")
    path = " ".join(map(str, recording if isinstance(recording, list) else [recording]))
    seconds = time.perf_counter() - args.began
    group = f"{path}/{command}" if path else command
    properties = {"splatctrl": __version__, "command": command, "exit code": str(code)}
    suite = Suite(
        name=path or command,
        path=path,
        cases=[error_case(group, line, exit_code=code)] if verdict is None else cases_of(verdict, group),
        notes=() if verdict is None else [verdict["sentence"], *verdict["notes"]],
        properties=properties | ({} if verdict is None else {"label": verdict["label"]}),
        started=(datetime.now(UTC) - timedelta(seconds=seconds)).isoformat(timespec="seconds"),
        seconds=seconds,
    )
    publish([suite], junit=args.junit, is_fatal=code != 0)


def publish(suites: Sequence[Suite], *, junit: Path | None, is_fatal: bool) -> None:
    """Write --junit, and GitHub annotations and summary; an unwritable summary is printed."""
    if junit is not None:
        write_junit(junit, suites)
    try:
        tell_github(suites, sys.stderr, is_fatal=is_fatal)
    except OSError as error:
        print(f"splatctrl: GITHUB_STEP_SUMMARY: cannot be written: {error.strerror}", file=sys.stderr)


def tell_of_failure(
    words: Sequence[str], args: argparse.Namespace | None, line: str, code: int, start: float
) -> None:
    """Report a command without a verdict; if reporting fails, print why.

    args: None for unparsed `words`. start: by time.perf_counter.
    """
    args = args or argparse.Namespace(command=words[0], junit=_junit_in(words), began=start)
    try:
        report_command(args, None, code, line)
    except (SplatCtrlError, OSError) as error:
        if str(error) != line:
            print(f"splatctrl: {' '.join(str(error).split())}", file=sys.stderr)


def _junit_in(words: Sequence[str]) -> Path | None:
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word == "--":
            break
        name, equals, value = word.partition("=")
        if name == JUNIT and (value if equals else following):
            return Path(value if equals else following)
    return None
