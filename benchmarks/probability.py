"""Do the two probabilities of collision mean what they say? Against solids whose distance is exact.

    python -m benchmarks.probability [--plot FILE.png] [--json FILE]

Box, ball and a table with things on it, covered by balls 1 and 2 cm apart that touch the surface from within, their
centres then moved by noise of 2 mm. Points are even in space from 5 mm inside to 5 cm outside; one collides when it
lies inside the solid. The calibrated form has the default `field.error_mean` and `field.error`, which were measured
here: the mean error of the distance up to 1 cm outside, and its standard deviation. `--meshes` takes closed meshes
below SPLATCTRL_REAL_DATA instead, that had no part in it.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.measure import machine
from benchmarks.surfaces import points_around, shapes, splats_on
from splatctrl_cli.cli.common import table
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clustered_splats import Spheres
from splatctrl_cli.field.distance import make_field
from splatctrl_cli.field.probability import CalibratedProbability, PaperProbability
from splatctrl_cli.records import Float64
from splatctrl_cli.report.reliability import Reliability, reliability, reliability_picture

SPACINGS = (0.01, 0.02)  # [m]
NOISE = 0.002  # [m]
BAND = (-0.005, 0.05)  # [m] of true distance
NEAR = 0.01  # [m] the error is measured up to this far outside
NUM_POINTS, NUM_OF_MESH = 10_000, 2_000  # a shape and spacing
MESHES = ("YcbBanana", "YcbMustardBottle", "spot")


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, draw, write JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.probability", description=__doc__)
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="write the reliability curves here")
    parser.add_argument("--meshes", action="store_true", help="closed meshes instead of solids made here")
    parser.add_argument("--json", type=Path, default=Path("bench_output/probability.json"), metavar="FILE")
    args = parser.parse_args(argv)
    truth, distance, paper = sampled(FieldConfig(), of_meshes=args.meshes)
    error = (distance - truth)[truth < NEAR]
    is_colliding = truth < 0
    forms = {
        "calibrated": CalibratedProbability(sigma=FieldConfig.error, mean=FieldConfig.error_mean).of(distance),
        "with no mean": CalibratedProbability(sigma=float(np.sqrt(np.mean(error**2)))).of(distance),
        "paper": paper,
    }
    curves = {name: reliability(values, is_colliding) for name, values in forms.items()}
    print("\n".join(lines(curves)))
    measured = f"{1e3 * error.mean():.2f} +- {1e3 * error.std():.2f} mm"
    print(f"error of the distance up to {1e3 * NEAR:g} mm outside: {measured}")
    args.json.parent.mkdir(parents=True, exist_ok=True)
    curves_as_lists = {
        name: {key: np.asarray(value).tolist() for key, value in asdict(curve).items()}
        for name, curve in curves.items()
    }
    report = {
        "machine": machine(),
        "noise": NOISE,
        "band": BAND,
        "error_mean": float(error.mean()),
        "error": float(error.std()),
        "curves": curves_as_lists,
    }
    args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {args.json}")
    if args.plot is not None:
        reliability_picture(args.plot, curves, "Probability of collision, and how often points of it collide")
    return 0


def sampled(config: FieldConfig, *, of_meshes: bool) -> tuple[Float64, Float64, Float64]:
    """True distance, the field's distance and the paper's probability (Q,) at points around every shape."""
    truths, distances, papers = [], [], []
    chosen = [shape for shape in shapes() if shape.name in MESHES] if of_meshes else shapes(with_meshes=False)
    for shape in chosen:
        points, truth = points_around(shape, NUM_OF_MESH if of_meshes else NUM_POINTS, *BAND, seed=1)
        for spacing in SPACINGS:
            centers, radii = splats_on(shape, spacing, is_inset=True, seed=0)
            centers = centers + np.random.default_rng(3).normal(0.0, NOISE, centers.shape)
            truths.append(truth)
            distances.append(make_field(centers, radii, config).query(points)[0])
            papers.append(PaperProbability(Spheres.of(centers, radii), config).of(points))
    return np.concatenate(truths), np.concatenate(distances), np.concatenate(papers)


def lines(curves: dict[str, Reliability]) -> list[str]:
    """A row a bin, and the calibration error of each form."""
    body = []
    for name, curve in curves.items():
        for lower, upper, predicted, observed, count in zip(
            curve.edges, curve.edges[1:], curve.predicted, curve.observed, curve.count, strict=False
        ):
            body.append([name, f"{lower:.1f} to {upper:.1f}", f"{predicted:.3f}", f"{observed:.3f}", str(count)])
        body.append([name, "calibration error", f"{curve.calibration_error:.4f}", "", str(curve.count.sum())])
    return table(["form", "bin", "predicted", "collides", "points"], body)


if __name__ == "__main__":
    raise SystemExit(main())
