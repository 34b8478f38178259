"""Pairing of colour and depth by stamp."""

import numpy as np
import pytest

from splatctrl_cli.logs.image_stamps import pair_by_stamp


def test_each_image_pairs_with_the_nearest_in_time() -> None:
    assert pair_by_stamp([0, 100, 200], [3, 98, 205], 20) == [(0, 0), (1, 1), (2, 2)]


def test_images_further_apart_than_the_tolerance_stay_alone() -> None:
    assert pair_by_stamp([0, 100], [20, 121], 20) == [(0, 0)]


def test_a_depth_image_serves_the_closest_colour_image_only() -> None:
    assert pair_by_stamp([0, 10], [9], 20) == [(1, 0)]


def test_order_in_the_file_does_not_matter_and_indices_refer_to_it() -> None:
    assert pair_by_stamp([200, 0, 100], [101, 201, 1], 20) == [(1, 2), (2, 0), (0, 1)]


def test_equally_close_pairs_go_to_the_earlier_one() -> None:
    assert pair_by_stamp([0, 20], [10], 20) == [(0, 0)]


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
