"""The splats of a field as spheres: checked, clustered once, shared by every distance made of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.field.clusters import ClusteredPoints, cluster_points
from splatctrl_cli.records import Box, Float64


@dataclass(frozen=True, kw_only=True)
class Spheres:
    """N spheres; points: their centres, clustered; radii (N,) [m]."""

    points: ClusteredPoints
    radii: Float64

    @classmethod
    def of(cls, centers: ArrayLike, radii: ArrayLike, frame: Box | None = None) -> "Spheres":
        """centers (N, 3) [m], world; radii (N,) [m], zero allowed; frame as in `cluster_points`.

        Raises NotEvaluableError where there is none, InputError for a wrong shape, a value that is not finite (naming
        the index), or a negative radius.
        """
        center_array, radius_array = _checked(centers, radii)
        return cls(points=cluster_points(center_array, frame), radii=radius_array)


def checked_points(points: NDArray[np.floating]) -> Float64:
    """Query points (Q, 3) as float64. Raises InputError for another shape or a value that is not finite."""
    array = shaped_points(points)
    if not np.isfinite(array).all():
        raise not_finite(array)
    return array


def shaped_points(points: NDArray[np.floating]) -> Float64:
    """Query points (Q, 3) as float64. Raises InputError for another shape."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"query points: expected shape (Q, 3), got {array.shape}")
    return array


def not_finite(points: Float64) -> InputError:
    """The error that names the first of the points (Q, 3) that is not finite."""
    i = int(np.argmax(~np.isfinite(points).all(axis=1)))
    return InputError(f"query point {i}: expected finite coordinates, got {points[i].tolist()}")


def _checked(centers: ArrayLike, radii: ArrayLike) -> tuple[Float64, Float64]:
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
