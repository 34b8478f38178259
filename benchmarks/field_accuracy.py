"""Errors of the distance fields on exact surfaces, by shape, spacing, radius, field and weights.

The truth is exact: solids made here, and the closed meshes below SPLATCTRL_REAL_DATA. Errors are field minus truth at
points uniform in space from 1 to 20 cm outside; a positive error overstates clearance. The field `safe` must have an
RMSE of at most 1 mm plus a third of the spacing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.field_plots import PlanarBias, write_plots
from benchmarks.measure import Limit, Options, Result, rms
from benchmarks.surfaces import (
    LONE_SPLATS,
    LoneSplat,
    Shape,
    exact_distance,
    lone_splat,
    points_around,
    shapes,
    splats_on,
)
from splatctrl_cli.cli.common import table
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.config.fixed import BANDS
from splatctrl_cli.evaluate.field_accuracy import BandAccuracy, band_accuracy
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, LogSumExpField, SafeField, SeField, SphereField
from splatctrl_cli.field.slabs import median_spacing
from splatctrl_cli.field.weights import METHODS
from splatctrl_cli.records import Float64

BAND = (0.01, 0.20)  # [m] of true distance
SPACINGS = (0.01, 0.02)  # [m]
WEIGHTS = tuple(METHODS)
CG_NOISE = 1e-2  # of cg: with less the squared-exponential kernel of close splats is singular to its solver
NUM_POINTS, NUM_QUICK = 20_000, 3_000
ALLOWED, ALLOWED_OF_SPACING = 1e-3, 1 / 3  # the bar: [m], and a share of the spacing
LENGTHS = (0.01, 0.02, 0.04)  # [m] of the planar bias


@dataclass(frozen=True, kw_only=True)
class Row:
    """Accuracy of one field on one covering of one shape: over the whole band, and by the usual bands.

    share_below_hard: share of points with a field value below the exact distance to the splats.
    """

    shape: str
    spacing: float
    is_inset: bool
    field: str
    weights: str
    num_splats: int
    median_spacing: float
    median_radius: float
    share_below_hard: float
    whole: BandAccuracy
    bands: tuple[BandAccuracy, ...]

    @property
    def bar(self) -> float:
        """The RMSE [m] that `safe` may have."""
        return ALLOWED + ALLOWED_OF_SPACING * self.spacing

    @property
    def is_kept(self) -> bool:
        """True where the RMSE is within the bar."""
        return self.whole.rmse is not None and self.whole.rmse <= self.bar


def run(options: Options) -> Result:
    """Every table; with --quick, only on solids made here, at fewer points."""
    num = NUM_QUICK if options.is_quick else NUM_POINTS
    rows = [row for shape in shapes(with_meshes=not options.is_quick) for row in shape_rows(shape, num)]
    bias = [planar_bias(length) for length in LENGTHS]
    judged = [row for row in rows if _is_judged(row)]
    missed = [row for row in judged if not row.is_kept]
    if options.plots is not None:
        write_plots(options.plots, bias)
    header, cells = default_table(rows)
    return Result(
        title=f"field - truth [mm], true distance {BAND[0] * 100:g} to {BAND[1] * 100:g} cm, "
        f"l = {FieldConfig.length_scale * 100:g} cm, {FieldConfig.weights}; RMSE by field; mean to max of safe",
        columns=header,
        rows=cells,
        figures={"num_judged": float(len(judged)), "num_missed": float(len(missed))},
        limits=[Limit(figure="num_missed", bound=0.0)],
        more=[
            *(*weight_lines(rows), "", *bias_lines(bias), ""),
            *(*place_lines(place_errors(shapes(with_meshes=False)[0], num)), ""),
            *(*lone_lines([lone_reading(case) for case in LONE_SPLATS]), ""),
        ],
    )


def shape_rows(shape: Shape, num_points: int, methods: Sequence[str] = WEIGHTS) -> list[Row]:
    """Every covering, field and way to make weights on one shape."""
    points, truth = points_around(shape, num_points, *BAND, seed=1)
    rows = []
    for spacing in SPACINGS:
        for is_inset in (False, True):
            centers, radii = splats_on(shape, spacing, is_inset=is_inset, seed=0)
            readings = distances(centers, radii, points, methods)
            for (name, weights), distance in readings.items():
                error = distance - truth
                rows.append(
                    Row(
                        shape=shape.name,
                        spacing=spacing,
                        is_inset=is_inset,
                        field=name,
                        weights=weights,
                        num_splats=len(radii),
                        median_spacing=median_spacing(centers),
                        median_radius=float(np.median(radii)),
                        share_below_hard=float(np.mean(distance < readings["hard", ""])),
                        whole=band_accuracy(error, *BAND),
                        bands=tuple(
                            band_accuracy(error[(truth >= lower) & (truth < upper)], lower, upper)
                            for lower, upper in BANDS
                        ),
                    )
                )
    return rows


def distances(
    centers: Float64, radii: Float64, points: Float64, methods: Sequence[str]
) -> dict[tuple[str, str], Float64]:
    """Distance (Q,) [m] by (field, weights); hard has no weights."""
    exact = SphereField(Spheres.of(centers, radii), threads=0)
    found = {("hard", ""): exact.query(points)[0]}
    for weights in methods:
        noise = CG_NOISE if weights == "cg" else FieldConfig.noise
        kernels: dict[str, LogSumExpField] = {
            "se": SeField(Spheres.of(centers, radii), FieldConfig(noise=noise, weights=weights), threads=0),
            "gpdf": GpdfField(Spheres.of(centers, radii), FieldConfig(noise=noise, weights=weights), threads=0),
        }
        for name, kernel in kernels.items():
            found[name, weights] = kernel.query(points)[0]
            safe = "safe" if name == "se" else f"safe_{name}"
            found[safe, weights] = SafeField(exact, kernel).query(points)[0]
    return found


def planar_bias(length: float) -> PlanarBias:
    """The Matern field over a plane of centres l / 5 apart, wide enough that its rim has no effect."""
    step, half, num = length / 5, 0.35 + 5 * length, 40
    axis = np.arange(-half, half, step)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    centers = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    heights = np.linspace(0.005, 0.20, num)
    points = np.stack([np.full(num, 0.3 * step), np.full(num, 0.2 * step), heights], axis=1)
    measured = GpdfField(
        Spheres.of(centers, np.zeros(len(centers))), FieldConfig(length_scale=length), threads=0
    ).query(points)[0]
    closed_form = heights - length * np.log1p(heights / length)
    return PlanarBias(
        length=length,
        heights=heights.tolist(),
        measured=measured.tolist(),
        closed_form=closed_form.tolist(),
        largest_difference=float(np.abs(measured - closed_form).max()),
        at_10_cm=float(np.interp(0.10, heights, measured)),
    )


@dataclass(frozen=True, kw_only=True)
class PlaceError:
    """Mean and RMSE [m] of one field's error on the box before faces, edges and corners."""

    spacing: float
    is_inset: bool
    field: str
    mean: tuple[float, float, float]
    rmse: tuple[float, float, float]


