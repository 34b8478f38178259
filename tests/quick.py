"""Fixtures that leave out what takes long where no test looks at it; a machine with a card lacks what they import."""

from collections.abc import Iterator
from copy import deepcopy
from functools import cache
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from splatctrl_cli.files import output
from splatctrl_cli.jobs.replay import files
from splatctrl_cli.robot import sphere_files

DRAW, LAY_OUT, PAINT = files.draw_replay, ConstrainedLayoutEngine.execute, Figure.savefig


@pytest.fixture(scope="session", autouse=True)
def unpainted() -> Iterator[None]:
    """Leave out what takes longer than a replay: its pictures, and layout and paint of all other figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "draw_replay", lambda *_: None)
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        patch.setattr(Figure, "savefig", lambda _, path, **__: Path(path).touch())
        yield


@pytest.fixture(scope="session", autouse=True)
def parsed_once() -> Iterator[None]:
    """Parse each text of a sphere file once, and look up each package's version once."""
    parse = cache(yaml.safe_load)
    parser = SimpleNamespace(safe_load=lambda text: deepcopy(parse(text)), YAMLError=yaml.YAMLError)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sphere_files, "yaml", parser)
        patch.setattr(output, "metadata", SimpleNamespace(version=cache(metadata.version)))
        yield


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw, lay out and paint all pictures of this test."""
    monkeypatch.setattr(files, "draw_replay", DRAW)
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", LAY_OUT)
    monkeypatch.setattr(Figure, "savefig", PAINT)
