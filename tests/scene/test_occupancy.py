"""The occupancy grid: what one camera over a floor sees."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import back_project, invert_transform, look_at, transform_points
from splatctrl_cli.records import Box, Float64, Intrinsics, Label, RgbdFrame
from splatctrl_cli.scene.occupancy import MAX_STEPS, OccupancyMap
from splatctrl_cli.voxels import NO_EDGES, SWEPT, Balls, EvidenceClass
from tests.plain import plain_frame
from tests.reference.occupancy import ray_walk
from tests.refused import expect_refusal
from tests.scene.wall import WORKSPACE, frame

CONFIG = OccupancyConfig(voxel=0.05)
NO_BALLS = Balls.from_voxels(np.zeros((0, 3), np.float32), 0.05, np.zeros(0, np.uint8))
AROUND = Box(lower=np.array([-0.63, -0.61, -0.17]), upper=np.array([0.98, 0.94, 1.02]))  # the tilted camera is in it


def tilted(*, rod: bool = False, holes: float = 0.0) -> RgbdFrame:
    """What a tilted camera sees of the floor z = 0 and of a rod, thinner than a voxel, that may stand before it."""
    k = Intrinsics(fx=48.0, fy=48.0, cx=23.0, cy=18.0, width=48, height=36)
    T = look_at((0.7, 0.5, 0.8), (0.0, 0.0, 0.1))
    rays = back_project(k, np.ones((k.height, k.width))) @ T[:3, :3].T
    depth = (-T[2, 3] / np.minimum(rays[..., 2], -1e-6)).astype(np.float32)
    if rod:
        depth[6:30, 20] = 0.6
    depth[(depth > 2.5) | (np.random.default_rng(0).random(depth.shape) < holes)] = 0.0
    return plain_frame(depth, k, T)


def centers(grid: OccupancyMap) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(X, Y, Z, 3) [m], world."""
    return grid.origin + grid.config.voxel * np.stack(np.indices(grid.log_odds.shape), -1)


def seen(*, block: float = 0.0, times: int = 3, config: OccupancyConfig = CONFIG) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, config, 1)
    for _ in range(times):
        grid.integrate(frame(block=block))
    return grid


def by_the_tilted(view: RgbdFrame) -> tuple[OccupancyMap, Float64, Float64]:
    """A grid that takes it in, the depths of its voxels and their columns in the image."""
    grid = OccupancyMap(AROUND, CONFIG, 1)
    grid.integrate(view)
    points = transform_points(invert_transform(view.T_world_camera), centers(grid))
    return grid, points[..., 2], points[..., 0] / points[..., 2] * view.intrinsics.fx + view.intrinsics.cx


def test_air_is_free_floor_is_occupied_and_below_was_never_seen() -> None:
    """And free again where a block leaves."""
    grid = seen(block=0.2, times=10)
    points = np.float32([[0.2, 0.2, 0.3], [0.2, 0.2, 0.0], [0.0, 0.0, 0.2], [0.0, 0.0, 0.08]])
    value, is_observed = grid.occupancy_around(points)
    assert value[0] < 0.3 and value[1:3].min() > 0.7
    assert is_observed.tolist() == [True, True, True, False]
    for _ in range(10):
        grid.integrate(frame())
    assert grid.occupancy_around(points)[0][2] < 0.3


def test_a_hit_outweighs_the_misses_of_the_same_image() -> None:
    grid = seen(times=1)
    hit, miss = (grid.log_odds == np.float32(value) for value in (CONFIG.log_odds_hit, CONFIG.log_odds_miss))
    assert (hit | miss | (grid.num_updates == 0)).all() and grid.num_updates.max() == 1
    assert 200 < hit.sum() < 600  # the visible floor is 0.9 x 0.7 m in 5 cm voxels


@pytest.mark.parametrize(("rod", "holes", "share"), [(False, 0.0, 1.0), (True, 0.0, 0.95), (True, 0.3, 0.9)])
def test_what_rays_pass_is_free_and_what_holds_a_point_is_hit(rod: bool, holes: float, share: float) -> None:
    """Left out are voxels that rays pass only beside their centre: at the rim of the view, of holes, of a shadow."""
    grid, view = OccupancyMap(AROUND, OccupancyConfig(voxel=0.08), 2), tilted(rod=rod, holes=holes)
    grid.integrate(view)
    passed, hit = ray_walk(view, grid.origin, 0.08, grid.log_odds.shape)
    is_free = grid.log_odds < 0
    assert ((grid.log_odds > 0) == hit).all() and not (is_free & ~passed).any()
    within = binary_erosion(passed | hit, np.ones((3, 3, 3))) & passed
    assert within.sum() > 300 and is_free[within].mean() >= share
    assert ((grid.num_updates > 0) == (is_free | hit)).all()


def test_what_stands_behind_a_thin_thing_is_not_free() -> None:
    view = tilted()
    view.depth[:, 16:24] = 0.6
    grid, z, u = by_the_tilted(view)
    is_behind = (z > 0.6) & (u > 16) & (u < 23)
    assert is_behind.sum() > 1000 and not (grid.log_odds[is_behind] < 0).any()


def test_pixels_without_depth_free_nothing_of_their_own() -> None:
    view = tilted()
    view.depth[:, 16:] = 0.0
    grid, z, u = by_the_tilted(view)
    is_blind = (z > 0.05) & (u > 16 + view.intrinsics.fx * CONFIG.voxel / z)
    assert is_blind.sum() > 1000 and not grid.num_updates[is_blind].any()


