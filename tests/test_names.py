"""Names of functions and classes are verbs, nouns and predicates of the field."""

import ast
from collections.abc import Iterator
from functools import cache

from tests.conftest import ROOT

Definition = ast.FunctionDef | ast.ClassDef
BARE = {
    *("about", "asked", "beside", "counted", "folded", "found", "given", "held", "kept", "lacking", "made"),
    *("measured", "paired", "placed", "planned", "resampled", "said", "taken", "thing", "things", "told"),
}
VAGUE = BARE - {"counted", "measured", "paired", "placed", "planned", "taken"}  # of fields too
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


def fields() -> list[tuple[str, str]]:
    """Place and name of every field of a class and attribute of an object, where the package sets it."""
    stores = [
        (path.relative_to(ROOT), node.lineno, node.attr if isinstance(node, ast.Attribute) else node.id)
        for path in sorted((ROOT / "splatctrl_cli").rglob("*.py"))
        for node in nodes_with_fields(ast.parse(path.read_text(encoding="utf-8")))
    ]
    return [(f"{path}:{line}: {name}", name) for path, line, name in stores]


def nodes_with_fields(tree: ast.Module) -> Iterator[ast.Attribute | ast.Name]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node
        if isinstance(node, ast.ClassDef):
            yield from (
                line.target
                for line in node.body
                if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
            )


def is_constructor(node: Definition) -> bool:
    is_classmethod = any(isinstance(d, ast.Name) and d.id == "classmethod" for d in node.decorator_list)
    return is_classmethod and node.name.startswith("from_")


def test_no_definition_has_a_bare_participle_for_a_name() -> None:
    assert [place for place, node in definitions() if node.name.strip("_").lower() in BARE] == []


def test_no_field_has_a_vague_name() -> None:
    assert len(fields()) > 1000
    assert [place for place, name in fields() if name.strip("_").lower() in VAGUE] == []


def test_no_definition_begins_with_a_preposition() -> None:
    named = [(place, node) for place, node in definitions() if not is_constructor(node)]
    assert [place for place, node in named if node.name.lstrip("_").startswith(PREPOSITIONS)] == []
