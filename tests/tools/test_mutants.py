"""The table of mutants fits the code, and the runner tells a bug that is noticed from one that is not."""

import tomllib
from pathlib import Path

import pytest

from tools.mutants import ROOT, TABLE, Mutant, read_mutants

MUTANTS = read_mutants()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_each_bug_has_one_place_and_tests(mutant: Mutant) -> None:
    assert mutant.place(ROOT).is_file()
    assert mutant.test_files(ROOT)
    assert mutant.old != mutant.new


def test_each_bug_has_a_name_of_its_own() -> None:
    rooms = tomllib.loads(TABLE.read_text())
    assert len({name for entries in rooms.values() for name in entries}) == len(MUTANTS)


def planted(root: Path, **changed: object) -> Mutant:
    """A bug in a small package below `root`."""
    package = root / "splatctrl_cli"
    for place in (package / "a" / "sums.py", package / "b" / "sums.py"):
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(f"def total_{place.parent.name}(x: int, y: int) -> int:\n    return x + y\n")
    entry = {"file": "sums.py", "old": "total_b(", "new": "total(", "tests": ["test_sums.py"]} | changed
    return Mutant(room="data", name="a-bug", **entry)  # type: ignore[arg-type]


@pytest.mark.parametrize("old", ["x + y", "x - y"])
def test_text_that_does_not_stand_there_once_is_refused(tmp_path: Path, old: str) -> None:
    with pytest.raises(ValueError, match=r"a-bug: expected the text once in sums.py, got [02] times"):
        planted(tmp_path, old=old).place(tmp_path)
