"""Errors of the Matern field after sphere marching, by shape and number of steps.

Splats are 5 mm apart on a plane, and 1 cm apart on a box and a ball. They have no radii, or are balls that touch the
surface from inside. Points are 1 to 10 cm outside. Error is the root mean square of distance minus truth. `hard` is
the exact distance to the splats.
"""

from collections.abc import Callable

import numpy as np

from benchmarks.measure import Options, Result, rms
from benchmarks.surfaces import points_around, shapes, splats_on
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SphereField, march
from splatctrl_cli.records import Float64

STEPS = (1, 3, 5, 10)
BAND = (0.01, 0.10)  # [m] of true distance
NUM_POINTS = 4000

Scene = tuple[Float64, Float64, Float64, Float64]  # centres, radii, points, truth


def run(options: Options) -> Result:
    """RMSE of the plain field, of the field after each number of steps, and of `hard`; bias after 5 steps."""
    chosen = list(scenes().items())[:: 2 if options.is_quick else 1]
    return Result(
        title="marching: RMSE [mm]",
        columns=("splats on", "splats", "gpdf", *(f"{steps} steps" for steps in STEPS), "bias of 5", "hard"),
        rows=[measured(name, make()) for name, make in chosen],
    )


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


def measured(name: str, scene: Scene) -> list[str]:
    """The field before and after marching."""
    centers, radii, points, truth = scene
    field, exact = GpdfField(Spheres.of(centers, radii)), SphereField(Spheres.of(centers, radii))
    errors = {steps: march(field, exact, points, steps=steps)[2] - truth for steps in STEPS}
    plain, hard = (rms(one.query(points)[0] - truth) for one in (field, exact))
    figures = (plain, *map(rms, errors.values()), float(errors[5].mean()), hard)
    return [name, str(len(radii)), *(f"{1e3 * value:.2f}" for value in figures)]
