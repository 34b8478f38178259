"""An argument parser whose errors are one line with a remedy, as every other error of the tool is."""

import argparse
import difflib
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from splatctrl_cli.errors import UsageError


class Parser(argparse.ArgumentParser):
    """Raises UsageError where argparse prints its usage and leaves; the parsers of subcommands are of this class."""

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
        near = ""
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


def _nearest(word: str, known: Iterable[object]) -> str:
    return next(iter(difflib.get_close_matches(word, [str(name) for name in known], n=1, cutoff=0.75)), "")
