"""Runs that are stopped on the way, and what a folder then holds."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def contents(folder: Path) -> dict[str, Any]:
    """Bytes by name, of run.json all but the timings and the command line."""
    found: dict[str, Any] = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    run = json.loads(found["run.json"])
    del run["seconds"], run["arguments"]
    return found | {"run.json": run}


def failing(real: Callable[..., Any], when: int, error: BaseException) -> Callable[..., Any]:
    """`real`, but its call number `when` raises: after half of its work where that is a file, else before any."""
    calls = 0

    def call(path: Any, *rest: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == when and not isinstance(path, Path):
            raise error
        result = real(path, *rest, **named)
        if calls == when:
            os.truncate(path, path.stat().st_size // 2)
            raise error
        return result

    return call


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt
