"""The hunt's table of runs, and what it says of the tool."""

import csv
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path

from scipy.stats import beta

from splatctrl_cli.files.output import write_durably
from splatctrl_cli.jobs.replay.evidence_criteria import LIMITS
from tools.hunt.observability import MARGIN, TOLERATED
from tools.hunt.outcome import WORDS
from tools.hunt.trial import Row

COLUMNS = tuple(field.name for field in fields(Row))
OUTCOMES = (*WORDS, "crash")
TRUTHS = ("clear", "margin", "contact")
NUM_NEAREST = 10
NUM_BORDER = 24
ALPHA = 0.05


def read_rows(path: Path) -> list[Row]:
    """The runs of a table, in its order; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as stream:
        return [_row(entry) for entry in csv.DictReader(stream)]


def merge_rows(path: Path, rows: Iterable[Row]) -> None:
    """Put runs into a table; they replace earlier rows of the same runs."""
    merged = {(row.seed, row.index): row for row in (*read_rows(path), *rows)}

    def write(place: Path) -> None:
        with place.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(_words(merged[key]) for key in sorted(merged))

    write_durably(path, write)


def truth_of(row: Row) -> str:
    """`contact`, `margin` (inside it) or `clear`."""
    return "contact" if row.clearance < 0 else "margin" if row.clearance < MARGIN else "clear"


def upper_limit(failures: int, runs: int) -> float:
    """The 95 % Clopper-Pearson upper limit of a rate, one-sided."""
    return 1.0 if runs in (0, failures) else float(beta.ppf(1 - ALPHA, failures + 1, runs - failures))


def report(rows: Sequence[Row]) -> list[str]:
    """The whole table in lines of text."""
    families = list(dict.fromkeys(row.family for row in rows))
    lines = [f"{'family':10s} {'runs':>5s} {'truth':>8s} " + " ".join(f"{word:>13s}" for word in OUTCOMES)]
    for family in (*families, "all"):
        mine = [row for row in rows if family in (row.family, "all")]
        for truth in TRUTHS:
            there = Counter(row.outcome for row in mine if truth_of(row) == truth)
            head = f"{family:10s} {len(mine):5d}" if truth == TRUTHS[0] else " " * 16
            lines.append(f"{head} {truth:>8s} " + " ".join(f"{there[word]:13d}" for word in OUTCOMES))
    parts = (_greens(rows), _nearest(rows), _benign(rows), _why(rows), _limits(rows), _bodies(rows))
    return [*lines, *(line for part in parts for line in ("", *part))]


def border_of(rows: Sequence[Row]) -> list[Row]:
    """The runs nearest to the border: half are safe with the least true clearance, half break the margin by least."""
    mine = [row for row in rows if row.observable and row.outcome != "crash" and not row.is_false_green]
    safe = sorted((row for row in mine if row.outcome == "safe"), key=lambda row: row.clearance)
    limit = MARGIN - TOLERATED
    broken = sorted((row for row in mine if row.clearance < limit), key=lambda row: -row.clearance)
    half = NUM_BORDER // 2
    return sorted([*safe[:half], *broken[:half]], key=lambda row: (row.seed, row.index))


def _greens(rows: Sequence[Row]) -> list[str]:
    broken = sum(truth_of(row) != "clear" for row in rows)
    lines = [f"{len(rows)} runs; the margin is truly broken in {broken} ({_share(broken, len(rows))})"]
    for name, holds in (("observable", True), ("not observable", False)):
        mine = [row for row in rows if row.observable == holds]
        for kind in ("contact", "margin"):
            false = [row for row in mine if row.is_false_green and truth_of(row) == kind]
            limit = 100 * upper_limit(len(false), len(mine))
            lines.append(
                f"false green, {kind}, {name}: {len(false)} of {len(mine)} runs "
                f"({_share(len(false), len(mine))}, 95 % upper limit {limit:.2f} %)"
            )
            lines += [f"  {_told(row)}" for row in sorted(false, key=lambda row: row.clearance)]
    crashed = [row for row in rows if row.outcome == "crash"]
    return lines + [f"crash: {_told(row)}" for row in crashed]


def _nearest(rows: Sequence[Row]) -> list[str]:
    safe = sorted((row for row in rows if row.outcome == "safe"), key=lambda row: row.clearance)
    safe = [row for row in safe if not row.is_false_green]
    return ["nearest misses (safe, least true clearance):", *(f"  {_told(row)}" for row in safe[:NUM_NEAREST])]


def _benign(rows: Sequence[Row]) -> list[str]:
    far = [row for row in rows if row.family == "benign" and row.clearance > 2 * MARGIN]
    green = sum(row.outcome == "safe" for row in far)
    lines = [f"benign, truly above twice the margin: {green} of {len(far)} safe ({_share(green, len(far))})"]
    reasons = Counter(f"{row.mode}: {row.outcome}: {_criterion(row)}" for row in far if row.outcome != "safe")
    return lines + [f"  {count:4d} {reason}" for reason, count in reasons.most_common()]


def _why(rows: Sequence[Row]) -> list[str]:
    """Criteria by which truly clear runs of all families are not safe."""
    reasons = Counter(_criterion(row) for row in rows if truth_of(row) == "clear" and row.outcome != "safe")
    return [
        "truly clear and not safe, by criterion:",
        *(f"  {n:4d} {reason}" for reason, n in reasons.most_common(20)),
    ]


def _limits(rows: Sequence[Row]) -> list[str]:
    """Numbers of runs by truth that only one limit of evidence keeps from being safe, by limit."""
    lines = [f"{'safe without':20s} " + " ".join(f"{truth:>8s}" for truth in TRUTHS)]
    for limit in LIMITS:
        there = Counter(truth_of(row) for row in rows if row.only == limit.name)
        lines.append(f"{limit.name:20s} " + " ".join(f"{there[truth]:8d}" for truth in TRUTHS))
    return lines


def _bodies(rows: Sequence[Row]) -> list[str]:
    """Outcomes of clear runs and of the others, by the visible arm."""
    lines = [f"{'robot':16s} {'truth':>8s} {'runs':>5s} " + " ".join(f"{word:>13s}" for word in OUTCOMES)]
    for robot in sorted({row.robot for row in rows}):
        for truth in TRUTHS:
            mine = [row for row in rows if row.robot == robot and truth_of(row) == truth]
            there = Counter(row.outcome for row in mine)
            counts = " ".join(f"{there[word]:13d}" for word in OUTCOMES)
            lines.append(f"{robot or 'plain':16s} {truth:>8s} {len(mine):5d} {counts}")
    return lines


def _criterion(row: Row) -> str:
    """What stands before the reason's colon."""
    return row.reason.partition(":")[0] or "none"


def _told(row: Row) -> str:
    return (
        f"{row.name} {row.family} ({row.kind}, {row.strength:.3g}) {row.mode}: {row.outcome}, "
        f"true {1e3 * row.clearance:.1f} mm; {row.rule}"
    )


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "none"


def _words(row: Row) -> list[str]:
    values = (getattr(row, name) for name in COLUMNS)
    return [f"{value:.5g}" if isinstance(value, float) else str(value) for value in values]


def _row(entry: dict[str, str]) -> Row:
    return Row(
        seed=int(entry["seed"]),
        index=int(entry["index"]),
        family=entry["family"],
        kind=entry["kind"],
        strength=float(entry["strength"]),
        mode=entry["mode"],
        outcome=entry["outcome"],
        clearance=float(entry["clearance"]),
        observable=entry["observable"] == "True",
        rule=entry["rule"],
        reason=entry["reason"],
        robot=entry.get("robot") or "",  # not in tables of before
        spread=float(entry.get("spread") or 0.0),
        fattening=float(entry.get("fattening") or 0.0),
        only=entry.get("only") or "",
    )