def place_errors(box: Shape, num_points: int) -> list[PlaceError]:
    """Errors by place; a point is before an edge (corner) if two (three) coordinates exceed the box's."""
    points, truth = points_around(box, num_points, *BAND, seed=1)
    num_beyond = np.count_nonzero((points < box.box.lower) | (points > box.box.upper), axis=1)
    places = [num_beyond == beyond for beyond in (1, 2, 3)]
    found = []
    for spacing in SPACINGS:
        for is_inset in (False, True):
            readings = distances(*splats_on(box, spacing, is_inset=is_inset, seed=0), points, [FieldConfig.weights])
            for (name, _), distance in readings.items():
                errors = [(distance - truth)[place] for place in places]
                mean = [float(error.mean()) for error in errors]
                rms_of = [rms(error) for error in errors]
                found.append(
                    PlaceError(
                        spacing=spacing,
                        is_inset=is_inset,
                        field=name,
                        mean=(mean[0], mean[1], mean[2]),
                        rmse=(rms_of[0], rms_of[1], rms_of[2]),
                    )
                )
    return found


@dataclass(frozen=True, kw_only=True)
class LoneReading:
    """Largest excess [m] of the fields over the exact distance near a lone splat."""

    case: LoneSplat
    gpdf: float
    se: float
    safe: float


def lone_reading(case: LoneSplat) -> LoneReading:
    """Largest excess from 2 mm to 15 cm before the splat, on the side away from the wall."""
    centers, radii = lone_splat(case.wall, wall_spacing=case.spacing, radius=case.radius)
    steps = case.radius + np.linspace(0.002, 0.15, 149)
    points = np.stack([steps, np.zeros_like(steps), np.zeros_like(steps)], axis=1)
    hard = exact_distance(points, centers, radii)
    se = SeField(Spheres.of(centers, radii), FieldConfig(length_scale=case.length))
    fields = (
        GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=case.length)),
        se,
        SafeField(SphereField(Spheres.of(centers, radii)), se),
    )
    gpdf_over, se_over, safe_over = (float((field.query(points)[0] - hard).max()) for field in fields)
    return LoneReading(case=case, gpdf=gpdf_over, se=se_over, safe=safe_over)


