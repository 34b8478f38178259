"""Weights of the splats in the occupancy field (paper, III-D)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.kernel import Kernel
from splatctrl_cli.field.spheres import Spheres
from splatctrl_cli.records import Float32, Float64


@dataclass(frozen=True, kw_only=True)
class Weights:
    """w (N,) as ``sign exp(log_size)``: the occupancy is ``o(x) = sum_i w_i k_d(-r_i) k(x, p_i)``.

    log_size (N,) float64; sign (N,) float32 of +-1, None where all are positive.
    """

    log_size: Float64
    sign: Float32 | None


def row_sum_weights(spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """``w_i = 1 / (noise + sum_j k(p_i, p_j))``, j = i included: the mass-lumped inverse of eq. 15.

    The diagonal of row sums stands for the kernel matrix, so that M of eq. 12 is ``w_i k_d(-r_i)``.
    """
    log_sums = kernel.log_row_sums(spheres.points, threads=threads)
    with np.errstate(divide="ignore"):  # log 0 = -inf is the right log of no noise
        return Weights(log_size=np.asarray(-np.logaddexp(log_sums, np.log(noise))), sign=None)


Method = Callable[[Spheres, Kernel, float, int], Weights]
METHODS: Mapping[str, Method] = {"rowsum": row_sum_weights}


def weights_named(name: str, spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """The weights that the configuration names. Raises UsageError for a name that is not there."""
    if name not in METHODS:
        raise UsageError(f"field.weights: expected one of {', '.join(METHODS)}, got {name}")
    return METHODS[name](spheres, kernel, noise, threads)
