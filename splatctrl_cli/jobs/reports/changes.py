"""What changed since an earlier run or batch, or a stored baseline, as tables of a report."""

from collections.abc import Sequence
from pathlib import Path

from splatctrl_cli.jobs.compare import Change, CompareRequest, FigureChange, compare
from splatctrl_cli.report.page import Cell, Row, Table

HEADER = ("job", "what", "before", "now", "", "allowed", "unit", "where")
STATES = {Change.WORSE: "failed"}  # of a row


def changes_since(before: Path | None, after: Path, *, has_links: bool) -> tuple[list[Table], frozenset[str]]:
    """Tables of what changed, the second folded, and the jobs that got worse or have another verdict.

    before: a folder, else a baseline; None for no tables. has_links: each job has a section. Raises InputError for
    what cannot be compared.
    """
    if before is None:
        return [], frozenset()
    is_folder = before.is_dir()
    found = compare(
        CompareRequest(runs=(before, after) if is_folder else (after,), against=None if is_folder else before)
    )

    def job(name: str) -> Cell:
        return Cell(text=name, link=name if has_links else "")

    def rows(figures: Sequence[FigureChange]) -> list[Row]:
        return [
            Row(
                cells=(
                    job(one.run),
                    one.metric,
                    one.before,
                    one.after,
                    one.change,
                    one.allowed,
                    one.unit,
                    None if one.where is None else f"{one.where.time_s:.2f} s, {one.where}",
                ),
                state=STATES.get(one.change, ""),
            )
            for one in figures
        ]

    worse = [one for one in found.figures if one.change is Change.WORSE]
    better = rows([one for one in found.figures if one.change is Change.BETTER])
    first = [
        Row(
            cells=(job(one.run), "verdict", one.before, one.after, one.change, None, None, None),
            state=STATES.get(one.change, ""),
        )
        for one in found.verdicts
    ]
    unlike = [Row(cells=("", name, *values, "not alike", "", "", "")) for name, values in found.differences.items()]
    text = ". ".join([found.verdict.sentence, *map(str, found.verdict.said)])
    tables = [Table(title="What changed", header=HEADER, rows=[*first, *rows(worse), *unlike], text=text)]
    if better:
        tables.append(
            Table(title=f"Figures that got better ({len(better)})", header=HEADER, rows=better, is_folded=True)
        )
    return tables, frozenset([one.run for one in found.verdicts] + [one.run for one in worse])
