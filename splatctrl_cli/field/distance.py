"""Distance fields over splats: exact, kernel, and the smaller of the two. Positive outside."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.field.clusters import ClusteredPoints, cluster_points
from splatctrl_cli.field.kernel import kernel_named
from splatctrl_cli.field.weights import row_sum_log_weights
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import DistanceField, Float64


class SphereField:
    """Exact distance to a union of spheres, ``hard(x) = min_i (|x - p_i| - r_i)`` (eq. 6); 1-Lipschitz.

    Exact outside the spheres; inside, minus the depth below the nearest-in-that-sense sphere's surface.
    """

    def __init__(self, centers: ArrayLike, radii: ArrayLike, *, threads: int = 1) -> None:
        """centers (N, 3) [m], world; radii (N,) [m], zero allowed. Raises as `checked_spheres`."""
        center_array, radius_array = checked_spheres(centers, radii)
        self._points = cluster_points(center_array)
        self.anchor = self._points.anchor  # what the float32 coordinates of `spheres` are relative to
        self.spheres = self._points.with_offsets(radius_array)
        self._threads = threads

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """points (Q, 3) [m] -> distance (Q,) [m] and the gradient (Q, 3) of the nearest (zero at its centre)."""
        score, gradient = native.nearest(self.spheres, _local(self._points, points), threads=self._threads)
        return score.astype(np.float64), gradient.astype(np.float64)


class GpdfField:
    """The paper's field (eq. 7 to 10, 12, 15): mass-lumped GP with a Matern-1/2 kernel, in the log domain.

    ``f(x) = -l log sum_i w_i exp((r_i - |x - p_i|) / l)``, radius and weight in the exponent, shifted by the largest
    exponent: finite for every l, which eq. 12 as printed (shift by the nearest centre) is not.
    """

    def __init__(
        self,
        centers: ArrayLike,
        radii: ArrayLike,
        length_scale: float = FieldConfig.length_scale,
        *,
        noise: float = FieldConfig.noise,
        truncation: float = FieldConfig.truncation,
        kernel: str = FieldConfig.kernel,
        threads: int = 1,
    ) -> None:
        """centers (N, 3) [m], world; radii (N,) [m]; length_scale l [m]. Raises as `checked_spheres`."""
        center_array, radius_array = checked_spheres(centers, radii)
        self._points = cluster_points(center_array)
        self.kernel = kernel_named(kernel, length_scale, truncation)
        self.log_weights = row_sum_log_weights(self._points, self.kernel, noise, threads=threads)
        self.offsets = self.kernel.offsets(radius_array, self.log_weights)
        # Float32 keeps what is left of the offsets to the micrometre: the largest goes in at the end, in float64.
        self.common_offset = float(self.offsets.max())
        self.spheres = self._points.with_offsets(self.offsets - self.common_offset)
        self._threads = threads

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """points (Q, 3) [m] -> distance (Q,) [m] and its gradient (Q, 3), of length at most 1, not normalised.

        ``grad f = sum_i pi_i (x - p_i) / |x - p_i|`` with pi the softmax of the exponents. (Eq. 11 as printed is
        minus this, made a unit vector; `normalised` gives the unit vector.)
        """
        local = _local(self._points, points)
        score, gradient = native.soft_min(
            self.spheres, self.kernel.length, self.kernel.truncation, local, threads=self._threads
        )
        return score.astype(np.float64) - self.common_offset, gradient.astype(np.float64)


class SafeField:
    """The smallest of several fields, with the gradient of whichever it is.

    Row-sum lumping over-estimates the clearance to a sparse object before a dense one; with the exact distance beside
    it, the result never exceeds the distance to the spheres.
    """

    def __init__(self, *fields: DistanceField) -> None:
        self._fields = fields

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """points (Q, 3) [m] -> the least distance (Q,) [m] and its gradient (Q, 3); the first wins a tie."""
        distance, gradient = self._fields[0].query(points)
        for field in self._fields[1:]:
            other, other_gradient = field.query(points)
            is_less = other < distance
            distance = np.where(is_less, other, distance)
            gradient = np.where(is_less[:, None], other_gradient, gradient)
        return distance, gradient


def safe_field(centers: ArrayLike, radii: ArrayLike, config: FieldConfig, *, threads: int = 1) -> SafeField:
    """``min(hard, gpdf)`` over splats: the analytic field that a controller uses."""
    gpdf = GpdfField(
        centers,
        radii,
        config.length_scale,
        noise=config.noise,
        truncation=config.truncation,
        kernel=config.kernel,
        threads=threads,
    )
    return SafeField(SphereField(centers, radii, threads=threads), gpdf)


def normalised(gradient: Float64) -> Float64:
    """Unit vectors along gradients (Q, 3), eq. 11 with its sign mended; zero where the gradient is zero."""
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.asarray(np.divide(gradient, length, out=np.zeros_like(gradient), where=length > 0))


def checked_spheres(centers: ArrayLike, radii: ArrayLike) -> tuple[Float64, Float64]:
    """centers (N, 3) and radii (N,) as float64.

    Raises NotEvaluableError where there is none, InputError for a wrong shape, a value that is not finite (naming the
    index), or a negative radius.
    """
    center_array, radius_array = np.asarray(centers, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    if center_array.ndim != 2 or center_array.shape[1] != 3 or radius_array.shape != center_array.shape[:1]:
        raise InputError(
            f"splats: expected centres (N, 3) and radii (N,), got {center_array.shape}, {radius_array.shape}"
        )
    if not len(center_array):
        raise NotEvaluableError("splats: expected at least one to measure distances to, got none")
    for name, is_bad in (
        ("a finite centre", ~np.isfinite(center_array).all(axis=1)),
        ("a finite radius of 0 m or more", ~(np.isfinite(radius_array) & (radius_array >= 0))),
    ):
        if is_bad.any():
            i = int(np.argmax(is_bad))
            got = center_array[i].tolist() if "centre" in name else radius_array[i]
            raise InputError(
                f"splat {i}: expected {name}, got {got}", remedy=f"{int(is_bad.sum())} such splats in all"
            )
    return center_array, radius_array


def checked_points(points: NDArray[np.floating]) -> Float64:
    """Query points (Q, 3) as float64. Raises InputError for another shape or a value that is not finite."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"query points: expected shape (Q, 3), got {array.shape}")
    if not np.isfinite(array).all():
        i = int(np.argmax(~np.isfinite(array).all(axis=1)))
        raise InputError(f"query point {i}: expected finite coordinates, got {array[i].tolist()}")
    return array


def _local(points: ClusteredPoints, queries: NDArray[np.floating]) -> NDArray[np.float32]:
    return points.relative(checked_points(queries))
