"""Names of functions and classes are verbs, nouns and predicates of the field."""

import ast
from functools import cache

from tests.conftest import ROOT

Definition = ast.FunctionDef | ast.ClassDef
BARE = {
    *("about", "asked", "beside", "counted", "folded", "found", "given", "held", "kept", "lacking", "made"),
    *("measured", "paired", "placed", "planned", "resampled", "said", "thing", "told"),
}
PREPOSITIONS = ("at_", "by_", "from_", "in_", "of_", "on_", "with_", "without_")


@cache
def definitions() -> list[tuple[str, Definition]]:
    """Place and node of every function, method and class of the package."""
    return [
        (f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}", node)
        for path in sorted((ROOT / "splatctrl_cli").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, Definition)
    ]


def is_constructor(node: Definition) -> bool:
    is_classmethod = any(isinstance(d, ast.Name) and d.id == "classmethod" for d in node.decorator_list)
    return is_classmethod and node.name.startswith("from_")


def test_no_definition_has_a_bare_participle_for_a_name() -> None:
    assert [place for place, node in definitions() if node.name.strip("_").lower() in BARE] == []


def test_no_definition_begins_with_a_preposition() -> None:
    named = [(place, node) for place, node in definitions() if not is_constructor(node)]
    assert [place for place, node in named if node.name.lstrip("_").startswith(PREPOSITIONS)] == []
