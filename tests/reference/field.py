"""The distance field of the paper (III-D), one float64 function per equation, literal but for the log domain."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def distances(points: Array, centers: Array) -> Array:
    """d(x, p), (Q, N)."""
    return np.linalg.norm(points[:, None, :] - centers[None, :, :], axis=2)


def hard(points: Array, centers: Array, radii: Array) -> Array:
    """Eq. 6: ``min_i |x - p_i| - r_i``."""
    return np.min(distances(points, centers) - radii, axis=1)


def row_sums(centers: Array, length: float) -> Array:
    """The diagonal of eq. 15: ``sum_j exp(-|p_i - p_j| / l)``."""
    return np.exp(-distances(centers, centers) / length).sum(axis=1)


def exponents(points: Array, centers: Array, radii: Array, length: float, noise: float) -> Array:
    """``(r_i - |x - p_i|) / l + log w_i`` with ``w_i = 1 / (noise + row sum)``, (Q, N)."""
    return (radii - distances(points, centers)) / length - np.log(noise + row_sums(centers, length))


def gpdf(points: Array, centers: Array, radii: Array, length: float, noise: float) -> Array:
    """Eq. 7 to 9 with eq. 15, shifted by the largest exponent."""
    exponent = exponents(points, centers, radii, length, noise)
    largest = exponent.max(axis=1)
    return -length * (largest + np.log(np.exp(exponent - largest[:, None]).sum(axis=1)))


def gpdf_gradient(points: Array, centers: Array, radii: Array, length: float, noise: float) -> Array:
    """Eq. 10: the gradient of `gpdf`, a mean of unit vectors away from the splats, weighted by their exponents."""
    exponent = exponents(points, centers, radii, length, noise)
    weight = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    away = points[:, None, :] - centers[None, :, :]
    return np.einsum("qn,qna->qa", weight / distances(points, centers), away)


def se(points: Array, centers: Array, radii: Array, length: float, noise: float) -> tuple[Array, Array]:
    """The Gaussian kernel of III-D in the log domain with the mean radius, and its gradient; NaN where L >= 0."""
    away = points[:, None, :] - centers[None, :, :]
    sums = np.exp(-(distances(centers, centers) ** 2) / (2 * length**2)).sum(axis=1)
    exponent = -(distances(points, centers) ** 2) / (2 * length**2) - np.log(noise + sums)
    largest = exponent.max(axis=1, keepdims=True)
    share = np.exp(exponent - largest)
    squared = -2 * length**2 * (largest[:, 0] + np.log(share.sum(axis=1)))
    share /= share.sum(axis=1, keepdims=True)
    root = np.sqrt(np.where(squared > 0, squared, np.nan))
    radius = share @ radii
    mean = np.einsum("qn,qna->qa", share, away)
    turn = np.einsum("qn,qna->qa", share * (radii - radius[:, None]), away) / length**2
    return root - radius, mean / root[:, None] + turn


def gpdf_as_printed(points: Array, centers: Array, radii: Array, length: float, noise: float) -> Array:
    """Eq. 7 to 9 with eq. 15 as printed: no log domain, finite only where nothing under- or overflows."""
    occupancy = np.exp(-distances(points, centers) / length) @ (
        np.exp(radii / length) / (noise + row_sums(centers, length))
    )
    return -length * np.log(occupancy)


def voxel_row_sums(centers: Array, length: float, voxel: float) -> Array:
    """III-D's density of a Matern kernel: trilinear spreading, convolution, trilinear reading, own term k(0) = 1.

    The nodes are convolved with ``2 k - (mean of k at the six neighbours)``; of every pair of splats.
    """
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
    nodes = (centers - centers.min(axis=0)) / voxel
    cells = np.floor(nodes)
    share = np.prod(np.where(corners, (nodes - cells)[:, None], 1 - (nodes - cells)[:, None]), axis=2)  # (N, 8)
    places = voxel * (cells[:, None] + corners)  # (N, 8, 3)
    away = places[:, None, :, None] - places[None, :, None, :]  # (N, N, 8, 8, 3)

    def kernel(step: tuple[int, int, int]) -> Array:
        return np.exp(-np.linalg.norm(away + voxel * np.array(step), axis=-1) / length)

    steps = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    sharpened = 2 * kernel((0, 0, 0)) - sum(kernel(step) for step in steps) / 6
    density = np.einsum("iu,jv,ijuv->ij", share, share, sharpened)
    np.fill_diagonal(density, 1.0)
    return density.sum(axis=1)


def process_weights(kernel: Array, values: Array, noise: float) -> Array:
    """Eq. 12: ``M = (K(P, P) + noise I)^-1 y`` of the full Gaussian process."""
    return np.linalg.solve(kernel + noise * np.eye(len(values)), values)


def process_gpdf(points: Array, centers: Array, radii: Array, length: float, noise: float) -> Array:
    """Eq. 7 to 9 of the full Gaussian process with the Matern kernel; NaN where the occupancy is not positive."""
    kernel = np.exp(-distances(centers, centers) / length)
    weights = process_weights(kernel, np.exp((radii - radii.max()) / length), noise)
    occupancy = np.exp(-distances(points, centers) / length) @ weights
    return -length * np.log(np.where(occupancy > 0, occupancy, np.nan)) - radii.max()


def process_se(points: Array, centers: Array, radii: Array, length: float, noise: float) -> Array:
    """The full Gaussian process with the Gaussian kernel and y = 1, less the mean radius; NaN without a value.

    A mean that is larger than every radius tells of terms that all but cancel: no value either.
    """
    squared = distances(points, centers) ** 2
    kernel = np.exp(-(distances(centers, centers) ** 2) / (2 * length**2))
    terms = process_weights(kernel, np.ones(len(radii)), noise) * np.exp(-squared / (2 * length**2))
    occupancy = terms.sum(axis=1)
    log = np.log(np.where((occupancy > 0) & (occupancy < 1), occupancy, np.nan))
    mean = (terms @ radii) / occupancy
    return np.where(np.abs(mean) <= radii.max(), np.sqrt(-2 * length**2 * log) - mean, np.nan)


def explained(points: Array, centers: Array, length: float, noise: float) -> Array:
    """What eq. 13 takes off k(x, x), lumped by eq. 15: ``sum_i w_i k(x, p_i)^2``."""
    return np.exp(-2 * distances(points, centers) / length) @ (1 / (noise + row_sums(centers, length)))


def collision_probability(occupancy: Array, variance: Array) -> Array:
    """Eq. 14 as printed, the variance divided by 9."""
    from math import erf

    def phi(values: Array) -> Array:
        return np.array([0.5 * (1 + erf(value / np.sqrt(2))) for value in values])

    deviation = np.sqrt(variance / 9)
    return (1 - phi((1 - occupancy) / deviation)) / (1 - phi(-occupancy / deviation))


def march(
    points: Array, centers: Array, radii: Array, length: float, noise: float, steps: int
) -> tuple[Array, Array]:
    """III-D's sphere marching on `gpdf`, one point and one step after the other: distance and point reached."""
    results = []
    for start in points:
        place, walked = start[None], 0.0
        for _ in range(steps):
            here = gpdf(place, centers, radii, length, noise)[0]
            step = max(min(here, hard(place, centers, radii)[0]), 0.0)
            slope = gpdf_gradient(place, centers, radii, length, noise)
            place, walked = place - step * slope / np.linalg.norm(slope), walked + step
        results.append((walked + gpdf(place, centers, radii, length, noise)[0], place[0]))
    return np.array([walked for walked, _ in results]), np.array([place for _, place in results])
