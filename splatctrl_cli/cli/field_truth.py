"""A baked field beside the truth of a simulated log: where cameras looked, how far off is it?"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.cli.bake_source import BakeSource
from splatctrl_cli.cli.common import table
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import BANDS, FieldAccuracy, field_accuracy
from splatctrl_cli.evaluate.visibility import seen_by
from splatctrl_cli.field.grid import exact_channel
from splatctrl_cli.field.probability import CollisionProbability
from splatctrl_cli.records import Bool, DistanceGrid, Float64, RgbdFrame
from splatctrl_cli.report.reliability import Reliability, reliability
from splatctrl_cli.simulate.truth import Truth, load_truth
from splatctrl_cli.sources.source import open_source

FIELDS = ("hard", "sdf")  # the exact distance, and what a controller uses
MAX_CELLS = 200_000  # a larger grid is compared at this many cells, drawn with the seed
_CURVES = ("edges", "predicted", "observed")
NEAR = 0.05  # [m] where a probability is neither 0 nor 1
POINTS_PER_CHUNK = 50_000  # of the truth's (points x primitives) arrays


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The accuracy, and how many cells went into it.

    num_drawn of the grid's cells, num_blank of them without a distance (field.unknown = nan), num_near of the others
    outside the objects and within 20 cm, num_seen of those with a nearest true surface point that a training camera
    saw inside the workspace; num_outside_workspace more were seen, but their surface lies where the scene keeps no
    splats. reliability: of each form of the probability, at seen cells within 20 cm of a surface, inside or out.
    error_mean, error_sigma [m]: of sdf at seen cells within `NEAR` of a surface, None without any.
    """

    accuracy: FieldAccuracy
    num_drawn: int
    num_blank: int
    num_near: int
    num_seen: int
    num_outside_workspace: int
    reliability: Mapping[str, Reliability]
    error_mean: float | None
    error_sigma: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as written to ``field.json``."""
        counts = {name: value for name, value in vars(self).items() if name.startswith("num_")}
        error = {"error_mean": self.error_mean, "error_sigma": self.error_sigma}
        curves = {name: _curve(curve) for name, curve in self.reliability.items()}
        return {**counts, **self.accuracy.as_dict(), **error, "reliability": curves}


def compare_with_truth(
    grid: DistanceGrid,
    source: BakeSource,
    truth_path: Path,
    log: Path,
    *,
    seed: int,
    probabilities: Mapping[str, CollisionProbability],
) -> Comparison:
    """The accuracy of `hard` and `sdf` at drawn cells, and the reliability of the probabilities of the same splats.

    The robot is in neither the field nor the truth.
    Raises NotEvaluableError where no cell is near an object.
    """
    truth = load_truth(truth_path)
    stamp_ns = int(truth.stamps[-1]) if source.stamp_ns is None else source.stamp_ns
    shape = grid.channels["sdf"].shape
    num_cells = int(np.prod(shape))
    drawn = np.sort(np.random.default_rng(seed).choice(num_cells, min(num_cells, MAX_CELLS), replace=False))
    cells = _cells(grid, drawn)
    points = grid.origin + grid.voxel * np.stack(np.unravel_index(drawn, shape), axis=1)
    distance, surface = _closest(truth, points, stamp_ns)
    is_blank = ~np.isfinite(cells["sdf"])
    is_around = (np.abs(distance) < BANDS[-1][1]) & ~is_blank
    is_near = (distance >= BANDS[0][0]) & is_around
    if not is_near.any():
        raise NotEvaluableError(f"{truth_path}: no cell of the grid lies within {BANDS[-1][1]} m outside an object")
    seen, in_workspace = np.zeros_like(is_near), np.ones_like(is_near)
    seen[is_around] = _seen(surface[is_around], log, source.cameras, stamp_ns)
    if source.workspace is not None:
        in_workspace[is_around] = source.workspace.contains(surface[is_around])
    health: Any = grid.header["health"]
    is_counted = seen & in_workspace
    error = (cells["sdf"] - distance)[is_counted & (np.abs(distance) < NEAR)]
    asked = probabilities if is_counted.any() else {}
    return Comparison(
        accuracy=field_accuracy(
            {name: cells[name][is_near] for name in FIELDS},
            distance[is_near],
            is_counted[is_near],
            median_radius=health["radius"],
        ),
        num_drawn=len(drawn),
        num_blank=int(np.count_nonzero(is_blank)),
        num_near=int(np.count_nonzero(is_near)),
        num_seen=int(np.count_nonzero(is_counted & is_near)),
        num_outside_workspace=int(np.count_nonzero(seen & ~in_workspace & is_near)),
        reliability={
            name: reliability(form.at(points[is_counted], cells["sdf"][is_counted]), distance[is_counted] <= 0)
            for name, form in asked.items()
        },
        error_mean=float(error.mean()) if len(error) else None,
        error_sigma=float(error.std()) if len(error) else None,
    )


def _cells(grid: DistanceGrid, drawn: NDArray[np.int64]) -> dict[str, Float64]:
    """What the grid holds at drawn cells, whole channels of which may not fit the memory: hard, sdf."""
    names = [name for name in ("sdf", "hard", "bound") if name in grid.channels]
    channels: dict[str, NDArray[np.generic]] = {
        name: grid.channels[name].reshape(-1)[drawn].astype(np.float32) for name in names
    }
    exact = exact_channel(DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=channels, header=grid.header))
    return {name: values.astype(np.float64) for name, values in channels.items()} | {"hard": exact.astype(np.float64)}


def _curve(found: Reliability) -> dict[str, object]:
    """Plain values; None where a bin is empty."""
    values = {name: [None if np.isnan(v) else float(v) for v in getattr(found, name)] for name in _CURVES}
    return {**values, "count": found.count, "calibration_error": found.calibration_error}


def _closest(truth: Truth, points: Float64, stamp_ns: int) -> tuple[Float64, Float64]:
    chunks = np.array_split(points, -(-len(points) // POINTS_PER_CHUNK))
    distances, surfaces = zip(*(truth.closest(chunk, stamp_ns) for chunk in chunks), strict=True)
    return np.concatenate(distances), np.concatenate(surfaces)


def _seen(surface: Float64, log: Path, cameras: tuple[str, ...] | None, until_ns: int) -> Bool:
    seen = np.zeros(len(surface), dtype=np.bool_)
    for frame in _frames(log, cameras, until_ns):
        unseen = np.flatnonzero(~seen)
        seen[unseen] = seen_by(surface[unseen], [frame])
    return seen


def _frames(log: Path, cameras: tuple[str, ...] | None, until_ns: int) -> Iterator[RgbdFrame]:
    """Frames of the scene's training cameras (of every camera for a bare splat set), up to its stamp."""
    for record in open_source(log).records():
        if record.stamp_ns > until_ns:
            return
        if isinstance(record, RgbdFrame) and (cameras is None or record.camera in cameras):
            yield record


