"""The public Python API: its names cost nothing until asked for, and the examples of docs/api.md run."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

import splatctrl_cli
from splatctrl_cli import api
from tests.cli.conftest import few_points, short_sample
from tests.quick import unpainted

__all__ = ["few_points", "short_sample", "unpainted"]

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "api.md"
HEAVY = ("numpy", "pinocchio", "cv2", "splatctrl_cli.api")
LATE = ("matplotlib", "trimesh", "torch", "open3d", "pxr")


@pytest.mark.parametrize("name", api.__all__)
def test_every_public_name_comes_from_the_package_and_from_its_api(name: str) -> None:
    assert getattr(splatctrl_cli, name) is getattr(api, name)


@pytest.mark.parametrize("name", ["ReplayInputs", "_bake"])
def test_a_name_that_is_not_public_is_an_attribute_error(name: str) -> None:
    with pytest.raises(AttributeError, match=f"'{name}'"):
        getattr(splatctrl_cli, name)


def test_the_package_lists_its_public_names_and_a_star_imports_them() -> None:
    code = "from splatctrl_cli import *; import splatctrl_cli; print(sorted(set(dir()) & set(dir(splatctrl_cli))))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(api.__all__) <= {*re.findall(r"'(\w+)'", done.stdout)}
    assert set(dir(splatctrl_cli)) >= {*api.__all__, "__version__"}


@pytest.mark.parametrize(("module", "names"), [("splatctrl_cli", HEAVY), ("splatctrl_cli.api", LATE)])
def test_importing_loads_neither_what_is_heavy_nor_what_is_used_late(module: str, names: tuple[str, ...]) -> None:
    code = f"import {module}, sys; print([name for name in {names} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_the_page_lists_every_job_that_has_a_request() -> None:
    (jobs,) = re.findall(r"^- Jobs: ([^.]+)\.$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    kinds = {name: name.title().replace("_", "") for name in api.__all__}
    with_request = {name for name, kind in kinds.items() if f"{kind}Request" in api.__all__}
    assert set(re.findall(r"`(\w+)`", jobs)) == with_request
    results = {get_type_hints(getattr(api, name))["return"].__name__ for name in with_request}
    assert results <= {*api.__all__}


def test_the_examples_of_the_page_run_on_the_sample_data(
    short_sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sample_data").symlink_to(short_sample)
    monkeypatch.chdir(tmp_path)
    examples = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    scope: dict[str, object] = {}
    for example in examples:
        exec(compile(example, PAGE.name, "exec"), scope)
    names = ("made", "baked", "answered", "exported", "scored", "audited", "since")
    made, baked, answered, exported, scored, audited, since = (scope[name] for name in names)
    assert all(isinstance(each, api.JudgedResult) for each in (made, baked, scored, audited, since))
    assert all(isinstance(scope[name], api.Result) for name in ("answered", "exported", "log", "page", "viewer"))
    assert isinstance(audited, api.ReplayResult) and isinstance(since, api.CompareResult)
    assert (since.verdict.label, since.figures, dict(since.differences)) == ("no regression", (), {})
    assert answered.metrics["num_answered"] == 2  # type: ignore[attr-defined]
    for result in (made, baked, answered, exported, scored, audited, since):
        verdict = getattr(result, "verdict", None)
        assert len(repr(result)) < 1200 and (verdict is None or verdict.sentence in repr(result))
    assert made.verdict.outcome is scored.verdict.outcome is api.Outcome.PASSED
    written = {path.name for path in (tmp_path / "api_output").iterdir()}
    assert written == {
        *("scene", "field", "points.csv", "answers.csv", "objects.spz", "audit", "again", "baseline.toml"),
        *("audit.html", "scene.html", "scene.mcap"),
    }
    assert str(audited.verdict.label) in capsys.readouterr().out
