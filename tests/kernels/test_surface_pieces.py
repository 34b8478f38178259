"""Pieces of surface in a depth image, against SciPy's connected components."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from splatctrl_cli.kernels import native
from splatctrl_cli.records import Bool, Float32, Float64


def expected_areas(depth: Float32, steps: Float32, area: Float64, is_object: Bool, asked: Bool) -> Float64:
    """Of every asked pixel the area of its piece; all that is not asked is one pixel more."""
    height, width = depth.shape
    beyond = height * width
    number = np.where(asked, np.arange(beyond).reshape(height, width), beyond)
    pairs = []
    for v, u in np.argwhere(is_object):
        for y, x in ((v, u + 1), (v + 1, u - 1), (v + 1, u), (v + 1, u + 1)):
            if not (y < height and 0 <= x < width and is_object[y, x] and (asked[v, u] or asked[y, x])):
                continue
            if abs(depth[v, u] - depth[y, x]) < min(steps[v, u], steps[y, x]):
                pairs.append((number[v, u], number[y, x]))
    ends = np.array(pairs).reshape(-1, 2).T
    graph = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(beyond + 1, beyond + 1))
    piece = connected_components(graph, directed=False)[1]
    total = np.bincount(piece[:-1], np.where(asked, area, 0.0).ravel(), piece.max() + 1)
    total[piece[beyond]] = np.inf
    return np.where(asked, total[piece[:-1]].reshape(height, width), np.inf)


@pytest.mark.parametrize("is_asked_here_and_there", [False, True])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_piece_is_what_small_steps_join(share: float, is_asked_here_and_there: bool) -> None:
    rng = np.random.default_rng(0)
    depth = rng.choice(np.array([1.0, 1.005, 1.01, 1.04], np.float32), (40, 50))
    steps = rng.choice(np.array([0.004, 0.006, 0.02], np.float32), depth.shape)
    area, is_object = rng.random(depth.shape), rng.random(depth.shape) < share
    asked = is_object & ((rng.random(depth.shape) < 0.02) if is_asked_here_and_there else (np.arange(50) < 35))
    total = np.empty(depth.shape)
    native.piece_areas(depth, steps, area, is_object.view(np.uint8), asked.view(np.uint8), total)
    np.testing.assert_array_equal(total, expected_areas(depth, steps, area, is_object, asked))
    assert np.isinf(total[asked]).any() and (is_asked_here_and_there or len(np.unique(total)) > 10)
