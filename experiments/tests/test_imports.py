"""Experiments are written as a user would write them: on the public names of the package."""

import ast
from pathlib import Path

import pytest

from splatctrl_cli import api, blocks

ROOT = Path(__file__).parent.parent
OWN_TESTS = ROOT / "tests"
MODULES = sorted(path for path in ROOT.rglob("*.py") if OWN_TESTS not in path.parents)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_the_package_is_imported_by_its_public_names_alone(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            assert not [name.name for name in node.names if name.name.startswith("splatctrl_cli")]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("splatctrl_cli"):
            public = {"splatctrl_cli": api.__all__, "splatctrl_cli.blocks": blocks.__all__}[node.module or ""]
            assert {alias.name for alias in node.names} <= {*public}
