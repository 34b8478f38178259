"""Compiled kernels: numpy in, numpy out. Imports nothing of ours.

One module per instruction set is built; `native` is the best that this processor runs. SPLATCTRL_KERNELS=base
forces the plain one.
"""

import importlib
import os
from typing import Any


def _best() -> Any:
    base = importlib.import_module("splatctrl_cli.kernels._native_base")
    if os.environ.get("SPLATCTRL_KERNELS", "auto") != "base" and base.runs_x86_64_v3():
        return importlib.import_module("splatctrl_cli.kernels._native_v3")
    return base


native: Any = _best()


def num_threads(requested: int = 0) -> int:
    """`requested`, or one thread per processor this process may use when it is 0."""
    return requested if requested > 0 else len(os.sched_getaffinity(0))
