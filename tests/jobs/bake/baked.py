"""A bake of coarse cells, without pictures."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatctrl_cli.config import Config, FieldConfig
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.jobs.bake.bake import bake
from splatctrl_cli.jobs.bake.request import BakeRequest
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.records import Box


class Said:
    """Keeps the lines."""

    is_quiet = True

    def __init__(self) -> None:
        self.lines: list[str] = []

    def log(self, line: str) -> None:
        self.lines.append(line)


def baked(
    scene: Path,
    out: Path,
    *,
    voxel: float,
    field: dict[str, Any] | None = None,
    box: tuple[float, ...] | None = None,
    progress: Progress = SILENT,
    **options: Any,
) -> JudgedResult:
    """`field`: more settings of it; `options`: what else of the request."""
    config = replace(Config(), field=FieldConfig(voxel=voxel, max_loss=1.0, **(field or {})))
    covered = None if box is None else Box.from_text(",".join(map(str, box)))
    options = {"no_report": True, "formats": ("npz",)} | options
    return bake(BakeRequest(scene=scene, out=out, config=config, box=covered, **options), progress)


def field_json(folder: Path) -> dict[str, Any]:
    """What the field says of itself."""
    content: dict[str, Any] = json.loads((folder / "field.json").read_text())
    return content
