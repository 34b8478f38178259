"""Table I of the paper, by one command: which forms of the Matern field are finite, at which l, and their errors.

100 points on the unit circle, without radii (as in the paper) and with radii from 1 mm to 30 cm, queried at 41 x 41
points on [-2, 2] x [-2, 2]. A cell has a tick if every value is finite, as in the paper. It also has the largest
difference from the same weights' float64 field in the log domain, which is finite everywhere.

Forms, with M = (K + noise I)^-1 y of eq. 12, lumped (eq. 15) or of the full process:
`eq. 7 to 9` as printed; `eq. 12` as printed, shifted by the nearest centre; `log domain`: radius and weight in the
exponent, shifted by the largest exponent, in NumPy; `GpdfField`: that, in this package's float32 kernels.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Options, Result
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField
from splatctrl_cli.records import Float64

LENGTHS = (1e0, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
NUM_POINTS = 100
NUM_QUERIES = 41  # along each side of the grid; odd, so that its middle is the circle's
EXTENT = 2.0
NOISE = FieldConfig.noise
PRINTED = {"eq. 7 to 9": (True, True, False, False, False, False), "eq. 12": (True,) * 6}  # the paper's ticks

Array = NDArray[np.floating]
DType = type[np.float32] | type[np.float64]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """num_bad: answers that are not finite; error: the largest difference [circle's radius] of the finite ones."""

    length: float
    num_bad: int
    error: float | None


@dataclass(frozen=True, kw_only=True)
class Row:
    """A form of the field on one of the clouds, in one type of number, by l."""

    cloud: str
    weights: str
    form: str
    number: str
    cells: tuple[Cell, ...]


def run(_: Options) -> Result:
    """Every form, with the paper's own ticks below."""
    body = [[row.cloud, row.weights, row.form, row.number, *map(shown, row.cells)] for row in table_rows()]
    for form, ticks in PRINTED.items():
        body.append(["no radii", "not said", form, "in the paper", *("yes" if tick else "no" for tick in ticks)])
    return Result(
        title="stability: Table I",
        columns=("radii", "M", "form", "numbers", *(f"l = {length:.0e}" for length in LENGTHS)),
        rows=body,
    )


def table_rows() -> list[Row]:
    """Every form on both clouds."""
    mixed = np.random.default_rng(0).permutation(np.geomspace(0.001, 0.3, NUM_POINTS))
    rows = []
    for cloud, radii, solved in (
        ("no radii", np.zeros(NUM_POINTS), ("lumped", "full process")),
        ("1 mm to 30 cm", mixed, ("lumped",)),  # the full process of these is beyond float64 from l = 1e-2 on
    ):
        for weights in solved:
            for form in ("eq. 7 to 9", "eq. 12", "log domain"):
                for number in (np.float32, np.float64):
                    cells = tuple(literal_cell(form, radii, length, weights, number) for length in LENGTHS)
                    rows.append(Row(cloud=cloud, weights=weights, form=form, number=number.__name__, cells=cells))
        ours = tuple(own_cell(radii, length) for length in LENGTHS)
        rows.append(Row(cloud=cloud, weights="lumped", form="GpdfField", number="float32", cells=ours))
    return rows


def circle() -> tuple[Float64, Float64]:
    """Points (N, 2) on the unit circle, and the grid (Q, 2) of queries."""
    angle = 2 * np.pi * np.arange(NUM_POINTS) / NUM_POINTS
    axis = np.linspace(-EXTENT, EXTENT, NUM_QUERIES)
    x, y = np.meshgrid(axis, axis)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1), np.stack([x.ravel(), y.ravel()], axis=1)


