"""One HTML file that opens from disk: verdict, timelines, pictures, tables, and scenes in 3-D."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from splatctrl_cli.errors import InputError
from splatctrl_cli.report.space import for_script, three_js

PARTS = Path(__file__).parent / "page_parts"
QUALITY = 70  # of JPEG: WebP is a third smaller, and takes ten times as long


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A word in the colour of a state; link: the anchor of a section that it leads to."""

    text: str
    state: str = ""
    link: str = ""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Values or `Cell`s of a table, marked where the state is a bad one."""

    cells: Sequence[object]
    state: str = ""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows under a header, or a text, under a title; is_folded: shown when the title is clicked."""

    title: str = ""
    header: Sequence[str] = ()
    rows: Sequence[Row] = ()
    text: str = ""
    is_folded: bool = False


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image as a data URL, its size in pixels, and what it shows."""

    title: str
    data: str
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class RunSection:
    """What a page says of one run. space: the name of its scene, "" for none; no_space: why there is none."""

    anchor: str
    title: str
    state: str
    sentence: str
    reasons: Table = field(default_factory=Table)
    lines: Sequence[str] = ()
    timeline: Markup | None = None
    legend: Sequence[tuple[str, str, str]] = ()
    pictures: Sequence[Picture] = ()
    details: Sequence[Table] = ()
    space: str = ""
    no_space: str = ""


@dataclass(frozen=True, kw_only=True)
class Page:
    """A report. pictures: of runs without a section; scenes: what `viewer.packed` made, by name; opens: the first of
    them at once.
    """

    title: str
    state: str
    sentence: str
    lines: Sequence[str] = ()
    tables: Sequence[Table] = ()
    runs: Sequence[RunSection] = ()
    pictures: Sequence[Picture] = ()
    scenes: Mapping[str, str] = field(default_factory=dict)
    opens: bool = False


def rendered(page: Page) -> str:
    """The page as HTML; every text in it is escaped."""
    environment = Environment(loader=FileSystemLoader(PARTS), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "classed": lambda state: str(state).replace(" ", "-"),
        "scripted": lambda text: Markup(for_script(text)),
        "shown": _shown,
    }
    environment.tests["a_cell"] = lambda value: isinstance(value, Cell)
    parts = {
        name: Markup((PARTS / file).read_text(encoding="utf-8"))
        for name, file in {"css": "page.css", "script": "page.js", "viewer": "viewer.js"}.items()
    }
    three = Markup(json.dumps(three_js())) if page.scenes else ""
    return environment.get_template("page.html").render(page=page, three=three, **parts)


def picture(path: Path, title: str, most: int) -> Picture:
    """An image file, no wider than `most` pixels, as JPEG. Raises InputError for one that does not decode."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: is no image that can be decoded", remedy="make the run again")
    height, width = image.shape[:2]
    if width > most:
        height, width = round(height * most / width), most
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
    text = base64.b64encode(data).decode("ascii")
    return Picture(title=title, data=f"data:image/jpeg;base64,{text}", width=width, height=height)


def _shown(cell: object) -> str:
    if cell is None or cell == "":
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
