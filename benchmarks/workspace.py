"""A table shared with a person: the controller beside a monitored standstill, as in the last figure of IV.

`python -m benchmarks.workspace --trials 16` writes a row per trial and method, and the figure; `--rows CSV` draws
earlier rows again.
"""

import argparse
import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from benchmarks.workspace_trial import HUMAN_MARGIN, SETTINGS, STOP_DISTANCE, Row, trial
from splatctrl_cli.cli.common import table
from splatctrl_cli.config import load_config
from splatctrl_cli.simulate.shared_workspace import PLACES

METHODS = {
    "standstill": "standstill, workspace",
    "standstill-distance": f"standstill, {100 * STOP_DISTANCE.stop:.0f} cm",
    "controller": "controller",
    "controller-wide": f"controller, {100 * HUMAN_MARGIN:.0f} cm from people",
}
COLORS = {"near-pickup": "#1f6fb4", "near-goal": "#d1662a"}
CM = 100.0
READ: dict[Any, Callable[[str], Any]] = {bool: lambda text: text == "True", str: str, int: int, float: float}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the trials, or read their rows, and say and draw what came of them."""
    args = _parser().parse_args(argv)
    rows = _run(args.trials, args.csv) if args.rows is None else read_rows(args.rows)
    print("\n".join(report(rows)))
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({"rows": [asdict(row) for row in rows]}, indent=1) + "\n", encoding="utf-8")
    draw(rows, args.picture)
    print(f"wrote {args.picture}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.workspace", description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "--trials", type=int, default=16, metavar="N", help="half of them at each place (default: 16)"
    )
    out = Path("bench_output")
    parser.add_argument("--csv", type=Path, default=out / "workspace.csv", metavar="FILE", help="rows, as they come")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the rows as JSON as well")
    parser.add_argument("--picture", type=Path, default=out / "workspace.png", metavar="FILE", help="the figure")
    parser.add_argument("--rows", type=Path, metavar="FILE", help="an earlier --csv, instead of running")
    return parser


def _run(num_trials: int, path: Path) -> list[Row]:
    config, rows = load_config(None, SETTINGS), []
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, [field.name for field in fields(Row)])
        writer.writeheader()
        for number in range(num_trials):
            place, seed = PLACES[number % len(PLACES)], number // len(PLACES)
            for row in trial(place, seed, config):
                rows.append(row)
                writer.writerow({key: _rounded(value) for key, value in asdict(row).items()})
            stream.flush()
            print(f"{place}, seed {seed}: done")
    return rows


def read_rows(path: Path) -> list[Row]:
    """The rows of a CSV that an earlier run wrote."""
    with path.open(encoding="utf-8", newline="") as stream:
        return [
            Row(**{field.name: READ[field.type](row[field.name]) for field in fields(Row)})
            for row in csv.DictReader(stream)
        ]


def report(rows: Sequence[Row]) -> list[str]:
    """The tables: each method over all trials and by place, and the paired differences from the standstill."""
    lines: list[str] = []
    for place in ("", *PLACES):
        chosen = [row for row in rows if row.place.startswith(place)]
        num = len({(row.place, row.seed) for row in chosen})
        lines += [
            f"== {place or 'all places'}, {num} trials",
            *table(COLUMNS, [_line(chosen, m) for m in METHODS]),
            "",
        ]
    lines += ["== paired differences from the standstill of the workspace", *table(DIFFERENCES, _paired(rows)), ""]
    alone = [row.duration for row in rows if row.method == "alone"]
    return [*lines, f"the same task with nobody there takes {mean(alone):.2f} s"]


COLUMNS = (
    *("method", "done", "time [s]", "median", "mean distance to the person [cm]", "median"),
    *("least [cm]", "least to anything [cm]", "stands [s]", "interventions", "relaxed [%]"),
)
DIFFERENCES = ("method", "what", "mean", "median", "trials above 0", "p (Wilcoxon)")


def _line(rows: Sequence[Row], method: str) -> list[str]:
    mine = [row for row in rows if row.method == method]
    time, distance = [row.duration for row in mine], [CM * row.mean_human for row in mine]
    return [
        METHODS[method],
        f"{sum(row.completed for row in mine)}/{len(mine)}",
        _spread(time),
        f"{median(time):.1f}",
        _spread(distance),
        f"{median(distance):.1f}",
        f"{CM * min(row.least_human for row in mine):.1f}",
        f"{CM * min(row.least_any for row in mine):.1f}",
        f"{mean(row.stopped for row in mine):.1f}",
        f"{mean(row.interventions for row in mine):.1f}",
        f"{CM * mean(row.relaxed for row in mine):.1f}",
    ]


def _paired(rows: Sequence[Row]) -> list[list[str]]:
    lines = []
    base = {(row.place, row.seed): row for row in rows if row.method == "standstill"}
    for method in list(METHODS)[1:]:
        mine = [row for row in rows if row.method == method]
        pairs = [(row, base[row.place, row.seed]) for row in mine]
        for what, values in (
            ("time [s]", [a.duration - b.duration for a, b in pairs]),
            ("mean distance [cm]", [CM * (a.mean_human - b.mean_human) for a, b in pairs]),
        ):
            p = float(wilcoxon(values).pvalue) if len(values) > 4 and np.any(values) else float("nan")
            above = f"{sum(value > 0 for value in values)}/{len(values)}"
            lines.append([METHODS[method], what, f"{mean(values):+.1f}", f"{median(values):+.1f}", above, f"{p:.2g}"])
    return lines


def _spread(values: Sequence[float]) -> str:
    return f"{mean(values):.1f} +- {stdev(values) if len(values) > 1 else 0.0:.1f}"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Two panels, completion time and mean distance to the person: a box per method, a line per trial."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained")
    alone = mean(row.duration for row in rows if row.method == "alone")
    axes[0].axhline(alone, color="0.6", linestyle=":", linewidth=1)
    axes[0].annotate("nobody there", (0.5, alone), (0, 3), textcoords="offset points", color="0.4", fontsize=8)
    panels = (("completion time [s]", "duration", 1.0), ("mean distance to the person [cm]", "mean_human", CM))
    trials = sorted({(row.place, row.seed) for row in rows})
    for axis, (title, name, factor) in zip(axes, panels, strict=True):
        of = {(row.place, row.seed, row.method): factor * getattr(row, name) for row in rows}
        columns = [[of[place, seed, method] for place, seed in trials] for method in METHODS]
        axis.boxplot(
            columns, widths=0.5, showfliers=False, medianprops={"color": "black"}, boxprops={"color": "0.5"},
            whiskerprops={"color": "0.5"}, capprops={"color": "0.5"},
        )  # fmt: skip
        for index, (place, _) in enumerate(trials):
            values = [column[index] for column in columns]
            axis.plot(
                range(1, len(columns) + 1), values, "o-", color=COLORS[place], alpha=0.55, linewidth=0.7, ms=3.5
            )
        axis.set_xticks(range(1, len(columns) + 1), [name.replace(", ", ",\n") for name in METHODS.values()])
        axis.tick_params(axis="x", labelsize=8)
        axis.set_ylabel(title)
        axis.set_ylim(bottom=0)
    for place, color in COLORS.items():
        axes[1].plot([], [], "o-", color=color, label=f"person works {place.replace('-', ' ')}")
    axes[1].legend(fontsize=8, loc="lower left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _rounded(value: object) -> object:
    return round(value, 4) if isinstance(value, float) else value


if __name__ == "__main__":
    raise SystemExit(main())
