"""``splatctrl``: builds the parser, runs one subcommand, turns errors into one line and an exit code.

A subcommand's file is imported when it is named, so ``splatctrl --help`` answers at once.
"""

import argparse
import importlib
import io
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from splatctrl_cli import __version__
from splatctrl_cli.cli.inputs import refuse_endless_files
from splatctrl_cli.cli.parser import COMMANDS, Parser
from splatctrl_cli.errors import SplatCtrlError, UsageError

MAX_PIXELS = 1 << 27  # of an image file: twice the largest cameras; a small file can announce a thousand million

EXIT_CODES = """\
exit codes: 0 done; 1 a gate or check failed; 2 usage, configuration or output; 3 done, but part of the input was
damaged; 4 input missing or unusable; 5 cannot be evaluated; 6 writing failed; 70 our own bug; 130 interrupted"""


def build_parser(words: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """The parser with all subcommands and their options, or with those of the one that `words` begin with alone: a
    run neither waits for the files of the other subcommands nor fails with them.
    """
    parser = Parser(
        prog="splatctrl",
        description="What did the robot's cameras know, and would this controller have kept it safe?",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"splatctrl {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command, summary in COMMANDS.items():
        if words is None or [command] == list(words[:1]):
            module = importlib.import_module(f"splatctrl_cli.cli.{command.replace('-', '_')}")
            module.register(subparsers)
        else:
            subparsers.add_parser(command, help=summary, add_help=False)
    return parser


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
        words = sys.argv[1:] if argv is None else argv
        args = build_parser(words).parse_args(words)
        verbose = args.verbose
        _check_output(args)
        code: int = args.run(args)
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
        line = f"input: the name in {name!a} is no UTF-8 text; give the file another name"
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
    from splatctrl_cli.files.output import is_write_failure

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
    from splatctrl_cli.files.output import PARTIAL, check_can_be_written

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
