"""How steep the Gaussian kernel field can be: the bound of docs/paper.md, tried in and between splats."""

import numpy as np
import pytest

from splatctrl_cli.field.distance import SeField

LENGTH = 0.02


@pytest.mark.parametrize("seed", range(8))
def test_no_slope_of_the_gaussian_field_exceeds_its_bound_and_some_exceed_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    centers = np.concatenate([random.uniform(-0.1, 0.1, (150, 3)), random.normal(size=(50, 3)) * 0.02])
    radii = random.uniform(0.001, 0.02, 200)
    field = SeField(centers, radii, LENGTH)
    points = np.concatenate([random.uniform(-0.25, 0.25, (800, 3)), centers + random.normal(size=(200, 3)) * 0.02])
    distance, gradient = field.query_raw(points)
    there = ~np.isnan(distance)
    points, gradient = points[there], gradient[there]
    exponent = -(np.linalg.norm(points[:, None] - centers, axis=2) ** 2) / (2 * LENGTH**2) + field.weights.log_size
    log_sum = np.logaddexp.reduce(exponent, axis=1)
    share = np.exp(exponent - log_sum[:, None])
    root_squared = -2 * LENGTH**2 * log_sum
    entropy = -np.sum(share * (exponent - log_sum[:, None]), axis=1)
    spread = np.sqrt(np.sum(share * (radii - (share @ radii)[:, None]) ** 2, axis=1))
    place = np.sqrt(np.einsum("qn,qn->q", share, np.sum((centers - (share @ centers)[:, None]) ** 2, axis=2)))
    bound = np.sqrt(1 + 2 * LENGTH**2 * entropy / root_squared) + spread * place / LENGTH**2
    slope = np.linalg.norm(gradient, axis=1)
    assert np.all(field.weights.log_size <= 0)
    assert np.all(slope <= bound * 1.01 + 1e-3)  # float32, and terms that may be left out
    assert slope.max() > 1.1
