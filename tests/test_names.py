"""Names of functions and classes, and the first sentences of docstrings."""

import ast
import re
from collections.abc import Iterator
from functools import cache

from tests.conftest import ROOT

Definition = ast.FunctionDef | ast.ClassDef
BARE = {
    *("about", "asked", "beside", "counted", "folded", "found", "given", "held", "kept", "lacking", "made"),
    *("measured", "paired", "placed", "planned", "resampled", "said", "thing", "told"),
}
PREPOSITIONS = ("at_", "by_", "from_", "in_", "of_", "on_", "with_", "without_")
LONGEST = 15  # words of a first sentence
SENTENCE_END = re.compile(r"[.;:] ")
CODE, IN_BRACKETS = re.compile(r"``[^`]*``|`[^`]*`"), re.compile(r"\([^()]*\)|\[[^\[\]]*\]")


@cache
def definitions() -> list[tuple[str, Definition]]:
    """Place and node of every function, method and class of the package."""
    return [
        (f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}", node)
        for path in sorted((ROOT / "splatctrl_cli").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, Definition)
    ]


def first_lines() -> Iterator[tuple[str, str]]:
    """Place and first line of every public docstring."""
    for place, node in definitions():
        text = ast.get_docstring(node)
        if text and not node.name.startswith("_"):
            yield place, text.split("\n")[0]


def is_constructor(node: Definition) -> bool:
    is_classmethod = any(isinstance(d, ast.Name) and d.id == "classmethod" for d in node.decorator_list)
    return is_classmethod and node.name.startswith("from_")


def test_no_definition_has_a_bare_participle_for_a_name() -> None:
    assert [place for place, node in definitions() if node.name.strip("_").lower() in BARE] == []


def test_no_definition_begins_with_a_preposition() -> None:
    named = [(place, node) for place, node in definitions() if not is_constructor(node)]
    assert [place for place, node in named if node.name.lstrip("_").startswith(PREPOSITIONS)] == []


def test_a_public_docstring_begins_with_a_capital_or_with_code() -> None:
    assert [place for place, line in first_lines() if re.match(r"[a-z]{2,} ", line)] == []


def test_a_public_docstring_begins_with_a_short_sentence() -> None:
    assert [place for place, line in first_lines() if len(words(SENTENCE_END.split(line)[0])) > LONGEST] == []


def words(sentence: str) -> list[str]:
    """Words of a sentence, without shapes, units and what stands in brackets; code is one word."""
    return [word for word in IN_BRACKETS.sub("", CODE.sub("code", sentence)).split() if re.search(r"\w", word)]
