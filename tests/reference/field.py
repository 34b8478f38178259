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


def gpdf_as_printed(points: Array, centers: Array, radii: Array, length: float, noise: float) -> Array:
    """Eq. 7 to 9 with eq. 15 as printed: no log domain, finite only where nothing under- or overflows."""
    occupancy = np.exp(-distances(points, centers) / length) @ (
        np.exp(radii / length) / (noise + row_sums(centers, length))
    )
    return -length * np.log(occupancy)
