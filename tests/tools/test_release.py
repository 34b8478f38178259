"""Before a release: what is checked without building anything."""

import re
from pathlib import Path

import pytest

import splatctrl_cli
from tests.robot.shapes import written
from tools import release


def test_every_file_states_this_version() -> None:
    stated = release.versions()
    assert set(stated) == set(release.STATED)
    assert stated.pop("CHANGELOG.md") in (splatctrl_cli.__version__, "Unreleased")
    assert set(stated.values()) == {splatctrl_cli.__version__}


def test_versions_that_differ_end_the_release(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in release.STATED:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text((release.ROOT / name).read_text())
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text(re.sub(r"^## .*$", "## Unreleased", changelog.read_text(), count=1, flags=re.M))
    found = release.versions(tmp_path)
    monkeypatch.setattr(release, "versions", lambda: found)
    with pytest.raises(SystemExit, match=r"expected one, got .*'CHANGELOG.md': 'Unreleased'"):
        release.agree()


def test_a_bare_environment_holds_no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    written(tmp_path, "", "bare/bin/cmake").chmod(0o755)
    monkeypatch.setattr(release, "DIST", tmp_path)
    monkeypatch.setattr(release, "_run", lambda *words: None)
    with pytest.raises(SystemExit, match="expected no compiler, got cmake"):
        release._environment("bare", path="")
