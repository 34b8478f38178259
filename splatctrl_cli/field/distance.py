"""Distance fields over splats, on the processor or a card, and the probability of collision (III-D).

Distances are positive outside.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import log_ndtr, ndtr

from splatctrl_cli.config import FieldConfig, fixed
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.field.clusters import Spheres, checked_points, not_finite, shaped_points
from splatctrl_cli.field.grid_cells import RESOLUTION
from splatctrl_cli.field.weights import METHODS, Kernel, share_of_loss
from splatctrl_cli.kernels import field as native
from splatctrl_cli.kernels.cuda.field import Answers, Choice, DeviceField
from splatctrl_cli.kernels.cuda.memory import Memory
from splatctrl_cli.kernels.field import GridSpan, LogSumExp
from splatctrl_cli.records import DistanceField, Float32, Float64, Index

DEFAULT = FieldConfig()


class SphereField:
    """Exact distance to a union of spheres, ``min_i (|x - p_i| - r_i)`` (eq. 6); 1-Lipschitz.

    Inside: minus the depth in the deepest sphere.
    """

    def __init__(self, spheres: Spheres, *, threads: int = 1) -> None:
        self.spheres, self._threads = spheres, threads
        self.radii = spheres.offsets(spheres.radii)

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance and gradient, as in `DistanceField.query`; zero gradient at a centre."""
        local = self.spheres.relative(checked_points(points))
        score, gradient, _ = native.nearest(self.spheres.clusters, self.radii, local, threads=self._threads)
        return score.astype(np.float64), gradient.astype(np.float64)

    def nearest(self, points: Float64) -> Index:
        """Index (Q,) of the sphere that gives the distance at points (Q, 3) [m]."""
        local = self.spheres.relative(checked_points(points))
        return self.spheres.source[native.nearest(self.spheres.clusters, self.radii, local, threads=self._threads)[2]]


