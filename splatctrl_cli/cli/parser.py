"""An argument parser whose errors are one line with a remedy, as every other error of the tool is."""

import argparse
import difflib
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from splatctrl_cli.errors import UsageError

COMMANDS = {
    "simulate": "write a recorded log (ROS 2 MCAP) of an arm at a table, with its truth",
    "ingest": "turn a log or image folder into a capture folder",
    "info": "describe a log, capture, scene, grid, robot or other file",
    "check": "say what is wrong with a log, capture or image folder",
    "reconstruct": "fit splats to a log, a capture or a DTU scan",
    "export": "write splats as a file that viewers open, and check what reads back",
    "sdf-bake": "bake a scene's splats into a distance grid with gradient",
    "score": "compare renders of a scene with recorded views (by default of the cameras that did not train it): "
    "PSNR, SSIM, depth error, by a named protocol; or fit scans first (--fit)",
    "replay": "audit logged joint states, ask the controller at each, or drive the arm in closed loop",
    "robot": "fit and measure a robot's collision spheres, list its self-collision pairs and limits",
    "demo": "run the main job on a sample recording, with pictures",
    "capture": "pack a capture into one MCAP that viewers open, and unpack it",
}


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
