"""An argument parser with one-line errors, short help, and one-line options."""

import argparse
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn, TypeVar

from splatctrl_cli.config.ranges import MAX_PLACE, OneOf, Section, Within, format_value
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_faults, refuse_if

T = TypeVar("T", int, float)

MAX_SECONDS = 1e8  # [s] of a recording: three years
GONE = {  # removed commands and options, with replacements
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
    """Argument parser that raises UsageError, also for subcommands.

    ``--help`` shows ungrouped options, ``--help-all`` all.
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
        """Refuse leftovers here, where the options are known."""
        self._words = list(sys.argv[1:] if args is None else args)
        parsed, left_over = super().parse_known_args(args, namespace)
        if left_over:
            self.error(f"unrecognized arguments: {' '.join(left_over)}")
        return parsed, left_over

    def error(self, message: str) -> NoReturn:
        """Raise UsageError with argparse's message and a remedy."""
        command = self.prog.partition(" ")[2]
        known = [*self._option_string_actions, "--"]
        if "required" in message:  # perhaps because it was misspelt
            unknown = [w for w in self._words if w.startswith("--") and w.partition("=")[0] not in known]
            message = f"unrecognized arguments: {unknown[0]}" if unknown else message
        raise UsageError(f"{command}: {message}" if command else message, remedy=self._remedy(message, known))

    def _remedy(self, message: str, options: Sequence[str]) -> str:
        unknown = re.match(r"unrecognized arguments: (-[^\s=]*)", message)
        choice = re.match(r"argument (\S+): invalid choice: '([^']*)'", message)
        without_value = re.match(r"argument (?:\S+/)?(--[^\s/]+): expected (?:one|at least one) argument", message)
        gone = GONE.get(choice[2] if choice else f"{self.prog} {unknown[1]}" if unknown else "")
        if gone is not None:
            return f"run {gone} instead"
        if without_value:
            return f"write {without_value[1]}=VALUE where the value begins with a minus, like {without_value[1]}=-1"
        word, known = (unknown[1], options) if unknown else ("", ())
        if choice:
            action = next((a for a in self._actions if choice[1] in {a.metavar, a.dest, *a.option_strings}), None)
            word, known = choice[2], [str(name) for name in (action.choices if action else None) or ()]
        return did_you_mean(word, known, f"see {self.prog} --help", cutoff=0.75)

    @property
    def actions(self) -> "argparse._SubParsersAction[Parser] | None":
        return next((action for action in self._actions if isinstance(action, argparse._SubParsersAction)), None)

    @property
    def groups(self) -> list[tuple[str, list[argparse.Action]]]:
        """Options by group title; ``--help`` shows the first."""
        first = [action for group in self._action_groups[:2] for action in group._group_actions]
        more = [*self._action_groups[2:], self.run_group]
        return [
            ("", first),
            *((group.title or "", group._group_actions) for group in more if group._group_actions),
        ]

    def format_usage(self) -> str:
        either = [group for group in self._mutually_exclusive_groups if group.required]
        grouped = {id(action) for group in either for action in group._group_actions}
        required = [f"({' | '.join(invocation(a) for a in group._group_actions)})" for group in either]
        single = [a for a in self._actions if a.option_strings and a.required and id(a) not in grouped]
        required += [invocation(action) for action in single]
        places = [invocation(action) for action in self._actions if not action.option_strings]
        return " ".join(["usage:", self.prog, *places, *required, "[options]"]) + "\n"

    def format_help(self) -> str:
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
"""A function that adds options to a parser or to a parser's group."""


def option(
    name: str,
    meaning: str,
    kind: Callable[[str], Any] | Sequence[str] | None = None,
    default: Any = None,
    *,
    fields: Mapping[str, Callable[[Any], Any] | str] | None = None,
    sets: tuple[type[Section], str] | None = None,
    **more: Any,
) -> Adds:
    """Declare ``-o/--out PATH``, ``--flag``, ``--repeatable NAME ...`` or a ``PLACE``.

    kind: converts the text, or a tuple of choices. default: shown in the help. fields: of a request, each with a
    function of the option's value, or the function's MODULE:NAME if heavy. Default: the field of its name. sets: a
    key of the configuration, which implies the kind. more: arguments of argparse.
    """
    if sets is not None:
        declared, of_default = sets[0].declared[sets[1]], type(getattr(*sets))
        kind = declared.words if isinstance(declared, OneOf) else _parse_within(of_default, declared)
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

    def add(container: Any) -> None:
        action = container.add_argument(*names, help=meaning.replace("%", "%%"), **more)
        same = tuple if repeats or more.get("nargs") == "+" else lambda value: value
        action.fields = fields or {action.dest: same}
        action.sets = "" if sets is None else f"{sets[0].section}.{sets[1]}"

    return add


def group(title: str, *options: Adds) -> Adds:
    return lambda container: add_all(container.add_argument_group(title), options)


def either(*options: Adds, required: bool = False) -> Adds:
    """Options of which at most one may be given; exactly one if `required`."""
    return lambda container: add_all(container.add_mutually_exclusive_group(required=required), options)


def join_run_options(*options: Adds) -> Adds:
    """Options of the last group, in every command."""
    return lambda parser: add_all(parser.run_group, options)


def add_all(container: Any, options: Iterable[Adds]) -> None:
    for add in options:
        add(container)


class _HelpAll(argparse.Action):
    def __call__(self, parser: Any, *_: object) -> None:
        print(parser.format_full_help(), end="")
        parser.exit()


class _Formatter(argparse.HelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28, width=min(shutil.get_terminal_size().columns - 2, 100))

    def _format_action_invocation(self, action: argparse.Action) -> str:
        return invocation(action)


def invocation(action: argparse.Action) -> str:
    """``-o, --out PATH``, alike in all Python versions."""
    if not action.option_strings:
        name = str(action.metavar or action.dest)
        return {"?": f"[{name}]", "+": f"{name} ..."}.get(str(action.nargs), name)
    names = ", ".join(action.option_strings)
    if action.nargs == 0:
        return names
    choices = f"{{{','.join(map(str, action.choices or ()))}}}"
    return f"{names} {choices if action.choices else action.metavar or action.dest.upper()}"


def real(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """Parser of a number in [low, high]."""
    return _parse_within(float, Within(low, high, unit, ""))


def whole(low: int, high: int, unit: str = "") -> Callable[[str], int]:
    """Parser of a whole number in [low, high]."""
    return _parse_within(int, Within(low, high, unit, ""))


def several(text: str) -> tuple[float, ...]:
    """Numbers joined by commas; empty if any is invalid or beyond `MAX_PLACE`."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return values if all(abs(value) <= MAX_PLACE for value in values) else ()


def _parse_within(kind: Callable[[str], T], declared: Within) -> Callable[[str], T]:
    def parse(text: str) -> T:
        what = f"expected {'a whole number, ' if kind is int else ''}{declared.expected}, got {format_value(text)}"
        with refuse_faults(lambda _: what, ValueError, error=argparse.ArgumentTypeError):
            value = kind(text)
        refuse_if(not declared.holds(value), what, error=argparse.ArgumentTypeError)
        return value

    return parse
