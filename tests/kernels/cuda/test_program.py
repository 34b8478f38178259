"""The kernels compile without a card, and what was compiled is kept."""

from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.kernels.cuda import card
from splatctrl_cli.kernels.cuda.memory import FIELD, FIT


@pytest.mark.parametrize("source", [FIT, FIELD])
@pytest.mark.parametrize("capability", [(7, 5), (12, 0)])
def test_kernels_compile_for_the_oldest_and_the_newest_generation(
    capability: tuple[int, int], source: str, tmp_path: Path
) -> None:
    code = card.compiled(capability, tmp_path, source=source).code
    assert code[:4] == b"\x7fELF"
    assert b".text.bake_hard" in code or source == FIT  # by its name, as it is launched


def test_a_second_start_does_not_compile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = card.compiled((8, 0), tmp_path).code

    def fails(*_: Any) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(card, "Program", fails)
    assert card.compiled((8, 0), tmp_path).code == first
    monkeypatch.setattr(card, "source_digest", lambda: b"changed")
    with pytest.raises(AssertionError, match="compiled again"):
        card.compiled((8, 0), tmp_path)


def test_a_cache_that_cannot_be_written_costs_the_compilation_only(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert card.compiled((8, 0), tmp_path / "file").code[:4] == b"\x7fELF"
