"""Where tests find data: the project's own sample_data/, an arm without meshes, and real recordings kept outside."""

import os
from collections.abc import Iterator
from copy import deepcopy
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from splatctrl_cli.jobs.replay import files
from splatctrl_cli.robot import sphere_files

ROOT = Path(__file__).parent.parent

# As the command line does before numpy is imported; and torch, which only tests use, waits for its threads as much.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

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
    """Parse each text of a sphere file once: the arm's takes as long as many a test."""
    parse = cache(yaml.safe_load)
    parser = SimpleNamespace(safe_load=lambda text: deepcopy(parse(text)), YAMLError=yaml.YAMLError)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sphere_files, "yaml", parser)
        yield


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw, lay out and paint all pictures of this test."""
    monkeypatch.setattr(files, "draw_replay", DRAW)
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", LAY_OUT)
    monkeypatch.setattr(Figure, "savefig", PAINT)


@pytest.fixture(scope="session")
def sample_data() -> Path:
    """The committed simulated recording."""
    return ROOT / "sample_data"


@pytest.fixture(scope="session")
def plain_arm() -> Path:
    """A folder whose tabletop/ holds the simulated arm, of primitive shapes, and spheres that cover it closely."""
    return ROOT / "tests" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Real recordings: SPLATCTRL_REAL_DATA, else ../shared/data; skips, saying so, where neither is there."""
    folder = Path(os.environ.get("SPLATCTRL_REAL_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set SPLATCTRL_REAL_DATA")
    return folder
