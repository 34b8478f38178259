"""The occupancy grid: what one camera over a floor sees."""

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import SWEPT, Box, Label
from splatctrl_cli.scene.occupancy import OccupancyMap
from tests.scene.wall import WORKSPACE, frame

CONFIG = OccupancyConfig(voxel=0.05)


def seen(*, block: float = 0.0, times: int = 3, threads: int = 1) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, CONFIG, threads)
    for _ in range(times):
        grid.integrate(frame(block=block))
    return grid


def test_air_is_free_floor_is_occupied_and_below_was_never_seen() -> None:
    grid = seen(block=0.2)
    points = np.float32([[0.2, 0.2, 0.3], [0.2, 0.2, 0.0], [0.0, 0.0, 0.2], [0.0, 0.0, 0.08]])
    value, is_observed = grid.occupancy_around(points)
    assert value[0] < 0.3
    assert value[1] > 0.7
    assert value[2] > 0.7
    assert is_observed.tolist() == [True, True, True, False]


def test_a_hit_outweighs_the_misses_of_the_same_image() -> None:
    grid = seen(times=1)
    hit = grid.log_odds == np.float32(CONFIG.log_odds_hit)
    miss = grid.log_odds == np.float32(CONFIG.log_odds_miss)
    assert (hit | miss | (grid.num_updates == 0)).all()
    assert grid.num_updates.max() == 1
    assert 200 < hit.sum() < 600  # the visible floor is 0.9 x 0.7 m in 5 cm voxels


def test_a_block_that_leaves_becomes_free_again() -> None:
    grid = seen(block=0.2, times=10)
    top = np.float32([[0.0, 0.0, 0.2]])
    assert grid.occupancy_around(top)[0][0] > 0.7
    for _ in range(10):
        grid.integrate(frame())
    assert grid.occupancy_around(top)[0][0] < 0.3


def test_thread_count_does_not_change_a_bit() -> None:
    one, two = seen(block=0.1, threads=1), seen(block=0.1, threads=2)
    assert one.log_odds.tobytes() == two.log_odds.tobytes()
    assert one.num_updates.tobytes() == two.num_updates.tobytes()


def test_depth_beyond_the_range_says_nothing() -> None:
    grid = OccupancyMap(WORKSPACE, OccupancyConfig(voxel=0.05, max_range=0.9), 1)
    grid.integrate(frame())
    assert not grid.num_updates.any()


def test_robot_bits_are_where_a_sphere_is_and_swept_bits_where_one_was() -> None:
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    grid.mark_robot(np.array([[0.3, 0.0, 0.3]]), np.array([0.1]))
    grid.mark_robot(np.array([[0.0, 0.0, 0.3]]), np.array([0.1]))
    points = np.float32([[0.0, 0.0, 0.3], [0.09, 0.0, 0.3], [0.3, 0.0, 0.3], [5.0, 0.0, 0.0]])
    robot = Label.ROBOT | SWEPT
    assert (grid.entity_at(points) == [robot, robot, SWEPT, 0]).all()


def test_a_workspace_too_large_for_its_voxels_is_refused() -> None:
    with pytest.raises(UsageError, match="too large"):
        OccupancyMap(Box(lower=np.zeros(3), upper=np.full(3, 100.0)), CONFIG, 1)
