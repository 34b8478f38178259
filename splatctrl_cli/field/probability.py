"""Probability of collision: the paper's, or calibrated by a measured error (III-D)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from splatctrl_cli.config import FieldConfig, fixed
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.field.clusters import Spheres, checked_points
from splatctrl_cli.field.distance import GpdfField
from splatctrl_cli.field.weights import share_of_loss
from splatctrl_cli.kernels import field as native
from splatctrl_cli.kernels.field import GridSpan
from splatctrl_cli.records import Float32, Float64


@dataclass(frozen=True, kw_only=True)
class CalibratedProbability:
    """``Phi((mean - clearance) / sigma)``, with the field's measured error [m].

    mean: its average excess; sigma: the standard deviation.
    """

    sigma: float
    mean: float = 0.0

    def of(self, clearance: Float64) -> Float64:
        """Probability of clearances [m], any shape."""
        return np.asarray(ndtr((self.mean - clearance) / self.sigma))

    def at(self, points: Float64, sdf: Float64) -> Float64:
        """Probability (Q,) at points (Q, 3) [m]; sdf (Q,): chosen distance [m]."""
        return self.of(sdf)

    def baked(self, span: GridSpan, sdf: Float32, *, threads: int) -> Float32:
        """Probability (X, Y, Z) at the cells of `span`; sdf: chosen distance [m]."""
        return self.of(sdf.astype(np.float64)).astype(np.float32)

    def described(self) -> dict[str, object]:
        """The meaning and numbers, for a header."""
        return {"meaning": "Phi((mean - sdf) / sigma)", "sigma": self.sigma, "mean": self.mean}


class PaperProbability:
    """Eq. 13 and 14 with the Matern kernel and lumped weights: only a score (docs/field.md).

    ``P(o >= 1 | o > 0) = Phi((o - 1) / s) / Phi(o / s)``, o of `GpdfField`, ``s^2 = (1 - sum_i w_i k(x, p_i)^2) /
    9``.
    """

    def __init__(self, spheres: Spheres, config: FieldConfig, *, threads: int = 1) -> None:
        """Raises UsageError for weights cg: eq. 13 would need a solution per point."""
        refuse_if(
            config.weights == "cg",
            "field.probability = paper: expected field.weights = rowsum or voxel, got cg",
            remedy="set field.probability = calibrated, or other weights",
            error=UsageError,
        )
        self._gpdf = GpdfField(spheres, config, threads=threads)
        # k^2 is a Matern kernel too, of half the length: sum_i w_i k^2 = exp(-2 g / l), g the field of that kernel.
        self._half = 0.5 * self._gpdf.kernel.length
        self._share = share_of_loss(self._half, 0.5 * config.truncation)
        self._offsets = self._half * self._gpdf.weights.log_size
        self._threads = threads

    def at(self, points: Float64, sdf: Float64) -> Float64:
        """Probability (Q,) at points (Q, 3) [m], whatever the sdf."""
        places = self._gpdf.spheres
        half, _ = native.matern(
            places.clusters,
            places.offsets(self._offsets),
            None,
            self._half,
            self._share,
            places.relative(checked_points(points)),
            threads=self._threads,
        )
        return self._combine(self._gpdf.query_raw(points)[0], half.astype(np.float64))

    def baked(self, span: GridSpan, sdf: Float32, *, threads: int) -> Float32:
        """Probability (X, Y, Z), whatever the sdf."""
        places = self._gpdf.spheres
        gpdf, half = np.zeros_like(sdf), np.zeros_like(sdf)
        self._gpdf.bake_raw(span, gpdf, None, threads=threads)
        terms = replace(
            self._gpdf.terms(),
            offsets=places.offsets(self._offsets),
            exact=places.lay_out(self._offsets, spare=native.SPARE_OFFSET),
            sign=None,
            length=self._half,
            tolerance=self._share,
        )
        native.bake_kernel(places.clusters, terms, span, half, threads=threads)
        return self._combine(gpdf.astype(np.float64), half.astype(np.float64)).astype(np.float32)

    def described(self) -> dict[str, object]:
        return {"meaning": "eq. 13 and 14 with lumped weights: a score", "variance_divisor": fixed.VARIANCE_DIVISOR}

    def _combine(self, gpdf: Float64, half: Float64) -> Float64:
        explained = np.exp(np.minimum(-half / self._half, 0.0))  # the sum never exceeds 1 but by rounding
        occupancy = np.exp(np.minimum(-gpdf / self._gpdf.kernel.length, fixed.CERTAIN_OCCUPANCY))
        return probability_of_occupancy(occupancy, explained)


def probability_of_occupancy(occupancy: Float64, explained: Float64) -> Float64:
    """Eq. 14 of an occupancy o > 0 with variance ``(1 - explained) / 9``.

    In logarithms. Far away it is ``Phi(-3) / Phi(0) = 0.0027``, not zero.
    """
    deviation = np.sqrt(np.maximum(1.0 - explained, fixed.LEAST_VARIANCE) / fixed.VARIANCE_DIVISOR)
    return np.asarray(np.exp(log_ndtr((occupancy - 1.0) / deviation) - log_ndtr(occupancy / deviation)))


CollisionProbability = CalibratedProbability | PaperProbability
_Make = Callable[[Spheres, FieldConfig, int], CollisionProbability]
PROBABILITIES: Mapping[str, _Make] = {  # by `config.probability`
    "calibrated": lambda spheres, config, threads: CalibratedProbability(sigma=config.error, mean=config.error_mean),
    "paper": lambda spheres, config, threads: PaperProbability(spheres, config, threads=threads),
}


def probabilities(spheres: Spheres, config: FieldConfig, *, threads: int = 1) -> dict[str, CollisionProbability]:
    """Make all forms for these weights; the paper's variance does not hold for cg."""
    names = [name for name in PROBABILITIES if name != "paper" or config.weights != "cg"]
    return {name: PROBABILITIES[name](spheres, config, threads) for name in names}
