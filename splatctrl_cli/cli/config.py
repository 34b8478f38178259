"""``splatctrl config``: the settings that a run would use and where each comes from; a template to begin with."""

import argparse

from splatctrl_cli.cli.common import Console
from splatctrl_cli.jobs.settings import resolved_settings, template_of, toml_of


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    console, settings = Console(args), resolved_settings(args.file, args.set)
    lines = template_of(settings) if args.template else toml_of(settings)
    console.result({"settings": {setting.name: setting.as_dict() for setting in settings}}, lines)
    return 0
