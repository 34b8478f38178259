"""The full Gaussian process of eq. 8: its linear system on a truncated kernel, by conjugate gradients."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from splatctrl_cli.config.fixed import CG_FLOOR, CG_ITERATIONS, CG_MAX_SPREAD, CG_TOLERANCE, KERNEL_REACH
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.field.grid_cells import available_memory
from splatctrl_cli.records import Float64

BYTES_PER_PAIR = 44  # of the matrix and of the pairs that it is made of; 40 were measured

KernelValue = Callable[[Float64], Float64]


@dataclass(frozen=True, kw_only=True)
class Solution:
    """M of eq. 12 (N,) as ``scaled exp(log_scale)``, the iterations it took, and the largest residual that is left.

    The residual is of a row, over the largest value asked for in the group of splats that the row belongs to.
    """

    scaled: Float64
    log_scale: Float64
    num_iterations: int
    residual: float


def solve_process(
    centers: Float64, log_values: Float64, length: float, kernel: KernelValue, noise: float
) -> Solution:
    """``(K(P, P) + noise I)^-1 y`` (eq. 8, 12) for centres (N, 3) [m] and y = exp(log_values) (N,).

    The kernel is cut off at 8 l. Splats that it does not join are groups apart, each with values scaled by its own
    largest: y of a Matern kernel is ``e^(r / l)``, which overflows. Raises UsageError where the matrix does not fit
    the memory or a group's values are too far apart, NotEvaluableError where the iteration does not converge.
    """
    matrix = _kernel_matrix(centers, length, kernel, noise)
    num_groups, group = connected_components(matrix, directed=False)
    largest, smallest = np.full(num_groups, -np.inf), np.full(num_groups, np.inf)
    np.maximum.at(largest, group, log_values)
    np.minimum.at(smallest, group, log_values)
    spread = float((largest - smallest).max())
    if spread > CG_MAX_SPREAD:
        raise UsageError(
            f"field.weights = cg: expected radii that differ by at most {CG_MAX_SPREAD:g} length scales between "
            f"splats within {KERNEL_REACH} of each other, got {spread:.1f}",
            remedy="set a larger field.length_scale, or field.weights = rowsum",
        )
    tolerance = max(CG_TOLERANCE * float(np.exp(-spread)), CG_FLOOR)
    scaled, num_iterations, residual = conjugate_gradients(matrix, np.exp(log_values - largest[group]), tolerance)
    return Solution(scaled=scaled, log_scale=largest[group], num_iterations=num_iterations, residual=residual)


def conjugate_gradients(matrix: "csr_array", values: Float64, tolerance: float) -> tuple[Float64, int, float]:
    """x (N,) with ``max |A x - y| <= tolerance``, the iterations, and that largest residual.

    A of unit diagonal needs no preconditioner. Raises NotEvaluableError where A shows a direction of no curvature,
    or the residual stays above the tolerance for `CG_ITERATIONS`.
    """
    x = np.zeros(len(values))
    rest = values.copy()
    direction, squared = rest.copy(), float(rest @ rest)
    for iteration in range(CG_ITERATIONS):
        if float(np.abs(rest).max()) <= tolerance:
            rest = values - matrix @ x  # the recurrence drifts from the true residual
            residual = float(np.abs(rest).max())
            if residual <= 2.0 * tolerance:
                return x, iteration, residual
            direction, squared = rest.copy(), float(rest @ rest)
        image = matrix @ direction
        curvature = float(direction @ image)
        if curvature <= 0.0:
            raise _not_solved(f"the kernel matrix is not positive definite (iteration {iteration})")
        step = squared / curvature
        x += step * direction
        rest -= step * image
        before, squared = squared, float(rest @ rest)
        direction = rest + squared / before * direction
    residual = float(np.abs(values - matrix @ x).max())
    raise _not_solved(f"expected a residual of {tolerance:.1e} after {CG_ITERATIONS} iterations, got {residual:.1e}")


def _not_solved(what: str) -> NotEvaluableError:
    return NotEvaluableError(
        f"field.weights = cg: {what}",
        remedy="set a larger field.noise (1e-2) or a smaller field.length_scale, or field.weights = rowsum",
    )


def _kernel_matrix(centers: Float64, length: float, kernel: KernelValue, noise: float) -> "csr_array":
    """``K + noise I`` (N, N), zero between centres further than 8 l apart."""
    tree = cKDTree(centers)
    num_pairs = int(tree.count_neighbors(tree, KERNEL_REACH * length))
    needed, free = BYTES_PER_PAIR * num_pairs, available_memory()
    if needed > free:
        raise UsageError(
            f"field.weights = cg: {num_pairs} pairs of splats within {KERNEL_REACH} length scales need "
            f"{needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB is free",
            remedy="set a smaller field.length_scale, or field.weights = rowsum",
        )
    pairs = tree.query_pairs(KERNEL_REACH * length, output_type="ndarray").astype(np.int32)
    distance = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
    upper = csr_array((kernel(distance), (pairs[:, 0], pairs[:, 1])), shape=(len(centers), len(centers)))
    return csr_array(upper + upper.T + (1.0 + noise) * eye_array(len(centers), format="csr"))