def literal_cell(form: str, radii: Float64, length: float, weights: str, number: DType) -> Cell:
    """A form of the paper in a number type, compared with the log domain in float64."""
    centers, points = circle()
    log_size, sign = log_weights(centers, radii, length, weights, np.float64)
    truth = log_domain(distances(points, centers), log_size, sign, length)
    distance = distances(points.astype(number), centers.astype(number))
    scale = number(length)
    with np.errstate(all="ignore"):
        if form == "log domain":
            log_size, sign = log_weights(centers, radii, length, weights, number)
            found = log_domain(distance, log_size, sign, length)
        else:
            values = np.exp(radii.astype(number) / scale)  # y of eq. 8
            m = as_printed(distances(centers.astype(number), centers.astype(number)), values, scale, weights)
            if form == "eq. 12":
                nearest = distance.min(axis=1, keepdims=True)
                found = nearest[:, 0] - scale * np.log(np.exp((nearest - distance) / scale) @ m)
            else:
                found = -scale * np.log(np.exp(-distance / scale) @ m)
    return cell_of(length, found, truth)


def own_cell(radii: Float64, length: float) -> Cell:
    """This package's field, on the circle at z = 0."""
    centers, points = circle()
    log_size, sign = log_weights(centers, radii, length, "lumped", np.float64)
    truth = log_domain(distances(points, centers), log_size, sign, length)
    flat = [np.column_stack([array, np.zeros(len(array))]) for array in (centers, points)]
    return cell_of(
        length, GpdfField(Spheres.of(flat[0], radii), FieldConfig(length_scale=length)).query_raw(flat[1])[0], truth
    )


def cell_of(length: float, found: Array, truth: Array) -> Cell:
    """Cell of the values `found` where `truth` is finite (with a full process, it may not be)."""
    asked = np.isfinite(truth)
    is_finite = np.isfinite(found)
    error = np.abs(found.astype(np.float64) - truth)[asked & is_finite]
    return Cell(
        length=length,
        num_bad=int(np.count_nonzero(asked & ~is_finite)),
        error=float(error.max()) if len(error) else None,
    )


def distances(points: Array, centers: Array) -> Array:
    """(Q, N), in the type of the coordinates."""
    away = points[:, None] - centers[None]
    return np.asarray(np.sqrt(np.square(away).sum(axis=2)))


def as_printed(between: Array, values: Array, length: np.floating, weights: str) -> Array:
    """M of eq. 12 (N,)."""
    kernel = np.exp(-between / length)
    if weights == "lumped":
        return np.asarray(values / (kernel.sum(axis=1) + values.dtype.type(NOISE)))
    noise = values.dtype.type(NOISE) * np.eye(len(values), dtype=values.dtype)
    return np.asarray(np.linalg.solve(kernel + noise, values))


def log_weights(centers: Float64, radii: Float64, length: float, weights: str, number: DType) -> tuple[Array, Array]:
    """``log |M|`` and the sign of M, each (N,); a full process is without radii."""
    between = distances(centers.astype(number), centers.astype(number))
    exponent = radii.astype(number) / number(length)
    if weights == "lumped":
        kernel = np.exp(-between / number(length))
        return exponent - np.log(kernel.sum(axis=1) + number(NOISE)), np.ones_like(exponent)
    solved = as_printed(between, np.exp(exponent), number(length), weights)
    with np.errstate(divide="ignore"):
        return np.log(np.abs(solved)), np.sign(solved)


def log_domain(distance: Array, log_size: Array, sign: Array, length: float) -> Array:
    """``-l log sum_i sign_i exp(log |M_i| - d_i / l)``, shifted by the largest exponent; NaN without a distance."""
    scale = distance.dtype.type(length)
    exponent = log_size - distance / scale
    largest = exponent.max(axis=1)
    total = np.exp(exponent - largest[:, None]) @ sign
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(-scale * (largest + np.log(np.where(total > 0, total, np.nan))))


def shown(cell: Cell) -> str:
    """``yes`` or the number of bad answers, and the error."""
    return (
        f"{'yes' if not cell.num_bad else f'no {cell.num_bad}'} {'-' if cell.error is None else f'{cell.error:.0e}'}"
    )
