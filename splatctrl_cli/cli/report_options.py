"""The options of ``report`` and ``view``."""

from pathlib import Path

from splatctrl_cli.cli.options import add_output
from splatctrl_cli.cli.parser import Options, Parser

ROOT = "folder in which the scene and robot of a replay's command line are looked for, if they were moved"


def report_options(add: Options, parser: Parser) -> None:
    """Of ``report``."""
    add("PATH", "the folder of a run, or of a batch", Path)
    add_output(add, "HTML file to write", default="PATH.html, beside PATH")
    add(
        "--changes FILE.json",
        "what changed against a baseline: a JSON list of objects, a row each (docs/report.md)",
        Path,
    )
    add("--all-scenes", "of a batch, every replay in 3-D, not only the failed, changed and worst")
    add("--root DIR ...", ROOT, Path)


def view_options(add: Options, parser: Parser) -> None:
    """Of ``view``."""
    add("PATH", "a run, scene or field folder, a field.npz, or a splat file", Path)
    add_output(add, "HTML file to write", default="PATH.html, beside PATH")
    add("--no-open", "do not open it in a browser")
    add("--root DIR ...", ROOT, Path)
