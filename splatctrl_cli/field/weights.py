"""Kernels of the distance field, and its weights (III-D)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfftn, rfftn
from scipy.sparse import csr_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from splatctrl_cli.config.fixed import (
    CG_FLOOR,
    CG_ITERATIONS,
    CG_MAX_SPREAD,
    CG_TOLERANCE,
    KERNEL_MAX_SHARE,
    KERNEL_REACH,
    VOXELS_PER_LENGTH,
)
from splatctrl_cli.errors import NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.grid_cells import available_memory
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import Float32, Float64, Index

KernelValue = Callable[[Float64], Float64]
NODES = 96  # per axis of a block: a size with a fast transform, 7 MiB
MAX_BLOCKS = 2000


def voxel_row_sums(centers: Float64, length: float, kernel: KernelValue) -> Float64:
    """``sum_j k(|p_i - p_j|)`` (N,) of centres (N, 3) [m], j = i included, in linear time.

    Each centre spreads one unit over eight nodes (trilinear), and reads the convolution there. Its own term becomes
    k(0) = 1. Convolving with ``2 k - (mean of k at the six neighbours)`` undoes the blur of h^2 / 3 per axis (h: node
    spacing), to second order. Raises UsageError for over `MAX_BLOCKS` blocks.
    """
    voxel, reach = length / VOXELS_PER_LENGTH, KERNEL_REACH * VOXELS_PER_LENGTH
    nodes = (centers - centers.min(axis=0)) / voxel
    cells = np.floor(nodes).astype(np.int64)
    share = nodes - cells
    sampled = _sampled_kernel(kernel, voxel, reach)
    result = 1.0 - _own_terms(share, sampled[reach:, reach:, reach:])
    meetings = [block for block in _blocks(cells, reach) if len(block[1]) > 1]
    refuse_if(
        len(meetings) > MAX_BLOCKS,
        f"field.weights = voxel: expected at most {MAX_BLOCKS} blocks of voxels with splats, got {len(meetings)}",
        remedy="set field.weights = rowsum, which is fast on splats this far apart, or a larger length scale",
        error=UsageError,
    )
    transformed = _transformed_kernel(sampled)
    alone = np.ones(len(centers), np.bool_)
    for first, near, own in meetings:
        mass = _spread(cells[near] - first, share[near])
        density = irfftn(rfftn(mass) * transformed, s=mass.shape)  # circular: what wraps stays within reach of faces
        result[own] += _read(density, cells[own] - first, share[own])
        alone[own] = False
    result[alone] = 1.0
    return result


def _blocks(cells: Index, reach: int) -> list[tuple[Index, Index, Index]]:
    """Each block's first node (3,), centres in reach, centres inside."""
    inner = NODES - 2 * reach - 1  # cells that no mass from outside the block reaches
    blocks, which = np.unique(cells // inner, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    bounds = np.searchsorted(which.ravel()[order], np.arange(len(blocks) + 1))
    members = {(x, y, z): order[bounds[b] : bounds[b + 1]] for b, (x, y, z) in enumerate(blocks.tolist())}
    steps = list(product((-1, 0, 1), repeat=3))
    entries = []
    for (x, y, z), own in members.items():
        around = [members.get((x + i, y + j, z + k)) for i, j, k in steps]
        near = np.concatenate([some for some in around if some is not None])
        first = inner * np.array([x, y, z]) - reach
        local = cells[near] - first
        entries.append((first, near[((local >= -1) & (local < NODES)).all(axis=1)], own))
    return entries


def _sampled_kernel(kernel: KernelValue, voxel: float, reach: int) -> Float64:
    axis = np.arange(-reach - 1, reach + 2) * voxel
    distance = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)
    value = kernel(distance)
    inner = slice(1, -1)
    neighbours = (
        *(value[:-2, inner, inner], value[2:, inner, inner], value[inner, :-2, inner]),
        *(value[inner, 2:, inner], value[inner, inner, :-2], value[inner, inner, 2:]),
    )
    sharpened = 2.0 * value[inner, inner, inner] - sum(neighbours) / 6.0
    return np.asarray(np.where(distance[inner, inner, inner] <= reach * voxel, sharpened, 0.0))


def _own_terms(share: Float64, kernel: Float64) -> Float64:
    same = share**2 + (1.0 - share) ** 2  # by axis: share of mass and reading on the same node
    pair = np.stack([same, 1.0 - same])
    return np.asarray(
        sum(pair[x, :, 0] * pair[y, :, 1] * pair[z, :, 2] * kernel[x, y, z] for x, y, z in product((0, 1), repeat=3))
    )


