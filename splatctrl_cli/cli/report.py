"""``splatctrl report``, ``view`` and ``render``: HTML pages, pictures and videos."""

import argparse
import os
import sys
import webbrowser
from pathlib import Path

from splatctrl_cli.cli.common import Console, remarks, request_of
from splatctrl_cli.jobs.render import RenderSceneRequest, render_scene
from splatctrl_cli.jobs.report.report import ViewRequest, WriteReportRequest, view, write_report

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")  # one of which is set on Linux where a browser can open a window
MOST_NOTES = 5


def run(args: argparse.Namespace, console: Console) -> int:
    result = write_report(request_of(WriteReportRequest, args), console)
    more = len(result.notes) - MOST_NOTES
    lines = [
        "{}: {num_runs} runs, {num_scenes} in 3-D, {bytes} bytes".format(result.out, **result.metrics),
        *result.notes[:MOST_NOTES],
        *remarks((f"and {more} more not in 3-D", more > 0)),
    ]
    return console.show(result, lines)


def run_view(args: argparse.Namespace, console: Console) -> int:
    result = view(request_of(ViewRequest, args))
    pattern = "{}: {num_splats} splats, {num_states} states, {num_unknown} cubes of unseen space, {bytes} bytes"
    is_opened = not args.no_open and result.out is not None and open_page(result.out)
    console.result({**result.document, "is_opened": is_opened}, [pattern.format(result.out, **result.metrics)])
    if not is_opened and not args.no_open:
        console.log(f"no browser here: open {result.out and result.out.absolute()}")
    return 0


def run_render(args: argparse.Namespace, console: Console) -> int:
    result = render_scene(request_of(RenderSceneRequest, args))
    line = "{}: {width}x{height}, pictures: {num_pictures}".format(result.out, **result.metrics)
    return console.show(result, [line])


def open_page(page: Path) -> bool:
    """Open a page in a browser window; False without one."""
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in SCREENS):
        return False
    return webbrowser.open(page.absolute().as_uri())
