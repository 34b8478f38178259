"""docs/formats.md names tests that are there."""

import re

from tests.conftest import ROOT

PAGE = ROOT / "docs" / "formats.md"


def test_every_proof_of_the_page_is_a_test() -> None:
    proofs = re.findall(r"`(\S+\.py): (\w+)`", PAGE.read_text(encoding="utf-8"))
    assert len(proofs) > 40
    missing = [
        f"{file}: {name}"
        for file, name in proofs
        if f"def {name}(" not in (ROOT / "tests" / file).read_text(encoding="utf-8")
    ]
    assert not missing
