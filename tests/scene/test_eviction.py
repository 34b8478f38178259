"""Who gives a slot to surface that has none: what others stand for too, then what is far from the robot's path."""

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import EVICT_EVERY, EVICT_NEARER
from splatctrl_cli.records import Box, Label, SplatSet
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.eviction import distance_to_box, far_away, redundant, room_for
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.voxels import SWEPT
from tests.plain import plain_splats
from tests.reference.unrepresented import unrepresented
from tests.scene.wall import WORKSPACE, frame

PATH = Box(lower=np.zeros(3), upper=np.ones(3))


def floor(spacing: float) -> SplatSet:
    """Splats all over a square of 40 cm."""
    steps = np.arange(0.0, 0.4, spacing)
    return plain_splats([[x, y, 0.0] for x in steps for y in steps], 0.01)


def voxels() -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    steps = np.arange(0.0, 0.4, 0.02)
    return np.float32([[x, y, 0.004] for x in steps for y in steps])


def bare(splats: SplatSet, tolerance: float) -> int:
    return int(unrepresented(voxels(), splats.centers.astype(float), splats.radii.astype(float), tolerance).sum())


def test_what_is_given_up_leaves_no_surface_bare() -> None:
    splats = floor(0.02)
    order = np.random.default_rng(0).permutation(len(splats))
    gone = redundant(order, len(splats), splats, voxels(), 0.018)
    assert 50 < len(gone) < len(splats)
    kept = splats.select(~np.isin(np.arange(len(splats)), gone))
    assert bare(splats, 0.018) == bare(kept, 0.018) == 0
    assert len(redundant(np.arange(len(kept)), len(kept), kept, voxels(), 0.018)) == 0


def test_the_first_in_the_order_go_and_no_more_than_are_wanted() -> None:
    splats = floor(0.02)
    order = np.arange(len(splats))[::-1]
    gone = redundant(order, 3, splats, voxels(), 0.018)
    assert len(gone) == 3
    assert gone[0] == order[0]


def test_the_only_splat_of_a_surface_is_not_redundant() -> None:
    pair = plain_splats([[0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [0.3, 0.3, 0.0]], 0.01)
    surface = np.float32([[0.1, 0.1, 0.0], [0.3, 0.3, 0.0]])
    assert redundant(np.array([2, 0, 1]), 3, pair, surface, 0.018).tolist() == [0]


@pytest.mark.parametrize(("distance", "count"), [(EVICT_NEARER - 0.01, 0), (EVICT_NEARER + 0.01, 1)])
def test_a_surface_gives_way_to_one_that_is_much_nearer_to_the_path(distance: float, count: int) -> None:
    seeds = np.float32([[1.1, 0.5, 0.5]])
    centers = np.float32([[1.1 + distance, 0.5, 0.5], [0.5, 0.5, 0.5]])
    assert far_away(5, seeds, centers, PATH).tolist() == [0] * count


def test_the_farthest_go_first() -> None:
    centers = np.float32([[2.0, 0, 0], [4.0, 0, 0], [3.0, 0, 0]])
    assert far_away(2, np.float32([[0.5, 0, 0], [0.2, 0, 0], [0.1, 0, 0]]), centers, PATH).tolist() == [1, 2]
    assert distance_to_box(centers, PATH).tolist() == [1.0, 3.0, 2.0]


def test_people_and_the_robot_keep_their_splats() -> None:
    buffer, occupancy = (
        SplatBuffer(6),
        OccupancyMap(Box(lower=np.zeros(3), upper=np.full(3, 4.0)), OccupancyConfig(voxel=0.1), 1),
    )
    places = np.float32([[3.9, 3.9, 3.9]] * 6)
    buffer.fill(Seeds(centers=places, radii=np.full(6, 0.02, np.float32), colors=np.zeros((6, 3), np.float32)), 0.5)
    buffer.labels[:4] = [Label.ROBOT, Label.ROBOT, Label.HUMAN, Label.HUMAN]
    occupancy.entity[:3, :3, :3] = SWEPT
    seeds = Seeds(centers=places * 0.1, radii=np.full(6, 0.02, np.float32), colors=np.zeros((6, 3), np.float32))
    is_evicted, _ = room_for(seeds, 6, buffer, occupancy, np.zeros(6), 0.018)
    assert np.flatnonzero(is_evicted).tolist() == [4, 5]


def test_a_full_budget_makes_room_for_a_block_and_then_rests() -> None:
    config = SceneConfig(max_splats=300, first_iterations=30, iterations_per_step=4, gap_reserve=0.0, fill=1.0)
    fitter = SceneFitter(config, OccupancyConfig(), WORKSPACE)
    rows = [fitter.step([frame(i, y=0.05), frame(i, y=-0.05)]) for i in range(2)]
    assert (~fitter.buffer.is_alive).sum() < 30
    rows += [fitter.step([frame(i, block=0.15, y=0.05), frame(i, block=0.15, y=-0.05)]) for i in range(2, 26)]
    evicted = [row.evicted for row in rows]
    assert sum(evicted) > 0
    assert [row.removed["evicted"] for row in rows] == evicted
    assert {i % EVICT_EVERY for i, count in enumerate(evicted) if count} == {0}
    assert rows[-1].unrepresented < 0.5 * max(row.unrepresented for row in rows)
    assert sum(evicted[-10:]) <= 0.2 * sum(evicted)  # what was given up does not come back
