"""How far sphere marching brings the Matern field to its surface and to the true one, by shape and number of steps.

    python -m benchmarks.marching [--json FILE]

Splats every 5 mm on a plane, and 1 cm apart on a box and a ball, without radii and as balls that touch the surface
from within; points 1 to 10 cm outside. Error is the distance less the truth, root mean square; `hard` is the exact
distance to the splats.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.measure import machine
from benchmarks.surfaces import points_around, shapes, splats_on
from splatctrl_cli.cli.common import table
from splatctrl_cli.field.distance import GpdfField, SphereField, march
from splatctrl_cli.records import Float64

STEPS = (1, 3, 5, 10)
BAND = (0.01, 0.10)  # [m] of true distance
NUM_POINTS = 4000

Scene = tuple[Float64, Float64, Float64, Float64]  # centres, radii, points, truth


@dataclass(frozen=True, kw_only=True)
class Row:
    """RMSE [m] of the plain field, after each number of steps, and of hard; bias [m] after 5 steps."""

    scene: str
    num_splats: int
    plain: float
    marched: dict[int, float]
    bias: float
    hard: float


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.marching", description=__doc__)
    parser.add_argument("--json", type=Path, default=Path("bench_output/marching.json"), metavar="FILE")
    args = parser.parse_args(argv)
    rows = [measured(name, make()) for name, make in scenes().items()]
    head = ["splats on", "splats", "gpdf", *(f"{steps} steps" for steps in STEPS), "bias of 5", "hard"]
    body = [
        [row.scene, str(row.num_splats)]
        + [f"{1e3 * value:.2f}" for value in (row.plain, *row.marched.values(), row.bias, row.hard)]
        for row in rows
    ]
    print("\n".join(["RMSE [mm]", *table(head, body)]))
    args.json.parent.mkdir(parents=True, exist_ok=True)
    report = {"machine": machine(), "band": BAND, "rows": [asdict(row) for row in rows]}
    args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {args.json}")
    return 0


def scenes() -> dict[str, Callable[[], Scene]]:
    """By name; made when asked for."""
    found: dict[str, Callable[[], Scene]] = {
        "plane": lambda: plane(0.0),
        "plane, balls": lambda: plane(0.005 / np.sqrt(2)),
    }
    for shape in shapes(with_meshes=False)[:2]:
        for is_inset in (False, True):
            name = f"{shape.name}, balls" if is_inset else shape.name

            def made(shape=shape, is_inset=is_inset) -> Scene:  # type: ignore[no-untyped-def]
                points, truth = points_around(shape, NUM_POINTS, *BAND, seed=1)
                return *splats_on(shape, 0.01, is_inset=is_inset, seed=0), points, truth

            found[name] = made
    return found


def plane(radius: float) -> Scene:
    """Splats every 5 mm, their spheres touching z = 0 from below."""
    axis = np.arange(-0.4, 0.4, 0.005)
    x, y = np.meshgrid(axis, axis)
    centers = np.stack([x.ravel(), y.ravel(), np.full(x.size, -radius)], axis=1)
    points = np.random.default_rng(1).uniform([-0.1, -0.1, BAND[0]], [0.1, 0.1, BAND[1]], (NUM_POINTS, 3))
    return centers, np.full(len(centers), radius), points, points[:, 2]


def measured(name: str, scene: Scene) -> Row:
    """The field before and after marching."""
    centers, radii, points, truth = scene
    field, exact = GpdfField(centers, radii), SphereField(centers, radii)
    errors = {steps: march(field, exact, points, steps=steps).distance - truth for steps in STEPS}
    return Row(
        scene=name,
        num_splats=len(radii),
        plain=rms(field.query(points)[0] - truth),
        marched={steps: rms(error) for steps, error in errors.items()},
        bias=float(errors[5].mean()),
        hard=rms(exact.query(points)[0] - truth),
    )


def rms(error: Float64) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(error**2)))


if __name__ == "__main__":
    raise SystemExit(main())
