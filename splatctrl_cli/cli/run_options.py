"""The options of ``batch``, ``sweep``, ``study``, ``compare``, ``report`` and ``view``: of many runs."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.options import add_output, add_threads
from splatctrl_cli.cli.parser import Options, Parser, real, whole

ROOT = "folder in which the scene and robot of a replay's command line are looked for, if they were moved"


def report_options(add: Options, parser: Parser) -> None:
    add("PATH", "the folder of a run, or of a batch", Path)
    add_output(add, "HTML file to write", default="PATH.html, beside PATH")
    add(
        "--against BEFORE",
        "say what changed since an earlier run or batch, or a baseline of compare --update-baseline",
        Path,
    )
    add("--all-scenes", "of a batch, every replay in 3-D, not only the failed, changed and worst")
    add("--root DIR ...", ROOT, Path)


def view_options(add: Options, parser: Parser) -> None:
    add("PATH", "a run, scene or field folder, a field.npz, or a splat file", Path)
    add_output(add, "HTML file to write", default="PATH.html, beside PATH")
    add("--no-open", "do not open it in a browser")
    add("--root DIR ...", ROOT, Path)


def batch_options(add: Options, parser: Parser) -> None:
    add("SUITE", "TOML file of recordings and jobs (docs/batch.md); with --list also a batch's folder", Path)
    add("-o/--out DIR", "folder of the batch, where it goes on (default: what the suite says, or SUITE.out)", Path)
    add("--workers N", "nodes that run at once (default: one per core)", whole(1, 256))
    add("--shard I/N", "only every N-th recording, from the I-th on", _shard)
    add("--again", "run what is done, too")
    add("--dry-run", "print the nodes and their command lines, and run nothing")
    add("--dask ADDRESS", "run the nodes on a Dask cluster that shares this folder")
    listing = add.group("ledger")
    listing("--list", "print what ran last, and run nothing")
    listing("--failed", "as --list, of what did not end as expected")
    listing("--where COLUMN=VALUE ...", "as --list, of the runs for which it holds; also !=, <, >, <=, >=")
    listing("--csv FILE", "as --list, into a table with every column", Path)


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdigit() and count.isdigit() and 1 <= int(index) <= int(count)):
        raise argparse.ArgumentTypeError(f"expected I/N with I from 1 to N, got {text!r}")
    return int(index), int(count)


def sweep_options(add: Options, parser: Parser) -> None:
    add("REPLAY", "the folder that replay wrote", Path)
    keys = (
        "splats, cameras-out, depth-noise, pose-error, pose-turn, latency, margin, ... (docs/sweep.md), or a setting"
    )
    add("--over KEY=A:B ...", f"what is varied, from A to B: {keys}")
    add("-o/--out DIR", "folder of the sweep, where it goes on (default: sweep)", Path)
    near = "how near the two sides of a flip are to lie, as a share of the range"
    add("--tolerance SHARE", near, real(1e-6, 0.5), 1 / 64)
    add("--workers N", "runs at once (default: one per core)", whole(1, 256))
    add("--dask ADDRESS", "make the runs on a Dask cluster that shares this folder")


def study_options(add: Options, parser: Parser) -> None:
    """Of ``splatctrl study``."""
    add("STUDY", "which experiment of the paper", ("table2", "scenes", "shared-workspace", "dtu", "ablation"))
    add("-o/--out DIR", "folder of the study, where it goes on (default: STUDY)", Path)
    add("--trials N", "problems of each kind (default: as many as the paper's)", whole(1, 100_000))
    add("--methods A,B", "some of the study's (docs/study.md; default: all that are installed)", _names)
    add("--problems DIR", "table2: MotionBenchMaker's (default: of SPLATCTRL_REAL_DATA); dtu: a tree of scans", Path)
    add("--width PX", "of the cameras' images (default: 320; scenes 640, shared-workspace 160)", whole(32, 1280))
    add("--workers N", "problems that run at once (default: one per core)", whole(1, 256))
    add("--shard I/N", "only every N-th problem, from the I-th on", _shard)
    add("--dask ADDRESS", "run the problems on a Dask cluster that shares this folder")
    add("--made PATH ...", "make the table of these trials (trials.csv, or a study's folder), and run none", Path)
    add("--problem NAME", "run one problem alone, such as cubby-0007, wall-0002 or near-goal-0003")
    add("--force", "replace the output of --problem if it exists")
    add_threads(parser)


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def compare_options(add: Options, parser: Parser) -> None:
    add("OUTPUT", "folder that a command or a batch wrote; of two the earlier first", Path, nargs="+")
    add("--against FILE", "compare the only OUTPUT with this stored baseline", Path)
    add("--update-baseline FILE", "write the last OUTPUT as a baseline, alone or after the comparison", Path)
