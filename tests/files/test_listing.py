"""Folders are listed by names, and what is below them is counted without following links to folders."""

from pathlib import Path

from splatctrl_cli.files.listing import files_below, names_in
from splatctrl_cli.sources.describe import describe


def test_names_come_sorted_and_files_below_are_counted_once(tmp_path: Path) -> None:
    for name, size in (("b", 3), ("a", 2), ("c/d/e", 5)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(bytes(size))
    (tmp_path / "loop").symlink_to(".")
    (tmp_path / "nowhere").symlink_to("nothing")
    (tmp_path / "again").symlink_to("a")
    assert names_in(tmp_path) == ["a", "again", "b", "c", "loop", "nowhere"]
    assert files_below(tmp_path) == (4, 12)
    assert files_below(tmp_path / "c") == (1, 5)
    assert files_below(tmp_path / "b") == (1, 3)
    assert files_below(tmp_path / "nowhere") == (0, 0)


def test_a_run_folder_is_described_by_its_first_thousand_names(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    for number in range(1200):
        (tmp_path / f"{number}").write_bytes(b"x")
    found = describe(tmp_path)
    assert (found.facts["files"], found.facts["bytes"]) == (1201, 1202)
    assert len(found.grids[0].rows) == 1000
