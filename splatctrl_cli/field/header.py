"""The header of a baked field."""

from collections.abc import Collection
from dataclasses import asdict

import numpy as np

from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.health import field_health
from splatctrl_cli.field.unknown import label_counts
from splatctrl_cli.records import Label, SplatSet

MEANING = {
    "safe": "min(se, hard)",
    "safe_gpdf": "min(gpdf, hard)",
    "hard": "exact distance to the splats' spheres",
    "se": "squared-exponential field; hard where it has no value",
    "gpdf": "Matern-1/2 field of the paper; hard where it has no value",
}


def field_header(
    splats: SplatSet,
    chosen: SplatSet,
    labels: Collection[Label],
    baker: Baker,
    *,
    has_occupancy: bool,
    num_unrepresented: int = 0,
) -> dict[str, object]:
    """Header of `baker`'s bake of `chosen`: labelled `splats`, then `num_unrepresented` balls."""
    config = baker.config
    header: dict[str, object] = {
        "format": "splatctrl distance grid",
        "version": 2,
        "sign": "positive outside",
        "frame": "world",
        "units": "m",
        "origin": "centre of cell (0, 0, 0)",
        "distance": config.distance,
        "sdf": MEANING[config.distance],
        "gradient": "of sdf, not normalised",
        "bound": "no point of the cell is nearer to a splat's sphere; bound + bound_margin is hard at its centre",
        "bound_margin": baker.bound_margin,
        "kernel": {None: "none", "se": "squared exponential", "gpdf": "matern 1/2"}[baker.kernel_name],
        "length_scale": config.length_scale,
        "noise": config.noise,
        "weights": config.weights,
        "truncation_bound": config.truncation,
        "kernel_counts": dict(baker.counts),
        "unknown": config.unknown,
        "observed": "from the occupancy grid" if has_occupancy else "no occupancy grid: all never seen",
        "inside": "a shell: cells deep inside a closed object read positive; take the sign there from observed",
        "labels": sorted(label.name.lower() for label in labels),
        "splats_given": label_counts(splats),
        "splats_used": label_counts(chosen.select(np.arange(len(chosen)) < len(chosen) - num_unrepresented)),
        "unrepresented_voxels": num_unrepresented,
        "radius": {
            "min": float(chosen.radii.min()),
            "median": float(np.median(chosen.radii)),
            "mean": float(chosen.radii.mean(dtype=np.float64)),
            "max": float(chosen.radii.max()),
        },
        "health": asdict(field_health(chosen.centers, chosen.radii, config.length_scale, kernels=baker.kernels)),
    }
    if baker.probability is not None:
        header |= {"probability": config.probability, "probability_numbers": baker.probability.described()}
    solved = {
        name: {"num_iterations": field.weights.num_iterations, "residual": field.weights.residual}
        for name, field in (("se", baker.se), ("gpdf", baker.gpdf))
        if field is not None and field.weights.num_iterations is not None
    }
    return header | ({"weights_solved": solved} if solved else {})
