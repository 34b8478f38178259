"""``splatctrl``: parses the words, runs one subcommand, turns errors into one line and an exit code."""

import argparse
import errno
import io
import os
import stat
import sys
import traceback
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from splatctrl_cli.cli.commands import build_parser, function_of
from splatctrl_cli.errors import SplatCtrlError, UsageError
from splatctrl_cli.files.output import PARTIAL, check_can_be_written, is_write_failure

MAX_PIXELS = 1 << 27  # of an image file: twice the largest cameras; a small file can announce a thousand million

_BY_THE_SHELL = ("/dev/stdin", "/dev/fd/", "/proc/self/fd/")  # as in --config <(...)
_WRITES = os.O_WRONLY | os.O_RDWR
_NEVER_END = {"FIFO": stat.S_ISFIFO, "socket": stat.S_ISSOCK, "device": stat.S_ISCHR, "disk": stat.S_ISBLK}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; 6 where stdout was closed and there was something to print."""
    lost = _stand_in_for_closed_streams()
    code = _run(argv)
    if lost.is_written and code not in {70, 130}:
        print(
            "splatctrl: stdout: closed, so the result was not printed; files are as they should be", file=sys.stderr
        )
        return 6
    return code


def _run(argv: Sequence[str] | None) -> int:
    verbose = 0
    refuse_endless_files()
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # read when cv2 is first imported
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of numpy; more wait for each other, and round otherwise
    try:
        words = sys.argv[1:] if argv is None else list(argv)
        args = build_parser(words[0] if words else "").parse_args(words)
        verbose = args.verbose
        _check_output(args)
        code = function_of(args.run)(args)
        sys.stdout.flush()
        return code
    except SplatCtrlError as error:
        return _fail(error, str(error), error.exit_code, verbose)
    except KeyboardInterrupt as error:
        return _fail(error, str(error) or "interrupted", 130, verbose)
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        return _fail_to_read_or_write(error, verbose)
    except MemoryError as error:
        line = "input: asks for more memory than there is; is it damaged, or too large for this machine"
        return _fail(error, line, 4, verbose)
    except UnicodeEncodeError as error:  # names of files are bytes to Linux
        name = error.object[max(error.start - 40, 0) : error.end + 40]
        line = f"input: the name in {name!a} is not UTF-8 text; give the file another name"
        return _fail(error, line, 4, verbose)
    except RecursionError as error:
        return _fail(error, "input: nested too deeply to be read; is it damaged", 4, verbose)
    except Exception as error:
        return _fail(error, f"internal error: {type(error).__name__}: {error}; please report it", 70, verbose)


class _Lost(io.TextIOBase):
    """Stands where a stream was closed before the program began (``>&-``), and knows whether it was written to."""

    is_written = False

    def write(self, text: str) -> int:
        """Take the text to nowhere."""
        self.is_written = True
        return len(text)


def _stand_in_for_closed_streams() -> _Lost:
    """Replace stdout or stderr where it is closed, and keep its number from the next file that is opened.

    Returns what stands for stdout; nothing is ever written to it where stdout is open.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    lost = _Lost()
    sys.stdout = sys.stdout or lost
    sys.stderr = sys.stderr or _Lost()
    return lost


def _fail_to_read_or_write(error: OSError, verbose: int) -> int:
    reason = error.strerror or error
    if is_write_failure(error):
        return _fail(error, f"{error.filename or 'output'}: writing failed: {reason}; make room", 6, verbose)
    line = f"{error.filename or 'input'}: cannot be read: {reason}; check the path and its permissions"
    return _fail(error, line, 4, verbose)


def _check_output(args: argparse.Namespace) -> None:
    """Refuse an output that cannot be written, or that is or holds an input, itself or its partial."""
    out = getattr(args, "out", None)
    if out is None:
        return
    check_can_be_written(out)
    target = Path(os.path.realpath(out))  # resolve() raises RuntimeError for a link to itself
    targets = {target, target.with_name(target.name + PARTIAL)} if target.name else {target}
    values = [value for name, value in vars(args).items() if name != "out"]
    for given in [each for value in values for each in (value if isinstance(value, list) else [value])]:
        if isinstance(given, Path):
            source = Path(os.path.realpath(given))
            if targets & {source, *source.parents}:
                raise UsageError(f"{out}: would replace the input {given}", remedy="give another --out")


def _fail(error: BaseException, line: str, code: int, verbose: int) -> int:
    if verbose:
        traceback.print_exception(error)
    print(f"splatctrl: {' '.join(line.split())}", file=sys.stderr)
    return code


@cache
def refuse_endless_files() -> None:
    """From now on, opening what is no file to read it raises OSError, wherever in the program that is.

    A FIFO in a folder of images would wait for its writer, a link to /dev/zero would fill the memory. Folders hold
    millions of files and are read in many places, so it is the interpreter that looks, once for each file it opens.
    """
    sys.addaudithook(_look)


def _look(event: str, arguments: tuple[object, ...]) -> None:
    if event != "open":
        return
    path, flags = arguments[0], arguments[2]
    if not isinstance(path, str | bytes) or (isinstance(flags, int) and flags & _WRITES):
        return
    name = os.fsdecode(path)
    if name.startswith(_BY_THE_SHELL) or name == os.devnull:
        return
    try:
        mode = os.stat(name).st_mode  # noqa: PTH116  (also called while Path itself is imported)
    except (OSError, ValueError):
        return
    kind = next((kind for kind, is_one in _NEVER_END.items() if is_one(mode)), None)
    if kind is not None:
        raise OSError(errno.EINVAL, f"is a {kind}, expected a file", name)
