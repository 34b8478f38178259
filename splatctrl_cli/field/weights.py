"""Weights of the splats in the occupancy field (paper, III-D)."""

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.field.clusters import ClusteredPoints
from splatctrl_cli.field.kernel import Kernel
from splatctrl_cli.records import Float64


def row_sum_log_weights(points: ClusteredPoints, kernel: Kernel, noise: float, *, threads: int = 0) -> Float64:
    """``log w_i = -log(noise + sum_j k(p_i, p_j))`` (N,), j = i included: the mass-lumped inverse of eq. 15.

    The diagonal of row sums stands for the kernel matrix, so that M of eq. 12 is ``w_i k_d(-r_i)``.
    """
    return _minus_log_plus(kernel.log_row_sums(points, threads=threads), noise)


def _minus_log_plus(log_sums: NDArray[np.float64], noise: float) -> Float64:
    with np.errstate(divide="ignore"):  # log 0 = -inf is the right log of no noise
        return np.asarray(-np.logaddexp(log_sums, np.log(noise)))
