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


MIN_CAP = 16  # threads that may be asked for on any machine


def num_threads(requested: int = 0) -> int:
    """`requested`, but at most 16 or one per processor, whichever is more; one per processor where it is 0.

    A processor is one that this process may use. The cap keeps thousands of threads from taking minutes to start;
    results are the same for any number.
    """
    if 0 < requested <= MIN_CAP:
        return requested
    processors = len(os.sched_getaffinity(0))
    return min(requested, max(MIN_CAP, processors)) if requested > 0 else processors
