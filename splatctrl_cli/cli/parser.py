"""An argument parser whose errors are one line with a remedy, whose help fits a screen, and whose options are
declared a line each.
"""

import argparse
import difflib
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn, TypeVar

from splatctrl_cli.config.ranges import MAX_PLACE, OneOf, Section, Within, shown
from splatctrl_cli.errors import UsageError

T = TypeVar("T", int, float)

MAX_SECONDS = 1e8  # [s] of a recording: three years
MOST_WIDTH = 100  # columns of help
GONE = {  # commands and options that left the command line, and what takes their place
    "capture": "`tar -cf X.tar X.capture` for one file, `splatctrl export REPLAY --mcap` for a viewer",
    "splatctrl reconstruct --method": "python -m experiments fits",
    **dict.fromkeys(
        (f"splatctrl score --{name}" for name in ("fit", "fit-iterations", "fit-splats")),
        "python -m experiments fits",
    ),
    "splatctrl score --lpips": "the package lpips on renders and photos",
    "study": "python -m experiments",
    **dict.fromkeys((f"splatctrl replay --{name}" for name in ("golden", "golden-tolerance")), "splatctrl compare"),
    **dict.fromkeys(
        (f"splatctrl replay --{name}" for name in ("baseline", "zone", "zone-box", "human")),
        "python -m experiments baselines",
    ),
    "splatctrl simulate --environment": "python -m experiments record",
    "splatctrl simulate --human-arm": "python -m experiments record",
    "splatctrl simulate --num-cameras": "python -m experiments record",
}


class Parser(argparse.ArgumentParser):
    """Raises UsageError where argparse prints its usage and leaves; the parsers of subcommands are of this class.

    ``--help`` shows what stands in no group of its own; ``--help-all`` shows everything.
    """

    def __init__(self, *, examples: Sequence[str] = (), **kwargs: Any) -> None:
        kwargs |= {"allow_abbrev": False, "add_help": False, "formatter_class": _Formatter}
        super().__init__(**kwargs)
        self.run_group = argparse._ArgumentGroup(self, "run")  # the last of the groups, which every command has
        self.examples = examples
        option("-h/--help", "show this help and exit", action="help")(self)
        if self.prog != "splatctrl":
            option("--help-all", "show every option", action=_HelpAll, nargs=0)(self)

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> tuple[Any, list[str]]:  # type: ignore[override]
        """As in argparse, but what is left over is refused here, by the parser that knows the options."""
        self._words = list(sys.argv[1:] if args is None else args)
        parsed, left_over = super().parse_known_args(args, namespace)
        if left_over:
            self.error(f"unrecognized arguments: {' '.join(left_over)}")
        return parsed, left_over

    def error(self, message: str) -> NoReturn:
        """Raise UsageError with argparse's message and what to do about it."""
        command = self.prog.partition(" ")[2]
        if "required" in message:  # perhaps because it was misspelt
            unknown = [w for w in self._words if w.startswith("--") and w.partition("=")[0] not in self._known()]
            message = f"unrecognized arguments: {unknown[0]}" if unknown else message
        raise UsageError(f"{command}: {message}" if command else message, remedy=self._remedy(message))

    def _remedy(self, message: str) -> str:
        unknown = re.match(r"unrecognized arguments: (-[^\s=]*)", message)
        choice = re.match(r"argument (\S+): invalid choice: '([^']*)'", message)
        lacking = re.match(r"argument (?:\S+/)?(--[^\s/]+): expected (?:one|at least one) argument", message)
        near, gone = "", GONE.get(choice[2] if choice else f"{self.prog} {unknown[1]}" if unknown else "")
        if gone is not None:
            return f"run {gone} instead"
        if unknown:
            near = _nearest(unknown[1], self._known())
        elif choice:
            action = next((a for a in self._actions if choice[1] in {a.metavar, a.dest, *a.option_strings}), None)
            near = _nearest(choice[2], (action.choices if action else None) or ())
        elif lacking:
            return f"write {lacking[1]}=VALUE where the value begins with a minus, like {lacking[1]}=-1"
        return f"did you mean {near}?" if near else f"see {self.prog} --help"

    def _known(self) -> list[str]:
        return [*self._option_string_actions, "--"]

    @property
    def actions(self) -> "argparse._SubParsersAction[Parser] | None":
        """The parsers below this one, None where it takes options itself."""
        return next((action for action in self._actions if isinstance(action, argparse._SubParsersAction)), None)

    @property
    def groups(self) -> list[tuple[str, list[argparse.Action]]]:
        """Options by the title of their group, the first of which are what ``--help`` shows."""
        shown = [action for group in self._action_groups[:2] for action in group._group_actions]
        more = [*self._action_groups[2:], self.run_group]
        return [("", shown), *((group.title or "", group._group_actions) for group in more if group._group_actions)]

    def format_usage(self) -> str:
        """One line: places, and options that are required."""
        either = [group for group in self._mutually_exclusive_groups if group.required]
        grouped = {id(action) for group in either for action in group._group_actions}
        required = [f"({' | '.join(invocation(a) for a in group._group_actions)})" for group in either]
        single = [a for a in self._actions if a.option_strings and a.required and id(a) not in grouped]
        required += [invocation(action) for action in single]
        places = [invocation(action) for action in self._actions if not action.option_strings]
        return " ".join(["usage:", self.prog, *places, *required, "[options]"]) + "\n"

    def format_help(self) -> str:
        """What people use, and examples."""
        num_hidden = sum(len(actions) for _, actions in self.groups[1:])
        titles = ", ".join(title for title, _ in self.groups[1:])
        examples = "".join(f"  splatctrl {example}\n" for example in self.examples)
        return (
            self._format(self._action_groups[:2])
            + (f"\nexamples:\n{examples}" if examples else "")
            + (f"\n--help-all shows {num_hidden} more options: {titles}\n" if num_hidden else "")
            + (f"\n{self.epilog}\n" if self.epilog else "")
        )

    def format_full_help(self) -> str:
        """Every option, by group."""
        return self._format([*self._action_groups, self.run_group])

    def _format(self, groups: Iterable[argparse._ArgumentGroup]) -> str:
        formatter = self._get_formatter()
        formatter.add_text(self.description)
        for group in groups:
            formatter.start_section(group.title)
            formatter.add_arguments(group._group_actions)
            formatter.end_section()
        return f"{self.format_usage()}\n{formatter.format_help()}"


