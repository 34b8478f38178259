"""Registries: what the modules of a room declare; and the names in a folder."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from splatctrl_cli.files.summary import files_below, names_in
from splatctrl_cli.formats.grid.grid_formats import FORMATS as GRID_FORMATS
from splatctrl_cli.formats.splat.splats import FORMATS as SPLAT_FORMATS
from splatctrl_cli.libraries import entries_of
from splatctrl_cli.recording.folder.image_folder import LAYOUTS
from splatctrl_cli.recording.source import describe


@dataclass(frozen=True)
class Thing:
    """An entry of the room that a test makes."""

    name: str
    order: int


def test_a_room_holds_what_its_modules_list_by_order_and_then_by_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a_room").mkdir()
    for module, things in {"__init__": "", "b": "('B', 1), ('first', 0)", "a": "('A', 1)", "none": ""}.items():
        made = f"from {__name__} import Thing\nENTRIES = [Thing(*args) for args in [{things}]]\n" if things else ""
        (tmp_path / "a_room" / f"{module}.py").write_text(made)
    (tmp_path / "a_room" / "other.py").write_text("ENTRIES = ('of another kind',)\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert [thing.name for thing in entries_of("a_room", Thing)] == ["first", "A", "B"]
    for registry in (SPLAT_FORMATS.values(), GRID_FORMATS.values(), LAYOUTS):
        orders = [entry.order for entry in registry]
        assert len(orders) == len(set(orders)) > 5, "no two have one place"


def test_names_come_sorted_and_files_below_are_counted_once(tmp_path: Path) -> None:
    for name, size in (("b", 3), ("a", 2), ("c/d/e", 5)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(bytes(size))
    for link, target in (("loop", "."), ("nowhere", "nothing"), ("again", "a")):
        (tmp_path / link).symlink_to(target)
    assert names_in(tmp_path) == ["a", "again", "b", "c", "loop", "nowhere"]
    counted = [files_below(tmp_path / name) for name in (".", "c", "b", "nowhere")]
    assert counted == [(4, 12), (1, 5), (1, 3), (0, 0)]


def test_a_run_folder_is_described_by_its_first_thousand_names(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    for number in range(1200):
        (tmp_path / f"{number}").write_bytes(b"x")
    found = describe(tmp_path)
    assert (found.facts["files"], found.facts["bytes"], len(found.grids[0].rows)) == (1201, 1202, 1000)