def default_table(rows: Sequence[Row]) -> tuple[Sequence[str], list[list[str]]]:
    """One line per covering: RMSE of every field with the default weights, and all of `safe`."""
    header = (
        *("shape", "spacing cm", "centres", "splats", "radius mm", "hard", "gpdf", "se", "safe"),
        *("mean", "95 %", "max", "se < hard %", "bar", "kept"),
    )
    by_field = {(*_covering(row), row.field): row for row in rows if row.weights in {"", FieldConfig.weights}}
    cells = []
    for row in rows:
        if _is_judged(row):
            others = [by_field[*_covering(row), name].whole.rmse for name in ("hard", "gpdf", "se")]
            figures = (*others, row.whole.rmse, row.whole.mean, row.whole.over_95, row.whole.over_max)
            place = "inside" if row.is_inset else "on it"
            cells.append(
                [
                    *(row.shape, f"{row.spacing * 100:g}", place, str(row.num_splats)),
                    *(f"{row.median_radius * 1e3:.1f}", *map(millimetres, figures)),
                    *(f"{row.share_below_hard * 100:.0f}", millimetres(row.bar), "yes" if row.is_kept else "NO"),
                ]
            )
    return header, cells


def weight_lines(rows: Sequence[Row]) -> list[str]:
    """RMSE over all shapes, and the largest over-estimate, by field and weights."""
    header = (
        "spacing cm",
        "centres",
        "field",
        *(f"{w}: {what}" for w in WEIGHTS for what in ("RMSE", "95 %", "max")),
    )
    cells = []
    for spacing in SPACINGS:
        for is_inset in (False, True):
            for name in ("hard", "gpdf", "se", "safe_gpdf", "safe"):
                row = [f"{spacing * 100:g}", "inside" if is_inset else "on it", name]
                for weights in WEIGHTS:
                    wanted = (spacing, is_inset, name, "" if name == "hard" else weights)
                    row += map(millimetres, _pooled(rows, *wanted))
                cells.append(row)
    title = f"over all shapes [mm]: RMSE of equal shares, mean of the 95 %, largest error; cg with noise {CG_NOISE:g}"
    return [title, *table(header, cells)]


def _pooled(
    rows: Sequence[Row], spacing: float, is_inset: bool, name: str, weights: str
) -> tuple[float, float, float]:
    wanted = (spacing, is_inset, name, weights)
    wholes = [row.whole for row in rows if (row.spacing, row.is_inset, row.field, row.weights) == wanted]
    rmse = np.array([whole.rmse for whole in wholes], dtype=np.float64)
    over_95 = np.array([whole.over_95 for whole in wholes], dtype=np.float64)
    over_max = np.array([whole.over_max for whole in wholes], dtype=np.float64)
    return rms(rmse), float(over_95.mean()), float(over_max.max())


def bias_lines(bias: Sequence[PlanarBias]) -> list[str]:
    """What the Matern field reads over a dense plane."""
    header = ("l cm", "reads at 10 cm [mm]", "largest difference from z - l log(1 + z / l), 0.5 to 20 cm [mm]")
    cells = [
        [f"{one.length * 100:g}", millimetres(one.at_10_cm), millimetres(one.largest_difference, 3)] for one in bias
    ]
    return ["gpdf over a dense plane of centres with radius 0", *table(header, cells)]


def place_lines(errors: Sequence[PlaceError]) -> list[str]:
    """Mean and RMSE by place."""
    places = ("faces", "edges", "corners")
    header = (
        "spacing cm",
        "centres",
        "field",
        *(f"{place}: {what}" for place in places for what in ("mean", "RMSE")),
    )
    cells = [
        [
            *(f"{one.spacing * 100:g}", "inside" if one.is_inset else "on it", one.field),
            *(millimetres(value) for pair in zip(one.mean, one.rmse, strict=True) for value in pair),
        ]
        for one in errors
    ]
    return ["the box by what is nearest [mm]", *table(header, cells)]


def lone_lines(readings: Sequence[LoneReading]) -> list[str]:
    """The largest over-estimates by configuration."""
    header = ("l cm", "wall behind cm", "wall spacing mm", "radius mm", "gpdf", "se", "safe")
    cells = [
        [
            *(f"{one.case.length * 100:g}", f"{one.case.wall * 100:g}", f"{one.case.spacing * 1e3:g}"),
            *(f"{one.case.radius * 1e3:g}", *(millimetres(value) for value in (one.gpdf, one.se, one.safe))),
        ]
        for one in readings
    ]
    return ["a lone splat before a wall: largest reading above the exact distance [mm]", *table(header, cells)]


def millimetres(value: float | None, digits: int = 1) -> str:
    """A length [m] in mm."""
    return "-" if value is None else f"{value * 1e3:.{digits}f}"


def _covering(row: Row) -> tuple[str, float, bool]:
    return row.shape, row.spacing, row.is_inset


def _is_judged(row: Row) -> bool:
    return row.field == "safe" and row.weights == FieldConfig.weights
