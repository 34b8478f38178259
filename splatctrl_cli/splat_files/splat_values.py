"""How splat files hold values: opacities as logits, sigmas as logarithms, and what has no place in them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Bool, Float32, Float64

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
UNIT_TOLERANCE = 5e-7  # of a quaternion's length; float32 can do no better
LOGIT_OF_ONE = 20.0  # finite, and its sigmoid is exactly 1 in float32
LOGIT_OF_ZERO = -110.0  # finite, and its sigmoid is exactly 0 in float32


def logit(opacities: Float32) -> Float64:
    """log(p / (1 - p)) of (N,) opacities in [0, 1]; exactly 0 and 1 get finite values whose `sigmoid` they are."""
    inside = (opacities > 0) & (opacities < 1)
    p = np.where(inside, opacities, 0.5).astype(np.float64)
    return np.where(inside, np.log(p) - np.log1p(-p), np.where(opacities > 0.5, LOGIT_OF_ONE, LOGIT_OF_ZERO))


def sigmoid(logits: Float64) -> Float32:
    """1 / (1 + exp(-x)) of (N,) logits."""
    decay = np.exp(-np.minimum(np.abs(logits), 700.0))
    return np.asarray(np.where(logits >= 0, 1.0, decay) / (1.0 + decay), dtype=np.float32)


def sigma_of_log(where: str, name: str, logs: Float64) -> Float32:
    """exp(x) as float32 [m]; raises InputError, naming the splat, where that is infinite or zero."""
    values = np.exp(np.clip(logs, -700.0, 700.0))
    limits = np.finfo(np.float32)
    refuse(where, name, values, (values > limits.max) | (values < limits.tiny), "a radius that float32 holds [m]")
    return values.astype(np.float32)


def unit_quaternions(where: str, quats: NDArray[np.floating]) -> Float32:
    """(N, 4) quaternions scaled to length one, to the bit where they have it; InputError for one of no length."""
    wide = quats.astype(np.float64)
    lengths = np.linalg.norm(wide, axis=1, keepdims=True)
    refuse(where, "rotation", quats, np.asarray(~(lengths[:, 0] > 1e-12)), "a quaternion that is not zero")
    return np.where(np.abs(lengths - 1.0) <= UNIT_TOLERANCE, wide, wide / lengths).astype(np.float32)


def refuse(where: str, name: str, values: NDArray[Any], is_bad: Bool, expected: str) -> None:
    """Raise InputError that names the first splat where `is_bad` (N,)."""
    bad = np.flatnonzero(is_bad)
    if len(bad):
        value = values[bad[0]]
        shown = f"{value:g}" if value.ndim == 0 else str(value)
        raise InputError(f"{where}: splat {bad[0]}: {name}: expected {expected}, got {shown}")


def check_finite(where: str, num: int, groups: Mapping[str, NDArray[Any]]) -> None:
    """Raise InputError at the first value that is not finite, or an array that has not `num` rows."""
    for name, values in groups.items():
        if len(values) != num:
            raise InputError(f"{where}: {name}: expected {num} values, got {len(values)}")
        is_finite = np.isfinite(values.reshape(num, -1 if num else 1)).all(axis=1)
        refuse(where, name, values, ~is_finite, "finite")
