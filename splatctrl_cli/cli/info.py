"""``splatctrl info``."""

import argparse

from splatctrl_cli.cli.common import Subparsers, add_command


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    add_command(subparsers, "info", run, summary="info")


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    raise NotImplementedError
