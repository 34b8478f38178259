"""``splatctrl config``: what a run would use and where each setting comes from; a template; the schema of --json."""

import argparse
import json

from splatctrl_cli.cli.common import Console
from splatctrl_cli.cli.envelope import SCHEMA_FILE
from splatctrl_cli.jobs.settings import resolved_settings, template_of, toml_of


def run(args: argparse.Namespace) -> int:
    console = Console(args)
    if args.schema:
        text = SCHEMA_FILE.read_text(encoding="utf-8")
        console.result({"json_schema": json.loads(text)}, text.splitlines())
        return 0
    settings = resolved_settings(args.file, args.set)
    lines = template_of(settings) if args.template else toml_of(settings)
    console.result({"settings": {setting.name: setting.as_dict() for setting in settings}}, lines)
    return 0
