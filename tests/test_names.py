"""Names of functions and classes are verbs, nouns and predicates of the field."""

import ast
from functools import cache

from tests.conftest import ROOT

Definition = ast.FunctionDef | ast.ClassDef
BARE = {
    *("about", "asked", "beside", "counted", "folded", "found", "given", "held", "kept", "lacking", "made"),
    *("measured", "paired", "placed", "planned", "resampled", "said", "taken", "thing", "things", "told"),
}
VAGUE = BARE - {"counted", "measured", "paired", "placed", "planned", "taken"}  # of fields and locals too
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


def variables() -> list[tuple[str, str]]:
    """Place and name of every field, attribute, local and parameter, where the package sets it."""
    stores = [
        (path.relative_to(ROOT), node.lineno, name)
        for path in sorted((ROOT / "splatctrl_cli").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if (name := name_of(node)) is not None
    ]
    return [(f"{path}:{line}: {name}", name) for path, line, name in stores]


def name_of(node: ast.AST) -> str | None:
    """Name that a node sets; None for other nodes."""
    if isinstance(node, ast.arg):
        return node.arg
    if isinstance(node, ast.Attribute | ast.Name) and isinstance(node.ctx, ast.Store):
        return node.attr if isinstance(node, ast.Attribute) else node.id
    return None


def is_constructor(node: Definition) -> bool:
    is_classmethod = any(isinstance(d, ast.Name) and d.id == "classmethod" for d in node.decorator_list)
    return is_classmethod and node.name.startswith("from_")


def test_no_definition_has_a_bare_participle_for_a_name() -> None:
    assert [place for place, node in definitions() if node.name.strip("_").lower() in BARE] == []


def test_no_variable_has_a_vague_name() -> None:
    assert len(variables()) > 10_000
    assert [place for place, name in variables() if name.strip("_").lower() in VAGUE] == []


def test_no_definition_begins_with_a_preposition() -> None:
    named = [(place, node) for place, node in definitions() if not is_constructor(node)]
    assert [place for place, node in named if node.name.lstrip("_").startswith(PREPOSITIONS)] == []