def accuracy_lines(compared: Comparison) -> list[str]:
    """The table by band, and whether the exact distance keeps to its allowance."""
    header = ("cells", "field", "true cm", "count", "mean mm", "rmse mm", "median mm", "95 % mm", "max mm")
    rows: list[tuple[object, ...]] = []
    accuracy = compared.accuracy
    for where, fields in (("seen", accuracy.seen), ("all", accuracy.everywhere)):
        for name, bands in fields.items():
            for band in bands:
                values = (band.mean, band.rmse, band.median, band.over_95, band.over_max)
                shown = ["-" if value is None else f"{value * 1e3:.1f}" for value in values]
                rows.append((where, name, f"{band.lower * 100:g}-{band.upper * 100:g}", band.count, *shown))
    over = accuracy.over_estimate
    verdict = (
        f"hard exceeds the truth by more than {over.allowance * 1e3:.1f} mm at {over.count_beyond} of {over.count} "
        "seen cells"
    )
    if over.median_beyond is not None and over.max_error is not None:
        verdict += (
            f": in the median by {over.median_beyond * 1e3:.1f} mm more than that; "
            f"the largest error is {over.max_error * 1e3:.1f} mm"
        )
    if compared.num_outside_workspace:
        verdict += f"; {compared.num_outside_workspace} cells before seen surfaces outside the workspace do not count"
    expected = [
        f"probability, {name}: calibration error {curve.calibration_error:.3f} at seen cells"
        for name, curve in compared.reliability.items()
    ]
    if compared.error_mean is not None and compared.error_sigma:
        mean, sigma = compared.error_mean, compared.error_sigma
        expected.append(
            f"within {NEAR * 100:g} cm of seen surfaces sdf errs by {mean * 1e3:.1f} +- {sigma * 1e3:.1f} mm: "
            f"calibrate the probability with --set field.error_mean={mean:.4f} --set field.error={sigma:.4f}"
        )
    return [
        "error = field - truth, positive where clearance is over-estimated",
        *table(header, rows),
        "seen: cells whose nearest true surface a camera saw; all: also those before backs that none saw",
        verdict,
        *expected,
    ]
