"""Reliability of the two probabilities of collision, on solids with exact distance.

Box, ball and a table with objects are covered by balls 1 and 2 cm apart that touch the surface from inside. Noise of
2 mm then moves their centres. Points are uniform in space from 5 mm inside to 5 cm outside. A point inside the solid
collides. The calibrated form has the default `field.error_mean` and `field.error`, which were measured here: the mean
error of the distance up to 1 cm outside, and its standard deviation. The closed meshes below SPLATCTRL_REAL_DATA were
not used for this measurement.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.measure import Options, Result, rms
from benchmarks.surfaces import Shape, points_around, shapes, splats_on
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import CalibratedProbability, PaperProbability, field_over
from splatctrl_cli.records import Float64
from splatctrl_cli.report.field_pictures import Reliability, reliability, reliability_picture

SPACINGS = (0.01, 0.02)  # [m]
NOISE = 0.002  # [m]
BAND = (-0.005, 0.05)  # [m] of true distance
NEAR = 0.01  # [m] the error is measured up to this far outside
NUM_POINTS, NUM_OF_MESH = 10_000, 2_000  # a shape and spacing
MESHES = ("YcbBanana", "YcbMustardBottle", "spot")


def run(options: Options) -> Result:
    """Rows by bin, and the calibration error of each form, for solids made here and for meshes."""
    rows, notes = [], []
    groups = {"solids": shapes(with_meshes=False), "meshes": [shape for shape in shapes() if shape.name in MESHES]}
    for name, group in groups.items():
        if not group:
            continue
        truth, distance, paper = sampled(group, NUM_POINTS if name == "solids" else NUM_OF_MESH)
        error = (distance - truth)[truth < NEAR]
        forms = {
            "calibrated": CalibratedProbability(sigma=FieldConfig.error, mean=FieldConfig.error_mean).of(distance),
            "with no mean": CalibratedProbability(sigma=rms(error)).of(distance),
            "paper": paper,
        }
        curves = {form: reliability(values, truth < 0) for form, values in forms.items()}
        rows += [[name, *row] for row in bins(curves)]
        measured = f"{1e3 * error.mean():.2f} +- {1e3 * error.std():.2f} mm"
        notes.append(f"{name}: error of the distance up to {1e3 * NEAR:g} mm outside: {measured}")
        if options.plots is not None and name == "solids":
            title = "Probability of collision, and how often points of it collide"
            reliability_picture(options.plots / "field_reliability.png", curves, title)
    columns = ("shapes", "form", "bin", "predicted", "collides", "points")
    return Result(title="probability of collision", columns=columns, rows=rows, notes=notes)


def sampled(group: Sequence[Shape], num: int) -> tuple[Float64, Float64, Float64]:
    """True distance, the field's distance and the paper's probability (Q,) at `num` points around every shape."""
    config, truths, distances, papers = FieldConfig(), list[Float64](), list[Float64](), list[Float64]()
    for shape in group:
        points, truth = points_around(shape, num, *BAND, seed=1)
        for spacing in SPACINGS:
            centers, radii = splats_on(shape, spacing, is_inset=True, seed=0)
            centers = centers + np.random.default_rng(3).normal(0.0, NOISE, centers.shape)
            truths.append(truth)
            distances.append(field_over(Spheres.of(centers, radii), config).query(points)[0])
            papers.append(PaperProbability(Spheres.of(centers, radii), config).at(points, np.zeros(0)))
    return np.concatenate(truths), np.concatenate(distances), np.concatenate(papers)


def bins(curves: dict[str, Reliability]) -> Iterator[list[str]]:
    """A row a bin, and the calibration error of each form."""
    for name, curve in curves.items():
        for lower, upper, predicted, observed, count in zip(
            curve.edges, curve.edges[1:], curve.predicted, curve.observed, curve.count, strict=False
        ):
            yield [name, f"{lower:.1f} to {upper:.1f}", f"{predicted:.3f}", f"{observed:.3f}", str(count)]
        yield [name, "calibration error", f"{curve.calibration_error:.4f}", "", str(curve.count.sum())]
