"""Registries: what the modules of a room declare."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from splatctrl_cli.datasets.layouts import LAYOUTS
from splatctrl_cli.files.registry import entries_of
from splatctrl_cli.grid_files.grid_formats import FORMATS as GRID_FORMATS
from splatctrl_cli.splat_files.splat_formats import FORMATS as SPLAT_FORMATS


@dataclass(frozen=True)
class Thing:
    """An entry of the room that a test makes."""

    name: str
    order: int


def test_a_room_holds_what_its_modules_list_by_order_and_then_by_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, things in {"__init__": "", "b": "('B', 1), ('first', 0)", "a": "('A', 1)", "none": ""}.items():
        made = f"from {__name__} import Thing\nENTRIES = [Thing(*args) for args in [{things}]]\n" if things else ""
        (tmp_path / "a_room").mkdir(exist_ok=True)
        (tmp_path / "a_room" / f"{module}.py").write_text(made)
    (tmp_path / "a_room" / "other.py").write_text("ENTRIES = ('of another kind',)\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert [thing.name for thing in entries_of("a_room", Thing)] == ["first", "A", "B"]


def test_no_two_entries_of_a_room_have_one_place() -> None:
    for registry in (SPLAT_FORMATS.values(), GRID_FORMATS.values(), LAYOUTS):
        orders = [entry.order for entry in registry]
        assert len(orders) == len(set(orders)) > 5
