"""Compiled kernels: numpy in, numpy out.

`native` is the best for this processor; SPLATCTRL_KERNELS=base or v3 forces a plainer one. v3 (AVX2) and v4 (AVX-512)
give the same bytes.
"""

import importlib
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int16 = NDArray[np.int16]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Floats = NDArray[np.floating]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]


def _best() -> Any:
    forced = os.environ.get("SPLATCTRL_KERNELS", "auto")
    base = importlib.import_module("splatctrl_cli.kernels._native_base")
    level = min(base.x86_64_level(), {"base": 0, "v3": 3}.get(forced, 4))
    return importlib.import_module(f"splatctrl_cli.kernels._native_v{level}") if level else base


native: Any = _best()


def arithmetic() -> str:
    """Name of the plainest module that gives the same bytes as `native`."""
    name: str = native.__name__.rpartition(".")[2]
    return "_native_v3" if name == "_native_v4" else name


MIN_CAP = 16  # threads allowed on any machine


def num_threads(requested: int = 0) -> int:
    """`requested`, capped at 16 or the number of usable processors, whichever is more.

    0 means one per processor. Results do not depend on it.
    """
    if 0 < requested <= MIN_CAP:
        return requested
    processors = len(os.sched_getaffinity(0))
    return min(requested, max(MIN_CAP, processors)) if requested > 0 else processors
