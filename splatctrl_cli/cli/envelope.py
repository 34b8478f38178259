"""What every object of ``--json`` begins with, as its published JSON Schema says."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCHEMA = "splatctrl-output 1"
SCHEMA_FILE = Path(__file__).parent.parent / "report" / "output.schema.json"


def enveloped(result: Mapping[str, Any], code: int) -> dict[str, Any]:
    """The schema's name and the exit code, then the result."""
    first = {"schema": SCHEMA, "exit_code": code}
    return {**first, **result, **first}
