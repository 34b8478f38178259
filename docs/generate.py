"""Writes the tables of the pages from the registries of formats, layouts, checks and criteria, for `make docs`."""

import re
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.checks.finding import CHECKS, Check
from splatctrl_cli.evaluate.metrics import Better, Scale
from splatctrl_cli.evaluate.verdict import Criterion
from splatctrl_cli.formats.grid.grid_format import GridFormat
from splatctrl_cli.formats.grid.grid_formats import FORMATS as GRID_FORMATS
from splatctrl_cli.formats.splat.splat_format import SplatFormat
from splatctrl_cli.formats.splat.splats import FORMATS as SPLAT_FORMATS
from splatctrl_cli.jobs.compare.judged_runs import scales
from splatctrl_cli.jobs.replay.criteria import Judged
from splatctrl_cli.jobs.replay.evidence_criteria import LIMITS, PROOF, Limit
from splatctrl_cli.jobs.replay.verdict import CRITERIA
from splatctrl_cli.recording.folder.image_folder import LAYOUTS
from splatctrl_cli.recording.folder.layout import Layout
from splatctrl_cli.voxels import EvidenceClass

DOCS = Path(__file__).parent
TABLE = re.compile(r"(<!-- Rows of (\w+); `make docs` writes them again. -->\n\n)((?:[|-].*\n)*)")
WORDS = {  # of a name in the documentation, for those that it stands for
    "FIELD": ("exact", "barrier", "certified"),
    "REGION": ("seen", "all", "masked"),
    "CLASS": tuple(kind.name.lower() for kind in EvidenceClass),
}


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Figures of a command that are compared alike, as the documentation's table has them."""

    command: str
    names: tuple[str, ...]
    scale: Scale

    @property
    def docs(self) -> str:
        """The row of the table, its cells separated by |."""
        scale, shown = self.scale, ", ".join(f"`{name}`" for name in self.names)
        parts = [f"{scale.absolute:g} {scale.unit}".rstrip()] if scale.absolute else []
        parts += [f"{100 * scale.relative:g} %"] if scale.relative else []
        return f"{self.command} | {shown} | {scale.unit or '-'} | {scale.better} | {' + '.join(parts) or '0'}"


def documented() -> Iterator[Compared]:
    """The rows of the documentation's table: figures that have a direction, alike ones together."""
    for command, of_name in scales().items():
        alike: dict[Scale, list[str]] = {}
        for name, scale in of_name.items():
            if scale.better is not Better.NEITHER:
                alike.setdefault(scale, []).append(_general(name, of_name))
        for scale, names in alike.items():
            yield Compared(command=command, names=tuple(dict.fromkeys(names)), scale=scale)


def _general(name: str, names: Container[str]) -> str:
    """A name with a word for what is one of several among `names`: ``seen.FIELD.BAND.rmse``, ``psnr_REGION``."""
    name = name.removesuffix("_corrected")
    if name.startswith(("everywhere.", "seen.")):
        where, *_, figure = name.split(".")
        return f"{where}.FIELD.BAND.{figure}"
    for word, choices in WORDS.items():
        for choice in choices:
            head, tail = name.removeprefix(f"{choice}_"), name.removesuffix(f"_{choice}")
            if head != name and sum(f"{other}_{head}" in names for other in choices) > 1:
                return f"{word}_{head}"
            if tail != name and sum(f"{tail}_{other}" in names for other in choices) > 1:
                return f"{tail}_{word}"
    return name


Entry = SplatFormat | GridFormat | Layout | Check | Criterion[Judged] | Limit | Compared
Registry = tuple[tuple[str, ...], Iterable[Entry]]
TABLES: dict[str, Registry] = {
    "criteria": (("criterion", "holds where", "broken:"), CRITERIA),
    "limits": (("evidence", "allowed", "why"), (*LIMITS, PROOF)),
    "metrics": (("command", "figures", "unit", "better", "tolerance"), [*documented()]),
}
LISTS: dict[str, Registry] = {  # with the words before what follows an entry's first sentence
    "splat_formats": (("rounding", "without"), SPLAT_FORMATS.values()),
    "grid_formats": (("for",), GRID_FORMATS.values()),
    "datasets": (("poses", "depth", "intrinsics"), LAYOUTS),
    "checks": ((), CHECKS.values()),
}


def main() -> None:
    """Write the pages with their tables."""
    for name, text in pages().items():
        (DOCS / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of each page with a table, by file name."""
    texts = {page.name: page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md"))}
    return {name: TABLE.sub(_filled, text) for name, text in texts.items() if TABLE.search(text)}


def _filled(found: re.Match[str]) -> str:
    """A mark in a page, and the table, or list, of the registry that it names."""
    titles, entries = (TABLES | LISTS)[found[2]]
    texts = [text for entry in entries for text in entry.docs.split("\n\n") if text]
    rows = [tuple(cell.strip() for cell in " ".join(text.split()).split("|")) for text in texts]
    lines = _table(titles, rows) if found[2] in TABLES else [_line(titles, *row) for row in rows]
    return found[1] + "\n".join(lines) + "\n"


def _line(titles: tuple[str, ...], name: str, meaning: str, *cells: str) -> str:
    """An entry of a list."""
    return "; ".join(
        [f"- {name}: {meaning}", *(f"{title} {cell}" for title, cell in zip(titles, cells, strict=False))]
    )


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in [header, *rows]]
    lines = [f"| {' | '.join(row)} |" for row in escaped]
    lines.insert(1, f"|{'---|' * len(header)}")
    return lines


if __name__ == "__main__":
    main()
