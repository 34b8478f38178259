"""The paper's linear-time density: row sums of a kernel by trilinear interpolation on a voxel grid (III-D)."""

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfftn, rfftn

from splatctrl_cli.config.fixed import KERNEL_REACH, VOXELS_PER_LENGTH
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Float64, Index

NODES = 96  # of a block along each axis: a size that transforms fast, 7 MiB
MAX_BLOCKS = 2000

KernelValue = Callable[[Float64], Float64]


def voxel_row_sums(centers: Float64, length: float, kernel: KernelValue) -> Float64:
    """``sum_j k(|p_i - p_j|)`` (N,) of centres (N, 3) [m], j = i included, in time linear in N.

    Each centre is one unit spread over the eight nodes around it (trilinear), the nodes are convolved with the
    kernel, and each centre reads the result back from its eight nodes. What that makes of a centre's own term is
    known, and replaced by k(0) = 1. Spreading and reading back blur the kernel by a third of h^2 along each axis: the
    nodes are convolved with ``2 k - (mean of k at the six neighbours)``, which undoes that to second order in h.

    The grid is made in blocks of `NODES`, those alone in which two centres can meet. Raises UsageError for more than
    `MAX_BLOCKS` of them.
    """
    voxel, reach = length / VOXELS_PER_LENGTH, KERNEL_REACH * VOXELS_PER_LENGTH
    nodes = (centers - centers.min(axis=0)) / voxel
    cells = np.floor(nodes).astype(np.int64)
    share = nodes - cells
    sampled = _sampled_kernel(kernel, voxel, reach)
    result = 1.0 - _own_terms(share, sampled[reach:, reach:, reach:])
    meetings = [block for block in _blocks(cells, reach) if len(block[1]) > 1]
    if len(meetings) > MAX_BLOCKS:
        raise UsageError(
            f"field.weights = voxel: expected at most {MAX_BLOCKS} blocks of voxels with splats, got {len(meetings)}",
            remedy="set field.weights = rowsum, which is fast on splats this far apart, or a larger length scale",
        )
    transformed = _transformed_kernel(sampled)
    alone = np.ones(len(centers), np.bool_)
    for first, near, own in meetings:
        density = _convolved(_spread(cells[near] - first, share[near]), transformed)
        result[own] += _read(density, cells[own] - first, share[own])
        alone[own] = False
    result[alone] = 1.0
    return result


def _blocks(cells: Index, reach: int) -> list[tuple[Index, Index, Index]]:
    """First node (3,) of each block, the centres that can reach its inner cells, and the centres in those."""
    inner = NODES - 2 * reach - 1  # the cells whose eight nodes no mass from beyond the block reaches
    blocks, which = np.unique(cells // inner, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    bounds = np.searchsorted(which.ravel()[order], np.arange(len(blocks) + 1))
    members = {(x, y, z): order[bounds[b] : bounds[b + 1]] for b, (x, y, z) in enumerate(blocks.tolist())}
    steps = list(product((-1, 0, 1), repeat=3))
    found = []
    for (x, y, z), own in members.items():
        around = [members.get((x + i, y + j, z + k)) for i, j, k in steps]
        near = np.concatenate([some for some in around if some is not None])
        first = inner * np.array([x, y, z]) - reach
        local = cells[near] - first
        found.append((first, near[((local >= -1) & (local < NODES)).all(axis=1)], own))
    return found


def _sampled_kernel(kernel: KernelValue, voxel: float, reach: int) -> Float64:
    """The sharpened kernel (2 reach + 1,) * 3 between nodes, zero beyond `reach` nodes."""
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
    """What each centre (N,) reads back of itself: the kernel between its nodes, by the products of their shares."""
    same = share**2 + (1.0 - share) ** 2  # of an axis, that the mass and the reading fall on the same node
    pair = np.stack([same, 1.0 - same])
    return np.asarray(
        sum(pair[x, :, 0] * pair[y, :, 1] * pair[z, :, 2] * kernel[x, y, z] for x, y, z in product((0, 1), repeat=3))
    )


def _transformed_kernel(sampled: Float64) -> NDArray[np.complex128]:
    size = len(sampled)
    padded = np.zeros((NODES,) * 3)
    padded[:size, :size, :size] = sampled
    return np.asarray(rfftn(np.roll(padded, -(size // 2), axis=(0, 1, 2))))


def _convolved(mass: Float64, transformed: NDArray[np.complex128]) -> Float64:
    """The circular convolution: what wraps around stays within `reach` of the block's faces."""
    return np.asarray(irfftn(rfftn(mass) * transformed, s=mass.shape))


def _corners(cells: Index, share: Float64) -> list[tuple[Index, Float64]]:
    """Of the eight nodes around each centre: the index (N, 3), and the centre's share of it (N,)."""
    return [
        (cells + np.array(step), np.asarray(np.prod(np.where(step, share, 1.0 - share), axis=1)))
        for step in product((0, 1), repeat=3)
    ]


def _spread(cells: Index, share: Float64) -> Float64:
    """Units spread over the nodes of a block (NODES,) * 3; what falls beyond it is left out."""
    mass = np.zeros(NODES**3)
    for node, part in _corners(cells, share):
        is_inside = ((node >= 0) & (node < NODES)).all(axis=1)
        index = np.ravel_multi_index(tuple(node[is_inside].T), (NODES,) * 3)
        mass += np.bincount(index, weights=part[is_inside], minlength=NODES**3)
    return mass.reshape((NODES,) * 3)


def _read(density: Float64, cells: Index, share: Float64) -> Float64:
    """The density (N,) at the centres."""
    return np.asarray(sum(part * density[tuple(node.T)] for node, part in _corners(cells, share)))
