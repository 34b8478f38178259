"""Seeded tables: the same again, standing on the table, apart from each other and from the arm's base."""

import numpy as np
import pytest

from benchmarks.random_tabletop import FREE_OF_BASE, GAP, NUM_THINGS, REGION, random_things
from splatctrl_cli.simulate.primitives import signed_distance

SEEDS = range(12)


@pytest.mark.parametrize("seed", SEEDS)
def test_things_stand_on_the_table_and_do_not_touch(seed: int) -> None:
    things = random_things(seed)
    assert NUM_THINGS[0] <= len(things) <= NUM_THINGS[1]
    assert len({thing.name for thing in things}) == len(things)
    for thing in things:
        position = thing.T_world_shape[:3, 3]
        assert np.all(position[:2] >= REGION[0]) and np.all(position[:2] <= REGION[1])
        below = np.array([[*position[:2], -1e-9], [*position[:2], 1e-9]])
        assert signed_distance(thing, below)[0] >= 0 >= signed_distance(thing, below)[1]
        around = np.linspace(0, 2 * np.pi, 64)
        others = [other for other in things if other is not thing]
        ring = thing.bounding_radius * np.column_stack([np.cos(around), np.sin(around), np.zeros(64)]) * 0.2
        for other in others:
            assert np.min(signed_distance(other, position + ring)) > 0
            assert np.linalg.norm((other.T_world_shape - thing.T_world_shape)[:2, 3]) > GAP
        assert signed_distance(thing, np.array([[0.0, 0.0, position[2]]]))[0] > FREE_OF_BASE - 1e-9


def test_the_same_seed_gives_the_same_things_and_another_one_others() -> None:
    one, again, other = random_things(5), random_things(5), random_things(6)
    assert [thing.size for thing in one] == [thing.size for thing in again] != [thing.size for thing in other]
    assert all(np.array_equal(a.T_world_shape, b.T_world_shape) for a, b in zip(one, again, strict=True))


def test_all_kinds_of_things_are_drawn() -> None:
    assert {thing.kind for seed in SEEDS for thing in random_things(seed)} == {"box", "cylinder", "sphere"}