class LogSumExpField(ABC):
    """A log-sum-exp over splats, of a kernel and weights."""

    is_matern: ClassVar[bool]

    def __init__(self, spheres: Spheres, config: FieldConfig = DEFAULT, *, threads: int = 1) -> None:
        self.spheres, self._threads = spheres, threads
        self.kernel = Kernel(length=config.length_scale, is_matern=self.is_matern)
        self.weights = METHODS[config.weights](spheres, self.kernel, config.noise, threads)
        sign = self.weights.sign
        self.sign = None if sign is None else spheres.lay_out(sign, spare=1.0).astype(np.float32)
        self.tolerance = config.truncation * (1.0 if sign is None else fixed.SIGNED_CARE)

    @abstractmethod
    def terms(self) -> LogSumExp:
        """The terms, laid out for the kernels."""

    @abstractmethod
    def query_raw(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance (Q,) [m] and gradient (Q, 3) at points (Q, 3) [m]; NaN if undefined."""

    def bake_raw(self, span: GridSpan, distance: Float32, gradient: Float32 | None, *, threads: int) -> None:
        """Write `query_raw` at the cells of `span`, (X, Y, Z) and (X, Y, Z, 3)."""
        native.bake_kernel(self.spheres.clusters, self.terms(), span, distance, gradient, threads=threads)

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance and gradient as in `query_raw`, or of the exact field where undefined."""
        distance, gradient = self.query_raw(points)
        has_none = np.isnan(distance)
        if has_none.any():
            exact = SphereField(self.spheres)
            distance[has_none], gradient[has_none] = exact.query(np.asarray(points, dtype=np.float64)[has_none])
        return distance, gradient


class GpdfField(LogSumExpField):
    """The paper's field (eq. 7 to 10, 12, 15): a GP with a Matern-1/2 kernel, in the log domain.

    ``f(x) = -l log sum_i w_i exp((r_i - |x - p_i|) / l)``, shifted by the largest exponent, is finite for every l and
    mix of radii. (Eq. 12 as printed overflows for r / l > 88 in float32.) It is undefined where signed weights (cg)
    give no positive sum.
    """

    is_matern = True

    def __init__(self, spheres: Spheres, config: FieldConfig = DEFAULT, *, threads: int = 1) -> None:
        super().__init__(spheres, config, threads=threads)
        self.share = share_of_loss(self.kernel.length, self.tolerance)
        self.offsets = spheres.radii + self.kernel.length * self.weights.log_size
        # Float32 keeps the differences to the micrometre: the largest offset is added at the end, in float64.
        self._common = float(self.offsets.max())
        self._offsets = spheres.offsets(self.offsets - self._common)

    def query_raw(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance (Q,) [m] and gradient (Q, 3) at points (Q, 3) [m]; NaN if undefined.

        ``grad f = sum_i pi_i (x - p_i) / |x - p_i|``, pi the terms' shares. Eq. 11 as printed is minus this gradient,
        normalised (`normalise`).
        """
        score, gradient = native.matern(
            self.spheres.clusters,
            self._offsets,
            self.sign,
            self.kernel.length,
            self.share,
            self.spheres.relative(checked_points(points)),
            threads=self._threads,
        )
        return score.astype(np.float64) - self._common, gradient.astype(np.float64)

    def terms(self) -> LogSumExp:
        return LogSumExp(
            is_matern=True,
            offsets=self.spheres.offsets(self.offsets),
            exact=self.spheres.lay_out(self.offsets, spare=native.SPARE_OFFSET),
            radii=self.spheres.lay_out(self.spheres.radii, spare=0.0).astype(np.float32),
            sign=self.sign,
            length=self.kernel.length,
            tolerance=self.share,
        )


class SeField(LogSumExpField):
    """The paper's Gaussian kernel in the log domain, with radii, unbiased over a plane.

    ``f(x) = sqrt(-2 l^2 L) - sum_i pi_i r_i`` with ``L = log sum_i w_i exp(-|x - p_i|^2 / (2 l^2))``, pi the terms'
    shares. (As printed, ``k_d(-r) = k_d(r)`` loses the radius's sign.) It is undefined where L >= 0, near and inside
    the surface.
    """

    is_matern = False

    def __init__(self, spheres: Spheres, config: FieldConfig = DEFAULT, *, threads: int = 1) -> None:
        super().__init__(spheres, config, threads=threads)
        self.unit = 2.0 * self.kernel.length**2
        log_size = self.weights.log_size
        self._common = self.unit * float(log_size.max())
        self._offsets = spheres.offsets(self.unit * log_size - self._common)
        self.radii = spheres.offsets(spheres.radii, spare=0.0)

    def query_raw(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance (Q,) [m] and gradient (Q, 3), not normalised, at points (Q, 3) [m]; NaN where L >= 0."""
        score, gradient = native.gaussian(
            self.spheres.clusters,
            self._offsets,
            self.radii.values,
            self.sign,
            self._common,
            self.kernel.length,
            self.tolerance,
            self.spheres.relative(checked_points(points)),
            threads=self._threads,
        )
        return score.astype(np.float64), gradient.astype(np.float64)

    def query_safe(self, points: Float64) -> tuple[Float64, Float64]:
        """Return what `SafeField` returns, in one walk."""
        shaped = shaped_points(points)
        answer = native.safe(
            self.spheres.clusters,
            self._offsets,
            self.radii,
            self.sign,
            self._common,
            self.kernel.length,
            self.tolerance,
            self.spheres.anchor,
            shaped,
            threads=self._threads,
        )
        if answer is None:
            raise not_finite(shaped)
        return answer

    def terms(self) -> LogSumExp:
        log_size = self.weights.log_size
        return LogSumExp(
            is_matern=False,
            offsets=self.spheres.offsets(self.unit * log_size),
            exact=self.spheres.lay_out(log_size, spare=native.SPARE_OFFSET),
            radii=self.radii.values,
            sign=self.sign,
            length=self.kernel.length,
            tolerance=self.tolerance,
        )


class SafeField:
    """The smaller of the exact distance and a kernel field, where the latter is defined.

    Row-sum lumping over-estimates the clearance to a sparse object before a dense one.
    """

    def __init__(self, exact: DistanceField, kernel: LogSumExpField) -> None:
        self._exact, self._kernel = exact, kernel
        are_of_one = isinstance(exact, SphereField) and exact.spheres is kernel.spheres
        self._both = kernel if isinstance(kernel, SeField) and are_of_one else None

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance and gradient, as in `DistanceField.query`; exact in ties."""
        if self._both is not None:
            return self._both.query_safe(points)
        distance, gradient = self._exact.query(points)
        smooth, smooth_gradient = self._kernel.query_raw(points)
        is_less = smooth < distance  # False for NaN
        return np.where(is_less, smooth, distance), np.where(is_less[:, None], smooth_gradient, gradient)


def normalise(gradient: Float64) -> Float64:
    """Unit gradients (Q, 3), eq. 11 with its sign corrected; 0 stays 0."""
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.asarray(np.divide(gradient, length, out=np.zeros_like(gradient), where=length > 0))


KERNEL_OF = {"safe": "se", "safe_gpdf": "gpdf", "hard": None, "se": "se", "gpdf": "gpdf"}  # of `config.distance`
KERNELS: Mapping[str, type[LogSumExpField]] = {"se": SeField, "gpdf": GpdfField}


def field_over(spheres: Spheres, config: FieldConfig, *, threads: int = 1) -> DistanceField:
    """Make the field that ``config.distance`` names."""
    name = KERNEL_OF[config.distance]
    if name is None:
        return SphereField(spheres, threads=threads)
    kernel = KERNELS[name](spheres, config, threads=threads)
    return kernel if config.distance == name else SafeField(SphereField(spheres, threads=threads), kernel)


def march(
    field: DistanceField, exact: DistanceField, points: Float64, *, steps: int = fixed.MARCH_STEPS
) -> tuple[Float64, Float64, Float64]:
    """Walk from points (Q, 3) [m], world, to the zero level of `field`.

    Returns points reached (Q, 3) [m], the field there (Q,) [m], and that field plus the length walked (Q,) [m]. Each
    of the `steps` goes against the gradient, by the field but at most the `exact` distance, so it crosses no sphere.
    Points at or behind the zero level stay; Matern's lies before the spheres (`slabs.planar_zero_level`). Raises
    UsageError for less than one step.
    """
    refuse_if(steps < 1, f"marching: expected at least 1 step, got {steps}", error=UsageError)
    hit = np.array(points, dtype=np.float64)
    walked = np.zeros(len(hit))
    rest, gradient = field.query(hit)
    for _ in range(steps):
        length = np.clip(np.minimum(rest, exact.query(hit)[0]), 0.0, None)
        direction = normalise(gradient)
        hit -= length[:, None] * direction
        walked += np.where(direction.any(axis=1), length, 0.0)  # without a slope there is nowhere to go
        rest, gradient = field.query(hit)
    return hit, rest, walked + rest


class OnDevice:
    """The field that ``config.distance`` names, on a device."""

    def __init__(self, spheres: Spheres, config: FieldConfig, device: Memory, *, threads: int = 1) -> None:
        """The processor makes the weights. Raises OutOfMemory."""
        self.spheres, kernel = spheres, KERNEL_OF[config.distance]
        kernels = {} if kernel is None else {kernel: KERNELS[kernel](spheres, config, threads=threads)}
        self.field = device_field(spheres, kernels, config, device)

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance and gradient, as in `DistanceField.query`."""
        if not len(points):
            return np.zeros(0), np.zeros((0, 3))
        answer = self._answer(points, "gradient")
        assert answer.gradient is not None
        return answer.distance.astype(np.float64), answer.gradient.astype(np.float64)

    def distance(self, points: Float64) -> Float64:
        return self._answer(points).distance.astype(np.float64) if len(points) else np.zeros(0)

    def nearest(self, points: Float64) -> Index:
        """Index (Q,) of the sphere that gives the exact distance at points (Q, 3) [m]."""
        if not len(points):
            return np.zeros(0, np.int64)
        answer = self._answer(points, "entry")
        assert answer.entry is not None
        return self.spheres.source[answer.entry]

    def _answer(self, points: Float64, *names: str) -> Answers:
        return self.field.query(checked_points(points), self.spheres.anchor, names)

    def close(self) -> None:
        self.field.close()


def device_field(
    spheres: Spheres, kernels: Mapping[str, LogSumExpField], config: FieldConfig, device: Memory
) -> DeviceField:
    """Put the exact distance and `kernels` on a device, for ``config.distance``."""
    chosen = KERNEL_OF[config.distance]
    return DeviceField(
        device,
        spheres.clusters,
        spheres.offsets(spheres.radii),
        {name: field.terms() for name, field in kernels.items()},
        Choice(kernel=chosen, is_single=config.distance == chosen, resolution=RESOLUTION),
    )


@dataclass(frozen=True, kw_only=True)
class CalibratedProbability:
    """``Phi((mean - clearance) / sigma)``, with the field's measured error.

    mean, sigma [m]: average and standard deviation of the field's excess.
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
        explained = np.exp(np.minimum(-half / self._half, 0.0))  # the sum exceeds 1 only by rounding
        occupancy = np.exp(np.minimum(-gpdf / self._gpdf.kernel.length, fixed.CERTAIN_OCCUPANCY))
        return probability_of_occupancy(occupancy, explained)


def probability_of_occupancy(occupancy: Float64, explained: Float64) -> Float64:
    """Eq. 14 of an occupancy o > 0 with variance ``(1 - explained) / 9``.

    It is computed in logarithms. Far from splats it is ``Phi(-3) / Phi(0) = 0.0027``, not zero.
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
    """Make all forms for `config.weights`; the paper's variance does not hold for cg."""
    names = [name for name in PROBABILITIES if name != "paper" or config.weights != "cg"]
    return {name: PROBABILITIES[name](spheres, config, threads) for name in names}
