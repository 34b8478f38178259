"""The words of docstrings: the first one carries meaning, the first paragraph is short, the terms are the field's."""

import ast
import re
from functools import cache

from tests.conftest import ROOT

FUNCTION_WORDS = {"As", "By", "For", "How", "Of", "That", "These", "Those", "What", "Where", "Whether", "Which"}
UNCLEAR = re.compile(
    r"\b(thing|things|told|said|asked|lacking|beside|nobody|somebody|comes to|goes on)\b", re.IGNORECASE
)
NAMES = re.compile(r"`[^`]*`|\b\w+:")  # of code, and of what a docstring explains
LONGEST = 60  # words of a first paragraph


@cache
def docstrings() -> list[tuple[str, str]]:
    """Place and text of every docstring of the package."""
    found = []
    for path in sorted((ROOT / "splatctrl_cli").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                text = ast.get_docstring(node)
                if text:
                    found.append((f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}", text))
    return found


def test_a_docstring_begins_with_a_word_that_carries_it() -> None:
    assert [place for place, text in docstrings() if text.split()[0] in FUNCTION_WORDS] == []


def test_the_first_paragraph_of_a_docstring_is_short() -> None:
    assert [place for place, text in docstrings() if len(text.split("\n\n")[0].split()) > LONGEST] == []


def test_docstrings_use_the_terms_of_the_field() -> None:
    assert [place for place, text in docstrings() if UNCLEAR.search(NAMES.sub("", text))] == []
