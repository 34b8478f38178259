"""``splatctrl``: run one subcommand; errors become a line and exit code."""

import argparse
import errno
import io
import json
import os
import shlex
import stat
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from pkgutil import resolve_name

from splatctrl_cli.cli.commands import build_parser, judges
from splatctrl_cli.cli.common import Console
from splatctrl_cli.cli.reports import tell_of_failure, wrap_result
from splatctrl_cli.errors import SplatCtrlError, UsageError, refuse_if
from splatctrl_cli.files.output import PARTIAL, check_can_be_written, is_write_failure
from splatctrl_cli.report.junit import check_replaceable

INTERRUPTED = 130  # exit code
RESUME = "--resume"  # the option of what can be gone on with
MAX_PIXELS = 1 << 27  # of an image file: twice the largest cameras; a small file can announce a thousand million

_WRITES = os.O_WRONLY | os.O_RDWR
_NEVER_END = {"FIFO": stat.S_ISFIFO, "socket": stat.S_ISSOCK, "device": stat.S_ISCHR, "disk": stat.S_ISBLK}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code, 6 if stdout was closed."""
    lost = _stand_in_for_closed_streams()
    code = _run(argv)
    if lost.is_written and code not in {70, INTERRUPTED}:
        print(
            "splatctrl: stdout: closed, so the result was not printed; files are as they should be", file=sys.stderr
        )
        return 6
    return code


def _run(argv: Sequence[str] | None) -> int:
    refuse_endless_files()
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # read when cv2 is first imported
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of numpy; more threads wait, and round otherwise
    words, args, start = sys.argv[1:] if argv is None else list(argv), None, time.perf_counter()
    try:
        args = build_parser(words[0] if words else "").parse_args(words)
        args.began = start
        _check_outputs(args)
        code: int = resolve_name(f"splatctrl_cli.cli.{args.run}")(args, Console(args))
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except (Exception, KeyboardInterrupt) as error:
        line, code = _fail(
            error,
            words,
            is_json="--json" in words and not hasattr(args, "is_printed"),
            is_verbose=args is not None and args.verbose > 0,
        )
        if judges(words):
            tell_of_failure(words, args, line, code, start)
        return code


def _fail(error: BaseException, words: Sequence[str], *, is_json: bool, is_verbose: bool) -> tuple[str, int]:
    """Print an error on stderr (with --json also on stdout); return line and exit code."""
    message, remedy, code = _explain(error)
    if code == INTERRUPTED and remedy.endswith(RESUME):
        goes_on = shlex.join([words[0], RESUME, *(word for word in words[1:] if word != RESUME)])
        remedy = f"continue it with: splatctrl {goes_on}"
    if is_verbose:
        traceback.print_exception(error)
    line = " ".join((f"{message}; {remedy}" if remedy else message).split())
    print(f"splatctrl: {line}", file=sys.stderr)
    if is_json and not isinstance(sys.stdout, _Lost):
        with suppress(OSError):  # the error matters more than a failed print
            print(
                json.dumps(wrap_result({"error": {"message": message, "remedy": remedy}}, code), indent=2), flush=True
            )
    return line, code


def _explain(error: BaseException) -> tuple[str, str, int]:
    match error:
        case SplatCtrlError():
            return error.message, error.remedy, error.exit_code
        case KeyboardInterrupt():
            message, _, remedy = (str(error) or "interrupted").partition("; ")
            return message, remedy, INTERRUPTED
        case OSError() if is_write_failure(error):
            return f"{error.filename or 'output'}: writing failed: {error.strerror or error}", "make room", 6
        case OSError():
            what = f"{error.filename or 'input'}: cannot be read: {error.strerror or error}"
            return what, "check the path and its permissions", 4
        case MemoryError():
            return "input: asks for more memory than there is", "is it damaged, or too large for this machine", 4
        case UnicodeEncodeError():  # names of files are bytes to Linux
            name = error.object[max(error.start - 40, 0) : error.end + 40]
            return f"input: the name in {name!a} is not UTF-8 text", "give the file another name", 4
        case RecursionError():
            return "input: nested too deeply to be read", "is it damaged", 4
        case _:
            return f"internal error: {type(error).__name__}: {error}", "please report it", 70


class _Lost(io.TextIOBase):
    """Stand-in for a stream closed before the start (``>&-``)."""

    is_written = False

    def write(self, text: str) -> int:
        self.is_written = True
        return len(text)


def _stand_in_for_closed_streams() -> _Lost:
    """Replace closed stdout or stderr, and reserve their numbers; return the stand-in for stdout."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    lost = _Lost()
    sys.stdout = sys.stdout or lost
    sys.stderr = sys.stderr or _Lost()
    return lost


def _check_outputs(args: argparse.Namespace) -> None:
    out, report = getattr(args, "out", None), getattr(args, "junit", None)
    values = [value for name, value in vars(args).items() if name not in ("out", "junit")]
    arguments = [each for value in values for each in (value if isinstance(value, list) else [value])]
    inputs = [each for each in arguments if isinstance(each, Path)]
    try:
        if report is not None:
            _check_output(report, inputs, "--junit")
            check_replaceable(report)
            refuse_if(
                out is not None and _places(out) & {*_places(report), *report.absolute().parents},
                f"--junit {report}: is in --out, which appears whole",
                remedy="put it next to that folder",
                error=UsageError,
            )
    except UsageError:
        args.junit = None
        raise
    if out is not None:
        _check_output(out, inputs, "--out")


def _check_output(out: Path, inputs: Sequence[Path], option: str) -> None:
    check_can_be_written(out)
    targets = _places(out)
    for path in inputs:
        source = Path(os.path.realpath(path))
        refuse_if(
            targets & {source, *source.parents},
            f"{out}: would replace the input {path}",
            remedy=f"give another {option}",
            error=UsageError,
        )


def _places(output: Path) -> set[Path]:
    target = Path(os.path.realpath(output))  # resolve() raises RuntimeError for a link to itself
    return {target, target.with_name(target.name + PARTIAL)} if target.name else {target}


@cache
def refuse_endless_files() -> None:
    """Make reading a FIFO, socket or device raise OSError from now on, anywhere.

    A FIFO would wait for its writer; /dev/zero would fill the memory.
    """
    sys.addaudithook(_look)


def _look(event: str, arguments: tuple[object, ...]) -> None:
    if event != "open":
        return
    path, flags = arguments[0], arguments[2]
    if not isinstance(path, str | bytes) or (isinstance(flags, int) and flags & _WRITES):
        return
    name = os.fsdecode(path)
    if name.startswith(("/dev/stdin", "/dev/fd/", "/proc/self/fd/")) or name == os.devnull:  # as in --config <(...)
        return
    try:
        mode = os.stat(name).st_mode  # noqa: PTH116  (also called while Path itself is imported)
    except (OSError, ValueError):
        return
    kind = next((kind for kind, is_one in _NEVER_END.items() if is_one(mode)), None)
    if kind is not None:
        raise OSError(errno.EINVAL, f"is a {kind}, expected a file", name)