Adds = Callable[[Any], None]
"""An option, or a group of them, which a parser or a group of one is given to be added to."""


def option(
    name: str,
    meaning: str,
    kind: Callable[[str], Any] | Sequence[str] | None = None,
    default: Any = None,
    **more: Any,
) -> Adds:
    """``-o/--out PATH``, ``--flag``, ``--repeatable NAME ...`` or a ``PLACE``, declared a line each.

    kind: what makes the value of the text, or the words to choose from. default: of an option that is not given;
    the help says it where it is a number or a word. more: as in argparse.
    """
    flags, _, metavar = name.partition(" ")
    is_place, repeats = not flags.startswith("-"), metavar.endswith(" ...")
    if isinstance(kind, tuple):
        more["choices"] = kind
    elif kind is not None:
        more["type"] = kind
    if is_place or metavar:
        more["metavar"] = flags if is_place else metavar.removesuffix(" ...")
    elif not isinstance(kind, tuple):
        more.setdefault("action", "store_true")
    if repeats:
        more |= {"action": "append", "default": []}
        meaning += " (repeatable)"
    elif default is not None:
        more["default"] = default
    if default is not None and default != [] and more.get("action") != "count":
        meaning += f" (default: {default:g})" if isinstance(default, int | float) else f" (default: {default})"
    names = [flags.lower()] if is_place else flags.split("/")
    return lambda container: container.add_argument(*names, help=meaning.replace("%", "%%"), **more)


def group(title: str, *options: Adds) -> Adds:
    """Options that ``--help-all`` alone shows."""
    return lambda container: add_all(container.add_argument_group(title), options)


def either(*options: Adds, required: bool = False) -> Adds:
    """Options of which one may be given, or has to be."""
    return lambda container: add_all(container.add_mutually_exclusive_group(required=required), options)


def of_run(*options: Adds) -> Adds:
    """Options of the last group, which every command has."""
    return lambda parser: add_all(parser.run_group, options)


def add_all(container: Any, options: Iterable[Adds]) -> None:
    """Add them to a parser, or to a group of one."""
    for add in options:
        add(container)


class _HelpAll(argparse.Action):
    """Prints everything and leaves."""

    def __call__(self, parser: Any, *_: object) -> None:
        print(parser.format_full_help(), end="")
        parser.exit()


class _Formatter(argparse.HelpFormatter):
    """Up to MOST_WIDTH columns, with room for the names of options."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28, width=min(shutil.get_terminal_size().columns - 2, MOST_WIDTH))

    def _format_action_invocation(self, action: argparse.Action) -> str:
        return invocation(action)


def invocation(action: argparse.Action) -> str:
    """``-o, --out PATH``, the same in every version of Python."""
    if not action.option_strings:
        name = str(action.metavar or action.dest)
        return {"?": f"[{name}]", "+": f"{name} ..."}.get(str(action.nargs), name)
    names = ", ".join(action.option_strings)
    if action.nargs == 0:
        return names
    if action.choices:
        return f"{names} {{{','.join(map(str, action.choices))}}}"
    return f"{names} {action.metavar or action.dest.upper()}"


def real(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """A number from `low` to `high`, both allowed, in `unit`."""
    return _bounded(float, Within(low, high, unit, ""))


def whole(low: int, high: int, unit: str = "") -> Callable[[str], int]:
    """A whole number from `low` to `high`, both allowed."""
    return _bounded(int, Within(low, high, unit, ""))


def setting(section: type[Section], key: str) -> Callable[[str], float]:
    """A number that stands for a key of the configuration: its type and range."""
    declared = section.declared[key]
    assert isinstance(declared, Within)
    return _bounded(int if type(getattr(section, key)) is int else float, declared)


def words(section: type[Section], key: str) -> tuple[str, ...]:
    """The words that a key of the configuration may be."""
    declared = section.declared[key]
    assert isinstance(declared, OneOf)
    return declared.words


def several(text: str) -> tuple[float, ...]:
    """Numbers joined by commas; none where one of them is not a number, or not within `MAX_PLACE`."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return values if all(abs(value) <= MAX_PLACE for value in values) else ()


def _bounded(kind: Callable[[str], T], declared: Within) -> Callable[[str], T]:
    def parse(text: str) -> T:
        what = f"expected {'a whole number, ' if kind is int else ''}{declared.expected}, got {shown(text)}"
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(what) from None
        if not declared.holds(value):
            raise argparse.ArgumentTypeError(what)
        return value

    return parse


def _nearest(word: str, known: Iterable[object]) -> str:
    return next(iter(difflib.get_close_matches(word, [str(name) for name in known], n=1, cutoff=0.75)), "")
