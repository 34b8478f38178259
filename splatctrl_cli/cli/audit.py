"""``splatctrl audit``: from a recording to a verdict and its page."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.batch import OfThisProgram, find_action, words_of
from splatctrl_cli.cli.common import Console, request_of
from splatctrl_cli.jobs.audit import AuditRequest, audit

OWN = ("log", "urdf", "robot", "spheres", "goal", "goal-joints", "frame")  # all others are options of every step


def run(args: argparse.Namespace, console: Console) -> int:
    options = OfThisProgram(threads=0).options_of(["audit", *args.parser._words])
    shared = {find_action(args.parser, "audit", name): value for name, value in options.items() if name not in OWN}
    words = [word for action, value in shared.items() for word in words_of("audit", action, value, Path())]
    result = audit(request_of(AuditRequest, args, words=tuple(words)), console)
    return console.show(result, [f"page: {result.document['page']}"], has_findings=True)
