"""A baked field beside the truth of a simulated log: where cameras looked, how far off is it?"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.cli.bake_source import BakeSource
from splatctrl_cli.cli.common import table
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import BANDS, FieldAccuracy, field_accuracy
from splatctrl_cli.evaluate.visibility import seen_by
from splatctrl_cli.field.grid import exact_channel
from splatctrl_cli.io.source import open_source
from splatctrl_cli.records import Bool, DistanceGrid, Float64, RgbdFrame
from splatctrl_cli.simulate.truth import Truth, load_truth

FIELDS = ("hard", "sdf")  # the exact distance, and what a controller uses
MAX_CELLS = 200_000  # a larger grid is compared at this many cells, drawn with the seed
POINTS_PER_CHUNK = 50_000  # of the truth's (points x primitives) arrays


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The accuracy, and how many cells went into it.

    num_drawn of the grid's cells, num_near of them outside the objects and within 20 cm, num_seen of those with a
    nearest true surface point that a training camera saw inside the workspace; num_outside_workspace more were seen,
    but their surface lies where the scene keeps no splats.
    """

    accuracy: FieldAccuracy
    num_drawn: int
    num_near: int
    num_seen: int
    num_outside_workspace: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as written to ``accuracy.json``."""
        counts = {name: value for name, value in vars(self).items() if name != "accuracy"}
        return {**counts, **self.accuracy.as_dict()}


def compare_with_truth(
    grid: DistanceGrid, source: BakeSource, truth_path: Path, log: Path, *, seed: int
) -> Comparison:
    """The accuracy of `hard` and `sdf` at drawn cells; the robot is in neither the field nor the truth.

    Raises NotEvaluableError where no cell is near an object.
    """
    truth = load_truth(truth_path)
    stamp_ns = int(truth.stamps[-1]) if source.stamp_ns is None else source.stamp_ns
    shape = grid.channels["sdf"].shape
    num_cells = int(np.prod(shape))
    drawn = np.sort(np.random.default_rng(seed).choice(num_cells, min(num_cells, MAX_CELLS), replace=False))
    points = grid.origin + grid.voxel * np.stack(np.unravel_index(drawn, shape), axis=1)
    distance, surface = _closest(truth, points, stamp_ns)
    is_near = (distance >= BANDS[0][0]) & (distance < BANDS[-1][1])
    if not is_near.any():
        raise NotEvaluableError(f"{truth_path}: no cell of the grid lies within {BANDS[-1][1]} m outside an object")
    seen = _seen(surface[is_near], log, source.cameras, stamp_ns)
    in_workspace = np.ones_like(seen) if source.workspace is None else source.workspace.contains(surface[is_near])
    channels = {"hard": exact_channel(grid), "sdf": grid.channels["sdf"]}
    fields = {name: channels[name].reshape(-1)[drawn[is_near]].astype(np.float64) for name in FIELDS}
    health: Any = grid.header["health"]
    return Comparison(
        accuracy=field_accuracy(fields, distance[is_near], seen & in_workspace, median_radius=health["radius"]),
        num_drawn=len(drawn),
        num_near=int(is_near.sum()),
        num_seen=int((seen & in_workspace).sum()),
        num_outside_workspace=int((seen & ~in_workspace).sum()),
    )


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
    return [
        "error = field - truth, positive where clearance is over-estimated",
        *table(header, rows),
        "seen: cells whose nearest true surface a camera saw; all: also those before backs that none saw",
        verdict,
    ]
