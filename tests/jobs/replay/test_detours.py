"""The distances in which the closed loop's ways out of local minima are planned."""

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.jobs.replay.known_scene import certified_distance, splat_fields
from tests.cli.replay_desk import splats_of


def test_what_is_planned_in_never_exceeds_the_exact_distance_and_the_kernel_field_is_no_proof() -> None:
    """Beside and between splats of many sizes: certified <= the exact distance in float64 everywhere, which is
    1-Lipschitz; the controller's own field is steeper than that somewhere, so nothing follows from its samples.
    """
    steepest = 0.0
    for seed in range(12):
        random = np.random.default_rng(seed)
        centers = random.uniform(-1.5, 1.5, (200, 3)).astype(np.float32)
        centers[100:] = centers[0] + random.normal(size=(100, 3)) * 0.03
        radii = random.uniform(0.002, 0.02, 200).astype(np.float32)
        fields = splat_fields(splats_of(*zip(map(tuple, centers), map(float, radii), strict=True)), Config(), 1)  # type: ignore[arg-type]
        points = np.concatenate(
            [
                random.uniform(-3, 3, (500, 3)),
                centers[100:] + random.normal(size=(100, 3)) * 0.02,
                centers.astype(float),
            ]
        )
        gap = np.linalg.norm(points[:, None] - centers.astype(np.float64), axis=2) - radii.astype(np.float64)
        certified = certified_distance(fields)(points)
        assert np.all(certified < gap.min(axis=1))
        assert np.all(certified > gap.min(axis=1) - 3e-5)
        near = points + random.normal(size=points.shape) * 2e-3
        change = np.abs(fields.barrier.query(near)[0] - fields.barrier.query(points)[0])
        steepest = max(steepest, float(np.max(change / np.linalg.norm(near - points, axis=1))))
    assert steepest > 1.2
