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
