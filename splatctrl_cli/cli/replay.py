"""``splatctrl replay``."""

import argparse

from splatctrl_cli.cli.common import Subparsers, add_command


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    add_command(subparsers, "replay", run, summary="replay")


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    raise NotImplementedError
