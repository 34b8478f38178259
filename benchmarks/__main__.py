"""`python -m benchmarks [NAME ...]`: run benchmarks, print a table each, write JSON, compare with the baseline."""

import argparse
import importlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.measure import ROOT, Options, OtherLoad, Result, machine
from splatctrl_cli.cli.common import table

NAMES = (
    "iteration",
    "growth",
    "streaming",
    "occupancy",
    "eviction_cost",
    "field",
    "control",
    "cli",
    "ingest",
    "long_log",
    "planner",
)
NAMED = (  # which run only when they are named
    *("certificate", "conformal", "density", "field_accuracy"),
    *("marching", "probability", "solvers", "stability"),
)
BASELINE = ROOT / "benchmarks" / "baseline.json"
NOISE = 1.3  # a ratio that fell by less than this factor says nothing on a shared machine


def main(argv: Sequence[str] | None = None) -> int:
    """Run and report; with --gate, return 1 if a limit or the baseline is missed."""
    parser = _parser()
    args = parser.parse_args(argv)
    unknown = [name for name in args.names if name not in NAMES + NAMED]
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are: {', '.join(NAMES + NAMED)}")
    options = Options(is_quick=args.quick, with_demo=args.demo, plots=args.plots)
    results: dict[str, Result] = {}
    start, load = time.perf_counter(), OtherLoad()
    for name in args.names or NAMES:
        results[name] = importlib.import_module(f"benchmarks.{name}").run(options)
        _print(results[name])
    missed = _missed_limits(results)
    slower = _compare(results, args.baseline)
    report: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "quick": options.is_quick,
        "seconds": round(time.perf_counter() - start, 1),
        "cores_busy_with_others": round(load.cores(), 2),
        "benchmarks": {name: _rounded(asdict(result)) for name, result in results.items()},
    }
    args.json.parent.mkdir(parents=True, exist_ok=True)
    args.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(f"other processes kept {report['cores_busy_with_others']} of {report['machine']['cores']} cores busy")
    print(f"wrote {args.json} after {report['seconds']:.0f} s")
    return int(args.gate and bool(missed or slower))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__, allow_abbrev=False)
    known = f"of: {', '.join(NAMES)}, which run by default; {', '.join(NAMED)}"
    parser.add_argument("names", nargs="*", metavar="NAME", help=known)
    default = Path("bench_output/bench.json")
    parser.add_argument("--json", type=Path, default=default, metavar="FILE", help=f"default: {default}")
    parser.add_argument("--baseline", type=Path, default=BASELINE, metavar="FILE", help="an earlier run's JSON")
    parser.add_argument("--quick", action="store_true", help="fewer repeats, small sizes only, no reconstruction")
    parser.add_argument("--demo", action="store_true", help="time `splatctrl demo` as well")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="write the plots of docs/images here")
    parser.add_argument("--gate", action="store_true", help="exit 1 where a limit is missed or a ratio fell")
    return parser


def _print(result: Result) -> None:
    lines = table(list(result.columns), [list(row) for row in result.rows])
    print("\n".join([f"== {result.title}", *lines, *(f"note: {note}" for note in result.notes), "", *result.more]))


def _missed_limits(results: Mapping[str, Result]) -> list[str]:
    """Print every limit and the figure compared with it; return the missed limits."""
    rows, missed = [], []
    for name, result in results.items():
        for limit in result.limits:
            value, is_kept = result.figures[limit.figure], limit.holds(result.figures[limit.figure])
            bound = f"{'>=' if limit.is_least else '<='} {limit.bound:g}"
            rows.append([f"{name}.{limit.figure}", f"{value:.4g}", bound, "yes" if is_kept else "NO"])
            if not is_kept:
                missed.append(f"{name}.{limit.figure}")
    if rows:
        print("\n".join(["== limits", *table(["figure", "measured", "limit", "kept"], rows), ""]))
    return missed


def _compare(results: Mapping[str, Result], path: Path) -> list[str]:
    """Print this run's ratios next to the baseline's; return ratios that fell by more than noise."""
    if not path.is_file():
        print(f"no baseline at {path}\n")
        return []
    earlier = json.loads(path.read_text(encoding="utf-8"))["benchmarks"]
    rows, fell = [], []
    for name, result in results.items():
        for key, now in result.ratios.items():
            before = earlier.get(name, {}).get("ratios", {}).get(key)
            if before is None:
                continue
            is_slower = now * NOISE < before
            rows.append([f"{name}.{key}", f"{now:.2f}", f"{before:.2f}", "SLOWER" if is_slower else ""])
            if is_slower:
                fell.append(f"{name}.{key}")
    title = f"== ratios within one run (larger is better), against {path.name}"
    print("\n".join([title, *table(["ratio", "now", "baseline", ""], rows), ""]))
    return fell


def _rounded(value: Any) -> Any:
    """Floats to four digits: what lies beyond is noise."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, Mapping):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(part) for part in value]
    return value


if __name__ == "__main__":
    raise SystemExit(main())
