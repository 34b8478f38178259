"""The options of ``batch``, ``sweep``, ``compare``, ``report`` and ``view``: of many runs."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.options import output
from splatctrl_cli.cli.parser import group, option, real, whole

ROOT = "folder in which the scene and robot of a replay's command line are looked for, if they were moved"


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdigit() and count.isdigit() and 1 <= int(index) <= int(count)):
        raise argparse.ArgumentTypeError(f"expected I/N with I from 1 to N, got {text!r}")
    return int(index), int(count)


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


REPORT = (
    option("PATH", "the folder of a run, or of a batch", Path),
    *output("HTML file to write", default="PATH.html, beside PATH"),
    option(
        "--against BEFORE",
        "say what changed since an earlier run or batch, or a baseline of compare --update-baseline",
        Path,
    ),
    option("--all-scenes", "of a batch, every replay in 3-D, not only the failed, changed and worst"),
    option("--root DIR ...", ROOT, Path),
)
VIEW = (
    option("PATH", "a run, scene or field folder, a field.npz, or a splat file", Path),
    *output("HTML file to write", default="PATH.html, beside PATH"),
    option("--no-open", "do not open it in a browser"),
    option("--root DIR ...", ROOT, Path),
)
BATCH = (
    option("SUITE", "TOML file of recordings and jobs (splatctrl help batch); with --list also an output", Path),
    option(
        "-o/--out DIR", "folder of the batch, where it goes on (default: what the suite says, or SUITE.out)", Path
    ),
    option("--workers N", "nodes that run at once (default: one per core)", whole(1, 256)),
    option("--shard I/N", "only every N-th recording, from the I-th on", _shard),
    option("--again", "run what is done, too"),
    option("--dry-run", "print the nodes and their command lines, and run nothing"),
    option("--dask ADDRESS", "run the nodes on a Dask cluster that shares this folder"),
    group(
        "ledger",
        option("--list", "print what ran last, and run nothing"),
        option("--failed", "as --list, of what did not end as expected"),
        option("--where COLUMN=VALUE ...", "as --list, of the runs for which it holds; also !=, <, >, <=, >="),
        option("--csv FILE", "as --list, into a table with every column", Path),
    ),
)
SWEEP = (
    option("REPLAY", "the folder that replay wrote", Path),
    option(
        "--over KEY=A:B ...",
        "what is varied, from A to B: splats, cameras-out, depth-noise, pose-error, pose-turn, latency, margin, ..."
        " (splatctrl help sweep), or a setting",
    ),
    option("-o/--out DIR", "folder of the sweep, where it goes on (default: sweep)", Path),
    option(
        "--tolerance SHARE",
        "how near the two sides of a flip are to lie, as a share of the range",
        real(1e-6, 0.5),
        1 / 64,
    ),
    option("--workers N", "runs at once (default: one per core)", whole(1, 256)),
    option("--dask ADDRESS", "make the runs on a Dask cluster that shares this folder"),
)
COMPARE = (
    option("OUTPUT", "folder that a command or a batch wrote; of two the earlier first", Path, nargs="+"),
    option("--against FILE", "compare the only OUTPUT with this stored baseline", Path),
    option("--update-baseline FILE", "write the last OUTPUT as a baseline, alone or after the comparison", Path),
)
