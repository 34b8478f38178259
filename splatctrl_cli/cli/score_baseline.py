"""``score --baseline``: by how much each figure changed since an earlier score of the same protocol."""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError

PREFIX = "change_"
COMPARED = ("name", "split", "mask_rule", "resolution", "averaging", "lpips", "scans")


def add_baseline(parser: argparse.ArgumentParser) -> None:
    """``--baseline``."""
    parser.add_argument(
        "--baseline",
        type=Path,
        metavar="FILE",
        help="score.json of an earlier score -o: prints the change of each figure, gated as change_NAME",
    )


def read_baseline(path: Path) -> dict[str, Any]:
    """What an earlier score wrote. Raises InputError where that is no score."""
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(earlier["metrics"], dict) and isinstance(earlier["protocol"], dict):
            return dict(earlier)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError):
        pass
    raise InputError(f"{path}: expected the score.json of an earlier score, got another file")


def changes(result: Mapping[str, Any], earlier: Mapping[str, Any], path: Path) -> dict[str, float | None]:
    """New less old of each figure, None where either is; raises InputError where they came about differently."""
    now, then = ({**one["protocol"], "scans": one.get("scans")} for one in (result, earlier))
    for name in COMPARED:
        if now.get(name) != then.get(name):
            raise InputError(
                f"{path}: not comparable: {name}: expected {now.get(name)}, got {then.get(name)}",
                remedy="score the baseline anew, in the same way",
            )
    changed: dict[str, float | None] = {}
    for name, value in result["metrics"].items():
        old = earlier["metrics"].get(name)
        changed[PREFIX + name] = None if value is None or not isinstance(old, int | float) else value - old
    return changed


def change_cells(columns: Sequence[str], metrics: Mapping[str, Any]) -> list[str]:
    """The changes as the table shows them, with their signs."""
    from splatctrl_cli.cli.score_report import cell

    def signed(name: str, value: float | None) -> str:
        return "-" if value is None else ("-" if value < 0 else "+") + cell(name, abs(value))

    return [signed(name, metrics.get(PREFIX + name)) for name in columns]
