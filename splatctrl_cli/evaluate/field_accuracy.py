"""How far a distance field is from the true distance, by band of true distance."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import BANDS, MAP_ALLOWANCE
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, ERROR, FAULTS, LENGTH, Scale
from splatctrl_cli.records import Bool, DistanceGrid, Float64


@dataclass(frozen=True, kw_only=True)
class BandAccuracy:
    """Errors field - truth [m] over the cells of one band of true distance: positive = over-estimate = unsafe.

    None where the band has no cell.
    """

    lower: float
    upper: float
    count: int
    mean: float | None
    rmse: float | None
    median: float | None
    over_95: float | None
    over_max: float | None


@dataclass(frozen=True, kw_only=True)
class OverEstimate:
    """The share of cells where a field exceeds the truth by more than `allowance` [m], and by how much more."""

    allowance: float
    count: int
    count_beyond: int
    share_beyond: float | None
    median_beyond: float | None
    max_error: float | None

    @property
    def holds(self) -> bool:
        """True where no cell exceeds the allowance, over at least one cell."""
        return self.count > 0 and self.count_beyond == 0


MEDIAN = LENGTH  # errors have a sign: a mean or a median may move either way
BAND_SCALES = {
    "count": DESCRIBES,
    "mean": MEDIAN,
    "rmse": ERROR,
    "median": MEDIAN,
    "over_95": ERROR,
    "over_max": ERROR,
}
OVER_SCALES = {
    "allowance": LENGTH,
    "count": DESCRIBES,
    "count_beyond": FAULTS,
    "share_beyond": BAD_SHARE,
    "median_beyond": ERROR,
    "max_error": ERROR,
}


@dataclass(frozen=True, kw_only=True)
class FieldAccuracy:
    """Accuracy of several fields at the same points: bands by field name, over all points and over the seen ones.

    seen is empty, and the over-estimate is over all points, where nobody asked which ones were seen.
    """

    everywhere: Mapping[str, tuple[BandAccuracy, ...]]
    seen: Mapping[str, tuple[BandAccuracy, ...]]
    over_estimate: OverEstimate

    def as_dict(self) -> dict[str, object]:
        """Plain values, as written to ``field.json``."""
        return {**asdict(self), "holds": self.over_estimate.holds}

    def figures(self) -> dict[str, float | None]:
        """The numbers by their `metric_names`."""
        found = {
            f"{where}.{name}.{band_name(band.lower, band.upper)}.{figure}": value
            for where, fields_ in (("everywhere", self.everywhere), ("seen", self.seen))
            for name, bands in fields_.items()
            for band in bands
            for figure, value in vars(band).items()
            if figure not in {"lower", "upper"}
        }
        return found | {f"over_estimate.{name}": value for name, value in vars(self.over_estimate).items()}


def metric_names(field_names: Sequence[str]) -> tuple[str, ...]:
    """Flat names of the numbers in a FieldAccuracy: ``seen.hard.0_2cm.rmse``, ``over_estimate.count``."""
    return tuple(metric_scales(field_names, [band_name(lower, upper) for lower, upper in BANDS]))


def metric_scales(field_names: Sequence[str], bands: Sequence[str]) -> dict[str, Scale]:
    """How two runs are compared by each of `metric_names`, for bands by name."""
    places = [f"{where}.{name}.{band}" for where in ("everywhere", "seen") for name in field_names for band in bands]
    over = {f"over_estimate.{name}": scale for name, scale in OVER_SCALES.items()}
    return {f"{place}.{figure}": scale for place in places for figure, scale in BAND_SCALES.items()} | over


def band_name(lower: float, upper: float) -> str:
    """``0_2cm`` for a band of true distance [m]."""
    return f"{lower * 100:g}_{upper * 100:g}cm"


def field_accuracy(
    distances: Mapping[str, NDArray[np.floating]], truth: Float64, seen: Bool | None, *, median_radius: float
) -> FieldAccuracy:
    """Compare fields with the truth at points outside the objects.

    distances: name -> (Q,) [m], `hard` among them; truth (Q,) [m], >= 0 counts; seen (Q,) True where a training
    camera saw the nearest true surface point, None where nobody looked. The over-estimate is that of `hard` at seen
    points up to 20 cm, against 1 cm + `median_radius` [m]. Raises InputError for arrays of different lengths, or
    without `hard`.
    """
    if "hard" not in distances:
        raise InputError(f"distances: expected one named hard, got {', '.join(distances) or 'none'}")
    for name, values in {**distances, **({} if seen is None else {"seen": seen})}.items():
        if values.shape != truth.shape:
            raise InputError(f"{name}: expected {truth.shape} values, as the truth has, got {values.shape}")
    errors = {name: values.astype(np.float64) - truth for name, values in distances.items()}
    is_near = (truth >= BANDS[0][0]) & (truth < BANDS[-1][1])
    everyone = np.ones(truth.shape, dtype=np.bool_)
    counted = everyone if seen is None else seen
    return FieldAccuracy(
        everywhere={name: _bands(error, truth, everyone) for name, error in errors.items()},
        seen={} if seen is None else {name: _bands(error, truth, seen) for name, error in errors.items()},
        over_estimate=_over_estimate(errors["hard"][is_near & counted], MAP_ALLOWANCE + median_radius),
    )


@dataclass(frozen=True, kw_only=True)
class GridDistance:
    """A distance that a grid holds: values (X, Y, Z) [m], and what is to be added to them [m]."""

    values: NDArray[np.generic]
    added: float = 0.0

    def at(self, cells: NDArray[np.int64]) -> Float64:
        """The distances [m] of cells by flat index, without a copy of the channel, which may be on disk."""
        return np.asarray(self.values.reshape(-1)[cells].astype(np.float64) + self.added)


def grid_distances(grid: DistanceGrid) -> dict[str, GridDistance]:
    """The distances that a grid holds, by field name: sdf, hard, se, gpdf.

    hard is its channel, or else ``bound`` with the margin of the header put back, the same to a micrometre (where
    never-seen cells were made obstacles, the distance to those as well). Raises InputError for a grid with neither.
    """
    found: dict[str, GridDistance] = {
        name: GridDistance(values=grid.channels[name])
        for name in ("sdf", "hard", "se", "gpdf")
        if name in grid.channels
    }
    if "hard" not in found:
        margin = grid.header.get("bound_margin")
        if "bound" not in grid.channels or not isinstance(margin, int | float):
            raise InputError(
                f"distance grid: expected a channel hard or bound, got {', '.join(grid.channels)}",
                remedy="bake with the channel bound, which is there by default",
            )
        found["hard"] = GridDistance(values=grid.channels["bound"], added=float(margin))
    return found


def median_radius(grid: DistanceGrid) -> float:
    """The median radius [m] of the splats a grid was made of, by its header. Raises InputError where it has none."""
    health = grid.header.get("health")
    if not isinstance(health, dict) or not isinstance(health.get("radius"), int | float):
        raise InputError("distance grid: expected health.radius in its header, got none", remedy="bake it again")
    return float(health["radius"])


def _bands(error: Float64, truth: Float64, chosen: Bool) -> tuple[BandAccuracy, ...]:
    return tuple(
        band_accuracy(error[chosen & (truth >= lower) & (truth < upper)], lower, upper) for lower, upper in BANDS
    )


def band_accuracy(error: Float64, lower: float, upper: float) -> BandAccuracy:
    """The figures of errors (Q,) [m] in a band of true distance."""
    is_empty = not len(error)
    return BandAccuracy(
        lower=lower,
        upper=upper,
        count=len(error),
        mean=None if is_empty else float(error.mean()),
        rmse=None if is_empty else float(np.sqrt(np.mean(error**2))),
        median=None if is_empty else float(np.median(error)),
        over_95=None if is_empty else float(np.percentile(error, 95)),
        over_max=None if is_empty else float(error.max()),
    )


def _over_estimate(error: Float64, allowance: float) -> OverEstimate:
    beyond = error[error > allowance] - allowance
    return OverEstimate(
        allowance=allowance,
        count=len(error),
        count_beyond=len(beyond),
        share_beyond=len(beyond) / len(error) if len(error) else None,
        median_beyond=float(np.median(beyond)) if len(beyond) else None,
        max_error=float(error.max()) if len(error) else None,
    )
