"""Whole processes, as a person starts them."""

import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.measure import ROBOT, SAMPLE, Limit, Options, Result, measured

SPLATCTRL = str(Path(sys.executable).with_name("splatctrl"))


def run(options: Options) -> Result:
    """Time --help and a bare interpreter, `reconstruct` on the sample log, and with `with_demo` also `demo`."""
    starts = [(process([SPLATCTRL, "--help"]), process([sys.executable, "-c", "pass"])) for _ in range(10)]
    helping, bare = (statistics.median(start[i][0] for start in starts) for i in (0, 1))
    rows = [
        ["splatctrl --help (median of 10)", f"{helping:.3f}", f"{starts[0][0][1]:.0f}", "under 0.2 s"],
        ["python -c pass (median of 10)", f"{bare:.3f}", f"{starts[0][1][1]:.0f}", "-"],
    ]
    figures = {"help_s": helping, "python_s": bare}
    limits = [Limit(figure="help_s", bound=0.2)]
    with tempfile.TemporaryDirectory() as folder:
        if not options.is_quick:
            elapsed, peak = process(_reconstruct(Path(folder) / "scene"))
            rows.append(["splatctrl reconstruct, sample log", f"{elapsed:.1f}", f"{peak:.0f}", "under 1536 MiB"])
            figures |= {"reconstruct_s": elapsed, "reconstruct_peak_mib": peak}
            limits.append(Limit(figure="reconstruct_peak_mib", bound=1536.0))
        if options.with_demo:
            elapsed, peak = process([SPLATCTRL, "demo", "-q", "-o", str(Path(folder) / "demo")])
            rows.append(["splatctrl demo", f"{elapsed:.1f}", f"{peak:.0f}", "under 180 s"])
            figures |= {"demo_s": elapsed, "demo_peak_mib": peak}
            limits.append(Limit(figure="demo_s", bound=180.0))
    return Result(
        title="cli: whole processes",
        columns=("command", "seconds", "peak memory [MiB]", "has to be"),
        rows=rows,
        figures=figures,
        ratios={"help_against_bare_python": bare / helping},
        limits=limits,
    )


def _reconstruct(out: Path) -> list[str]:
    log = [str(SAMPLE / "log.mcap"), "--cameras", "cam0,cam1,cam2"]
    return [SPLATCTRL, "reconstruct", *log, *ROBOT, "-q", "-o", str(out)]


def process(command: Sequence[str]) -> tuple[float, float]:
    """Wall time [s] and peak resident memory [MiB] of a process that must exit with 0."""
    spent = measured(command)
    assert spent.code == 0
    return spent.seconds, spent.mebibytes
