"""The report on a campaign's table, as text or Markdown, and the worst rows with their pictures."""

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path

import numpy as np

from tools.mujoco.table import (
    AUDIT,
    CAUTION_MM,
    CONTACT,
    CRASH,
    DRIVEN,
    GREEN_MM,
    MARGIN_MM,
    OUTCOMES,
    RED_MM,
    REFUSED,
    SAFE,
    TRUTHS,
    Row,
)

ELSEWHERE_MM = 50.0  # the map has a surface that far from every true one
NUM_WORST = 5  # of each kind


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table of the report."""

    title: str
    head: tuple[str, ...]
    lines: Sequence[tuple[str, ...]]


def report(rows: Sequence[Row], *, markdown: bool = False) -> list[str]:
    """The report in lines."""
    tables = [
        _count_outcomes("family", rows, lambda row: row.family),
        _count_outcomes("robot", rows, lambda row: row.robot),
        _count_outcomes("depth", rows, lambda row: row.depth),
        _count_outcomes("mode", rows, lambda row: row.mode),
        _count_errors(rows),
        _measure_audits(rows),
        _count("useless caution, by reason", (_name_cause(row) for row in rows if row.is_useless_caution)),
        _count("closed loops that refuse to start", (row.criterion for row in rows if _is_refused_start(row))),
        _count("false reds, by cause", (_name_red(row) for row in rows if row.is_false_red)),
    ]
    named = [row for row in rows if row.is_false_green or row.outcome == CRASH]
    text = [line for table in tables for line in (*_render(table, markdown), "")]
    return [*text, *(f"{'- ' if markdown else ''}{describe(row)}" for row in named)]


def has_grave_error(rows: Iterable[Row]) -> bool:
    """True where something truly in contact was called safe."""
    return any(row.outcome == SAFE and row.truth == CONTACT for row in rows)


def describe(row: Row) -> str:
    """A row in one line."""
    where = f" at {row.worst_s:.2f} s: {row.worst_link} near {row.worst_splat}" if row.worst_link else ""
    truth = f", truth there {row.worst_true_mm:.0f} mm {row.true_link} {row.true_object}".rstrip() if where else ""
    return (
        f"{row.name} {row.mode} ({row.family}, {row.robot}, {row.depth}): {row.outcome.upper()}, "
        f"least {row.said_mm:.0f} mm, truly {row.true_mm:.0f} mm{where}{truth}; {row.reason}"
    )


def choose_worst(rows: Sequence[Row]) -> list[Row]:
    """The largest false reds, then the largest over-estimates."""
    red = sorted((row for row in rows if row.is_false_red), key=_measure_red, reverse=True)[:NUM_WORST]
    over = [row for row in rows if row not in red and row.over_mm > 0]
    return [*red, *sorted(over, key=lambda row: row.over_mm, reverse=True)[:NUM_WORST]]


def write_worst(out: Path, rows: Sequence[Row], batch: Path) -> None:
    """Write worst/worst.md, with the replays' pictures of the worst rows. batch: folder of their outputs."""
    folder = out / "worst"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    lines = ["# The worst replays", ""]
    for place, row in enumerate(choose_worst(rows), start=1):
        size = f"false red by {_measure_red(row):.0f} mm" if row.is_false_red else f"over by {row.over_mm:.0f} mm"
        lines += [f"{place}. {size}: {describe(row)}"]
        for picture in sorted((batch / row.name / row.mode).glob("worst_*.png")):
            copied = f"{place}_{row.name}_{row.mode}_{picture.name}"
            shutil.copyfile(picture, folder / copied)
            lines += [f"   ![{copied}]({copied})"]
    (folder / "worst.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _measure_red(row: Row) -> float:
    """True clearance minus the tool's least clearance [mm], at the same state; 0 if another criterion failed."""
    gap = row.worst_true_mm - row.said_mm
    return 0.0 if isnan(gap) else gap


def _is_refused_start(row: Row) -> bool:
    return row.mode == DRIVEN and row.outcome == REFUSED


def _name_cause(row: Row) -> str:
    return f"{row.mode}: {row.outcome}: {row.criterion}"


def _name_red(row: Row) -> str:
    """The criterion; for clearance, also the nearest splat, and if a true surface may be there.

    A point nearer to the arm than every true surface is at least the difference away from them.
    """
    if row.criterion != "clearance":
        return row.criterion
    place = f"more than {ELSEWHERE_MM:.0f} mm from" if _measure_red(row) > ELSEWHERE_MM else "perhaps at"
    return f"clearance: {row.worst_splat}, {place} a true surface"


def _count_outcomes(title: str, rows: Sequence[Row], key: Callable[[Row], str]) -> Table:
    """Numbers of rows with each outcome, by a key and the truth."""
    counts = Counter((key(row), row.truth, row.outcome) for row in rows)
    counts += Counter(("all", row.truth, row.outcome) for row in rows)
    lines = list[tuple[str, ...]]()
    for name in (*sorted({key(row) for row in rows}), "all"):
        for truth in TRUTHS:
            there = [counts[name, truth, outcome] for outcome in OUTCOMES]
            if any(there):
                lines.append((name, truth, str(sum(there)), *map(str, there)))
    return Table(title=f"outcomes by {title} and truth", head=(title, "truth", "runs", *OUTCOMES), lines=lines)


def _count_errors(rows: Sequence[Row]) -> Table:
    """Numbers of answers that the truth contradicts, out of the runs that could give them."""
    touching = [row for row in rows if row.true_mm < 0]
    near = [row for row in rows if 0 <= row.true_mm < GREEN_MM]
    clear = [row for row in rows if row.true_mm > RED_MM]
    red = [row for row in rows if row.is_red and row.true_mm < MARGIN_MM]
    apart = [row for row in rows if row.true_mm >= GREEN_MM]
    seen = [row for row in rows if row.true_mm >= CAUTION_MM and row.num_cams >= 3]
    driven = [row for row in rows if row.mode == DRIVEN]
    safe = [row for row in driven if row.outcome == SAFE]
    lines = [
        ("false green in contact (true < 0 mm)", touching, sum(row.is_false_green for row in touching)),
        (f"false green in the margin (true < {GREEN_MM:.0f} mm)", near, sum(row.is_false_green for row in near)),
        (f"false red (true > {RED_MM:.0f} mm)", clear, sum(row.is_false_red for row in clear)),
        (f"contact although {GREEN_MM:.0f} mm clear", apart, sum(row.outcome == CONTACT for row in apart)),
        (f"red for a false reason (true there > {RED_MM:.0f} mm)", red, sum(r.worst_true_mm > RED_MM for r in red)),
        (f"useless caution (true >= {CAUTION_MM:.0f} mm)", seen, sum(row.is_useless_caution for row in seen)),
        ("closed loop that refuses to start", driven, sum(map(_is_refused_start, driven))),
        ("closed loop called safe that truly touches", safe, sum(row.true_mm < 0 for row in safe)),
    ]
    return Table(
        title="answers against the truth",
        head=("error", "runs that could", "runs", "share"),
        lines=[(name, str(len(of)), str(n), f"{100 * n / len(of):.1f} %" if of else "-") for name, of, n in lines],
    )


def _measure_audits(rows: Sequence[Row]) -> Table:
    """The errors of audits by depth: each recording's median and largest error, and over-estimates by state."""
    audits = [row for row in rows if row.mode == AUDIT and not isnan(row.median_mm)]
    lines = list[tuple[str, ...]]()
    for depth in (*sorted({row.depth for row in audits}), "all") if audits else ():
        mine = [row for row in audits if depth in (row.depth, "all")]
        medians, highs = [row.median_mm for row in mine], [row.p95_mm for row in mine]
        num = sum(row.num_states for row in mine)
        over = sum(row.over_share * row.num_states for row in mine) / num
        said, true = (sum(getattr(row, name) for row in mine) for name in ("num_said_below", "num_true_below"))
        figures = [f"{value:.1f}" for value in (np.median(medians), max(medians), np.median(highs), max(highs))]
        lines.append((depth, str(len(mine)), str(num), *figures, f"{100 * over:.1f} %", str(said), str(true)))
    ends = ("over by 8 mm", "below margin", "truly below")
    heads = ("median error [mm]", "largest median", "95 % error", "largest 95 %")
    return Table(title="audits: error of a state", head=("depth", "audits", "states", *heads, *ends), lines=lines)


def _count(title: str, causes: Iterable[str]) -> Table:
    """Causes by weight."""
    counts = Counter(causes)
    lines = [(cause, str(n), f"{100 * n / counts.total():.0f} %") for cause, n in counts.most_common()]
    return Table(title=title, head=("cause", "runs", "share"), lines=lines)


def _render(table: Table, markdown: bool) -> list[str]:
    title = f"**{table.title[0].upper()}{table.title[1:]}**" if markdown else table.title
    if not table.lines:
        return [f"{title}: none"]
    if markdown:
        lines = [table.head, ("---",) * len(table.head), *table.lines]
        return [title, "", *(f"| {' | '.join(line)} |" for line in lines)]
    widths = [max(map(len, column)) for column in zip(table.head, *table.lines, strict=True)]
    lines = [table.head, *table.lines]
    return [title, *("  " + "  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)]
