"""Writes the lists of the pages from the registries of formats, layouts, checks and criteria, for `make docs`."""

import re
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.checks.finding import CHECKS, Check
from splatctrl_cli.evaluate.metrics import Better, Scale
from splatctrl_cli.evaluate.verdict import Criterion
from splatctrl_cli.formats.grid.grid_format import GridFormat
from splatctrl_cli.formats.grid.grid_formats import FORMATS as GRID_FORMATS
from splatctrl_cli.formats.splat.gaussian_ply import SplatFormat
from splatctrl_cli.formats.splat.splats import FORMATS as SPLAT_FORMATS
from splatctrl_cli.jobs.compare.judged_runs import scales
from splatctrl_cli.jobs.replay.criteria import Bound, Judged
from splatctrl_cli.jobs.replay.evidence_criteria import BY_FEW, LIMITS, PROOF
from splatctrl_cli.jobs.replay.replay import CRITERIA
from splatctrl_cli.recording.folder.image_folder import LAYOUTS
from splatctrl_cli.recording.folder.layout import Layout
from splatctrl_cli.voxels import EvidenceClass

DOCS = Path(__file__).parent
ROWS = re.compile(r"(<!-- Rows of (\w+); `make docs` writes them again. -->\n\n)((?:[|-].*\n)*)")
WORDS = {  # of a name in the documentation, for those that it stands for
    "FIELD": ("exact", "barrier", "certified"),
    "REGION": ("seen", "all", "masked"),
    "CLASS": tuple(kind.name.lower() for kind in EvidenceClass),
}


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Figures of a command with one better direction, as the documentation lists them."""

    command: str
    better: Better
    names: Mapping[Scale, Iterable[str]]

    @property
    def docs(self) -> str:
        """The entry of the list, its cells separated by |."""
        alike = (", ".join(f"`{name}`" for name in names) + f": {_tolerance(s)}" for s, names in self.names.items())
        return f"{self.command}, {self.better} | {'; '.join(alike)}"


def _tolerance(scale: Scale) -> str:
    parts = [f"{scale.absolute:g} {scale.unit}".rstrip()] if scale.absolute else []
    parts += [f"{100 * scale.relative:g} %"] if scale.relative else []
    return " + ".join(parts) or "0"


def documented() -> Iterator[Compared]:
    """The entries of the documentation's list: by command and direction, names of one tolerance together."""
    for command, of_name in scales().items():
        for better in (Better.LOWER, Better.HIGHER):
            alike: dict[Scale, dict[str, None]] = {}  # names in order, each once
            for name, scale in of_name.items():
                if scale.better is better:
                    alike.setdefault(scale, {})[_general(name, of_name)] = None
            if alike:
                yield Compared(command=command, better=better, names=alike)


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


Entry = SplatFormat | GridFormat | Layout | Check | Criterion[Judged] | Bound | Compared
Registry = tuple[tuple[str, ...], Iterable[Entry]]
LISTS: dict[str, Registry] = {  # with the words before what follows an entry's first sentence
    "criteria": (("**else**",), CRITERIA),
    "limits": (("since",), (LIMITS[0], *BY_FEW.values(), *LIMITS[1:], PROOF)),
    "metrics": (("",), [*documented()]),
    "splat_formats": (("rounding", "without"), SPLAT_FORMATS.values()),
    "grid_formats": (("for",), GRID_FORMATS.values()),
    "datasets": (("poses", "depth", "intrinsics"), LAYOUTS),
    "checks": ((), CHECKS.values()),
}


def main() -> None:
    """Write the pages with their lists."""
    for name, text in pages().items():
        (DOCS / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of each page with such a list, by file name."""
    texts = {page.name: page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md"))}
    return {name: ROWS.sub(_filled, text) for name, text in texts.items() if ROWS.search(text)}


def _filled(found: re.Match[str]) -> str:
    """A mark in a page, and the list of the registry that it names."""
    titles, entries = LISTS[found[2]]
    texts = [text for entry in entries for text in entry.docs.split("\n\n") if text]
    rows = [tuple(cell.strip() for cell in " ".join(text.split()).split("|")) for text in texts]
    return found[1] + "\n".join(_line(titles, *row) for row in rows) + "\n"


def _line(titles: tuple[str, ...], name: str, meaning: str, *cells: str) -> str:
    """An entry of a list."""
    return "; ".join(
        [f"- {name}: {meaning}", *(f"{title} {cell}".strip() for title, cell in zip(titles, cells, strict=False))]
    )


if __name__ == "__main__":
    main()