def _transformed_kernel(sampled: Float64) -> NDArray[np.complex128]:
    size = len(sampled)
    padded = np.zeros((NODES,) * 3)
    padded[:size, :size, :size] = sampled
    return np.asarray(rfftn(np.roll(padded, -(size // 2), axis=(0, 1, 2))))


def _corners(cells: Index, share: Float64) -> list[tuple[Index, Float64]]:
    return [
        (cells + np.array(step), np.asarray(np.prod(np.where(step, share, 1.0 - share), axis=1)))
        for step in product((0, 1), repeat=3)
    ]


def _spread(cells: Index, share: Float64) -> Float64:
    mass = np.zeros(NODES**3)
    for node, part in _corners(cells, share):
        is_inside = ((node >= 0) & (node < NODES)).all(axis=1)
        index = np.ravel_multi_index(tuple(node[is_inside].T), (NODES,) * 3)
        mass += np.bincount(index, weights=part[is_inside], minlength=NODES**3)
    return mass.reshape((NODES,) * 3)


def _read(density: Float64, cells: Index, share: Float64) -> Float64:
    return np.asarray(sum(part * density[tuple(node.T)] for node, part in _corners(cells, share)))


BYTES_PER_PAIR = 44  # of the matrix and its pairs; 40 were measured


def solve_process(
    centers: Float64, log_values: Float64, length: float, kernel: KernelValue, noise: float
) -> tuple[Float64, Float64, int, float]:
    """``(K(P, P) + noise I)^-1 y`` (eq. 8, 12) for centres (N, 3) [m], y = exp(log_values) (N,).

    Returns scaled and log_scale (N,) of the solution ``scaled exp(log_scale)``, the iterations, and the largest
    residual. Residuals are relative to their group's largest y.

    The kernel is cut off at 8 l. Each group of centres that it joins is scaled by the group's largest y. Raises
    UsageError for too little memory or too wide a spread of y, NotEvaluableError without convergence.
    """
    matrix = _kernel_matrix(centers, length, kernel, noise)
    num_groups, group = connected_components(matrix, directed=False)
    largest, smallest = np.full(num_groups, -np.inf), np.full(num_groups, np.inf)
    np.maximum.at(largest, group, log_values)
    np.minimum.at(smallest, group, log_values)
    spread = float((largest - smallest).max())
    refuse_if(
        spread > CG_MAX_SPREAD,
        f"field.weights = cg: expected radii that differ by at most {CG_MAX_SPREAD:g} length scales between "
        f"splats within {KERNEL_REACH} of each other, got {spread:.1f}",
        remedy="set a larger field.length_scale, or field.weights = rowsum",
        error=UsageError,
    )
    tolerance = max(CG_TOLERANCE * float(np.exp(-spread)), CG_FLOOR)
    scaled, num_iterations, residual = conjugate_gradients(matrix, np.exp(log_values - largest[group]), tolerance)
    return scaled, largest[group], num_iterations, residual


def conjugate_gradients(matrix: "csr_array", values: Float64, tolerance: float) -> tuple[Float64, int, float]:
    """x (N,) with ``max |A x - y| <= 2 tolerance``, the iterations, and that residual.

    Raises NotEvaluableError if A is not positive definite or after `CG_ITERATIONS`.
    """
    accepted = 2.0 * tolerance  # of the true residual; the recurrence drifts from it
    x = np.zeros(len(values))
    rest = values.copy()
    direction, squared = rest.copy(), float(rest @ rest)
    for iteration in range(CG_ITERATIONS):
        if float(np.abs(rest).max()) <= tolerance:
            rest = values - matrix @ x
            residual = float(np.abs(rest).max())
            if residual <= accepted:
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
    raise _not_solved(
        f"expected a residual of at most {accepted:.1e} after {CG_ITERATIONS} iterations, got {residual:.1e}"
    )


def _not_solved(what: str) -> NotEvaluableError:
    return NotEvaluableError(
        f"field.weights = cg: {what}",
        remedy="set a larger field.noise (1e-2) or a smaller field.length_scale, or field.weights = rowsum",
    )


def _kernel_matrix(centers: Float64, length: float, kernel: KernelValue, noise: float) -> "csr_array":
    tree = cKDTree(centers)
    num_pairs = int(tree.count_neighbors(tree, KERNEL_REACH * length))
    needed, free = BYTES_PER_PAIR * num_pairs, available_memory()
    refuse_if(
        needed > free,
        f"field.weights = cg: {num_pairs} pairs of splats within {KERNEL_REACH} length scales need "
        f"{needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB is free",
        remedy="set a smaller field.length_scale, or field.weights = rowsum",
        error=UsageError,
    )
    pairs = tree.query_pairs(KERNEL_REACH * length, output_type="ndarray").astype(np.int32)
    distance = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
    upper = csr_array((kernel(distance), (pairs[:, 0], pairs[:, 1])), shape=(len(centers), len(centers)))
    return csr_array(upper + upper.T + (1.0 + noise) * eye_array(len(centers), format="csr"))


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """A stationary kernel of the paper, of length scale l [m], with k(0) = 1.

    Matern 1/2: ``k(d) = exp(-d / l)``, ``r(o) = -l log o``. Else Gaussian: ``k(d) = exp(-d^2 / (2 l^2))``, ``r(o) =
    sqrt(-2 l^2 log o)``.
    """

    length: float
    is_matern: bool

    def value(self, distance: Float64) -> Float64:
        """k(d) for distances of any shape [m]."""
        scaled = distance / self.length
        return np.asarray(np.exp(-scaled if self.is_matern else -0.5 * scaled**2))


def share_of_loss(length: float, tolerance: float) -> float:
    """Share of Matern's sum whose loss raises the distance by t [m]: ``1 - exp(-t / l)`` <= 0.01."""
    return min(-float(np.expm1(-tolerance / length)), KERNEL_MAX_SHARE)


def log_row_sums(kernel: Kernel, spheres: Spheres, *, threads: int = 0) -> Float64:
    """``log sum_j k(|p_i - p_j|)`` (N,), j = i included."""
    sums = native.row_sums(
        spheres.clusters, spheres.is_point, kernel.length, is_matern=kernel.is_matern, threads=threads
    )
    return np.asarray(np.log(spheres.gather(sums)))


NO_LOG = -1e4  # for a weight of zero: negligible, and finite


@dataclass(frozen=True, kw_only=True)
class Weights:
    """w (N,) as ``sign exp(log_size)``: the occupancy is ``o(x) = sum_i w_i k_d(-r_i) k(x, p_i)``.

    The Gaussian kernel has no ``k_d(-r_i)``: radii enter by the terms' shares. sign (N,): +-1, None if all are
    positive. num_iterations, residual: None without a solver.
    """

    log_size: Float64
    sign: Float32 | None
    num_iterations: int | None = None
    residual: float | None = None


def row_sum_weights(spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """``w_i = 1 / (noise + sum_j k(p_i, p_j))``, j = i included: the mass-lumped inverse of eq. 15.

    M of eq. 12 is ``w_i k_d(-r_i)``.
    """
    return _lump(log_row_sums(kernel, spheres, threads=threads), noise)


def voxel_weights(spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """`row_sum_weights` from a voxel grid (III-D)."""
    return _lump(np.log(voxel_row_sums(_centers(spheres), kernel.length, kernel.value)), noise)


def process_weights(spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """Solve eq. 8, ``M = (K + noise I)^-1 y``: weights of either sign.

    Matern: y is ``k_d(-r)``, ``w_i = M_i / k_d(-r_i)``. Gaussian: y is 1, ``w = M``.
    """
    log_values = spheres.radii / kernel.length if kernel.is_matern else np.zeros(len(spheres.radii))
    scaled, log_scale, num_iterations, residual = solve_process(
        _centers(spheres), log_values, kernel.length, kernel.value, noise
    )
    is_zero = scaled == 0.0
    size = np.log(np.abs(np.where(is_zero, 1.0, scaled)))
    return Weights(
        log_size=np.where(is_zero, NO_LOG, size + log_scale - log_values),
        sign=np.where(scaled < 0.0, -1.0, 1.0).astype(np.float32),
        num_iterations=num_iterations,
        residual=residual,
    )


Method = Callable[[Spheres, Kernel, float, int], Weights]
METHODS: Mapping[str, Method] = {"rowsum": row_sum_weights, "voxel": voxel_weights, "cg": process_weights}


def _lump(log_sums: Float64, noise: float) -> Weights:
    with np.errstate(divide="ignore"):  # noise 0 gives log 0 = -inf, rightly
        return Weights(log_size=np.asarray(-np.logaddexp(log_sums, np.log(noise))), sign=None)


def _centers(spheres: Spheres) -> Float64:
    return np.stack([spheres.gather(axis.astype(np.float64)) for axis in spheres.clusters.centers], axis=1)
