"""Where tests find data: the project's own sample_data/, an arm without meshes, and real recordings kept outside."""

import gc
import os
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# As the command line does before numpy is imported; and torch, which only tests use, waits for its threads as much.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_collection_finish() -> None:
    """Search for garbage less often, and not in what was imported."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture(scope="session", autouse=True)
def user_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test reads or writes the user's own cache."""
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def sample_data() -> Path:
    """The committed simulated recording."""
    return ROOT / "sample_data"


@pytest.fixture(scope="session")
def plain_arm() -> Path:
    """A folder whose tabletop/ holds the simulated arm, of primitive shapes, and spheres that cover it closely."""
    return ROOT / "tests" / "data"


@pytest.fixture(scope="session")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, scene, field and replay that version 0.1.0 wrote; not to be written to."""
    folder = tmp_path_factory.mktemp("older")
    shutil.unpack_archive(ROOT / "tests" / "data" / "older.zip", folder)
    return folder


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Real recordings: SPLATCTRL_REAL_DATA, else ../shared/data; skips, saying so, where neither is there."""
    folder = Path(os.environ.get("SPLATCTRL_REAL_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set SPLATCTRL_REAL_DATA")
    return folder