@pytest.mark.parametrize(
    "view", [tilted(), tilted(holes=0.3), replace(tilted(), depth=np.zeros((36, 48), np.float32))]
)
def test_what_an_image_changes_is_last_seen_in_its_time_step(view: RgbdFrame) -> None:
    """An image without depth renews nothing."""
    grid = OccupancyMap(AROUND, OccupancyConfig(voxel=0.08), 2)
    grid.take_in([frame(stamp_ns=7)])
    first, counts = grid.last_seen.copy(), grid.num_updates.copy()
    assert ((first == 1) == (counts > 0)).all()
    grid.take_in([replace(view, stamp_ns=9)])
    is_seen = grid.num_updates > counts
    assert (grid.last_seen == np.where(is_seen, 2, first)).all() and is_seen.any() == view.depth.any()
    assert grid.step_stamps_ns == [7, 9]


def test_beyond_the_most_time_steps_the_evidence_is_never_said_to_be_younger_than_it_is() -> None:
    grid, blind = OccupancyMap(WORKSPACE, CONFIG, 1), frame(stamp_ns=65_535)
    grid.take_in([frame(stamp_ns=0)])
    assert MAX_STEPS == 65_519
    grid.step_stamps_ns = list(range(65_519))
    grid.last_seen.ravel()[-6:] = [0, 1, 2, 3, 65_518, 65_519]
    grid.take_in([replace(blind, depth=np.zeros_like(blind.depth))])
    stamps_ns = np.concatenate([[-1], grid.step_stamps_ns])[grid.last_seen.ravel()[-6:]]
    assert (stamps_ns.tolist(), grid.step_stamps_ns[-1]) == ([-1, 0, 0, 2, 65_516, 65_518], 65_535)


def test_thread_count_does_not_change_a_bit() -> None:
    one, *others = (OccupancyMap(AROUND, OccupancyConfig(voxel=0.02), threads) for threads in (1, 2, 5))
    for grid in (one, *others):
        for view in (tilted(), tilted(holes=0.5), frame(block=0.1)):
            grid.take_in([view])
        for name in ("log_odds", "num_updates", "last_seen"):
            assert getattr(grid, name).tobytes() == getattr(one, name).tobytes()


def test_depth_beyond_the_range_hits_nothing_and_frees_what_is_within() -> None:
    """And depth nearer than the range says nothing."""
    grid = seen(times=1, config=replace(CONFIG, max_range=0.9))
    x, y, z = np.moveaxis(centers(grid), -1, 0)
    is_in_view = (np.abs(x) < 0.4 * (1.0 - z)) & (np.abs(y) < 0.3 * (1.0 - z))
    assert not (grid.log_odds > 0).any() and (grid.log_odds[is_in_view & (1.0 - z < 0.9)] < 0).all()
    assert not grid.num_updates[1.0 - z > 0.9].any()
    assert not seen(times=1, config=replace(CONFIG, min_range=1.1)).num_updates.any()


def test_counts_and_log_odds_stop_at_their_limits() -> None:
    grid = seen(times=1)
    grid.num_updates[grid.num_updates > 0] = 65535
    for _ in range(20):
        grid.integrate(frame())
    assert (set(np.unique(grid.num_updates)), set(np.unique(grid.log_odds))) == ({0, 65535}, {-2.0, 0.0, 2.0})


def test_robot_bits_are_where_a_sphere_is_and_swept_bits_where_one_was() -> None:
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    for x in (0.3, 0.0):
        grid.mark_robot(np.array([[x, 0.0, 0.3]]), np.array([0.1]))
    points = np.float32([[0.0, 0.0, 0.3], [0.09, 0.0, 0.3], [0.3, 0.0, 0.3], [5.0, 0.0, 0.0]])
    assert (grid.entity_at(points) == [Label.ROBOT | SWEPT, Label.ROBOT | SWEPT, SWEPT, 0]).all()


def look(grid: OccupancyMap, view: RgbdFrame, cameras: str) -> None:
    """Take in an image of one of `cameras`, with a robot far away."""
    grid.keep_edges(dict.fromkeys(cameras, NO_EDGES))
    grid.take_in([view])
    nothing = np.zeros(view.depth.shape, bool)
    grid.label_robot(np.array([[0.4, 0.3, 0.55]]), np.array([0.01]), [(view, nothing, ~nothing)])


@pytest.mark.parametrize(("cameras", "cls"), [("A", EvidenceClass.HIDDEN_BY_THING), ("AB", EvidenceClass.FREE)])
def test_behind_an_object_that_arrived_no_earlier_view_counts(cameras: str, cls: int) -> None:
    """Views of the last round count if cameras expose in turn. Views of space 25 cm behind it always count."""
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    behind = np.array([[0.0, 0.0, 0.27], [0.0, 0.0, 0.05], [0.2, 0.0, 0.3]])  # the last stays in view
    look(grid, frame(1), cameras)
    look(grid, frame(2, block=0.3), cameras)
    assert grid.known(NO_BALLS).seen.look(behind)[1].tolist() == [cls, EvidenceClass.FREE, EvidenceClass.FREE]
    look(grid, frame(3), cameras)
    stamps, classes = grid.known(NO_BALLS).seen.look(behind)
    assert stamps.tolist() == 3 * [3] and (classes == EvidenceClass.FREE).all()


def test_behind_an_object_that_stands_still_earlier_views_count() -> None:
    """The robot may hide the space beside a table for a while."""
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    for stamp in range(1, 9):
        look(grid, frame(stamp, block=0.3), "A")
    under = grid.last_seen[8:10, 6:8, 6]
    assert not under.any()
    under[:] = 5  # by another camera
    look(grid, frame(9, block=0.3), "A")
    assert (under == 5).all()


def test_a_workspace_too_large_for_its_voxels_is_refused() -> None:
    expect_refusal(
        "too large", OccupancyMap, Box(lower=np.zeros(3), upper=np.full(3, 100.0)), CONFIG, 1, error=UsageError
    )
