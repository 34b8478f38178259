"""Pairing of colour and depth by stamp."""

import numpy as np
import pytest

from splatctrl_cli.logs.image_stamps import pair_by_stamp


@pytest.mark.parametrize("seed", range(20))
def test_pairs_are_those_of_every_pair_tried_in_turn(seed: int) -> None:
    random = np.random.default_rng(seed)
    color, depth = (random.integers(0, 200, random.integers(0, 40)).tolist() for _ in range(2))
    tolerance = int(random.integers(0, 30))
    near = [(abs(a - b), a, b, i, j) for i, a in enumerate(color) for j, b in enumerate(depth)]
    expected: dict[int, int] = {}
    for gap, _, _, i, j in sorted(near):
        if gap <= tolerance and i not in expected and j not in expected.values():
            expected[i] = j
    assert pair_by_stamp(color, depth, tolerance) == sorted(
        expected.items(), key=lambda pair: (color[pair[0]], pair[0])
    )
