"""Robot and human labels: where they come from, and that nothing is left behind when they go."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Label, RgbdFrame, SplatSet, UInt8
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.labels import human_splats, inside_spheres, relabel
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from tests.scene.wall import WORKSPACE, frame

VISITOR = 0.2  # [m] height of the block that stands for a person


def masked(view: RgbdFrame) -> RgbdFrame:
    """The frame with the block, which is all that is above the floor, as a person."""
    return replace(view, human=((view.depth > 0) & (view.depth < 0.99)).astype(np.uint8))


def blind(view: RgbdFrame) -> RgbdFrame:
    """The frame with a mask that shows nobody."""
    return replace(view, human=np.zeros(view.depth.shape, np.uint8))


def grid_of(*views: RgbdFrame) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, OccupancyConfig(), 1)
    for view in views:
        grid.take_in([view])
    return grid


def humans(grid: OccupancyMap) -> int:
    return int((grid.entity & Label.HUMAN > 0).sum())


def test_human_voxels_are_those_that_hold_the_point_of_a_human_pixel() -> None:
    view = masked(frame(block=0.21, x=0.013))
    grid = grid_of(view)
    points = transform_points(view.T_world_camera, back_project(view.intrinsics, view.depth.astype(np.float64)))
    assert view.human is not None
    cells = np.floor((points[view.human > 0] - WORKSPACE.lower) / grid.config.voxel).astype(int)
    expected = np.zeros(grid.entity.shape, bool)
    expected[tuple(cells.T)] = True
    assert ((grid.entity & Label.HUMAN > 0) == expected).all()
    assert 50 < expected.sum() < 200


def test_a_voxel_is_human_no_longer_when_other_pixels_hit_it() -> None:
    view = frame(block=VISITOR)
    assert humans(grid_of(masked(view))) > 50
    assert humans(grid_of(masked(view), blind(view))) == 0


def test_a_voxel_is_human_no_longer_when_a_ray_passes_it() -> None:
    grid = grid_of(*[masked(frame(block=VISITOR))] * 5)
    num_before = humans(grid)
    assert num_before > 50
    grid.take_in([blind(frame())])
    assert humans(grid) == 0


def test_a_person_who_enters_long_free_space_is_human_at_once() -> None:
    view = masked(frame(block=VISITOR))
    assert humans(grid_of(*[blind(frame())] * 8, view)) == humans(grid_of(view)) > 50


def test_a_voxel_that_no_masked_image_sees_stays_human() -> None:
    view = masked(frame(block=VISITOR))
    assert humans(grid_of(view, frame(block=VISITOR))) == humans(grid_of(view))  # an image without a mask
    dark = replace(blind(view), depth=np.zeros_like(view.depth))
    assert humans(grid_of(view, dark)) == humans(grid_of(view))


def test_of_one_time_step_any_camera_that_sees_a_person_counts_whatever_the_order() -> None:
    view = frame(block=VISITOR)
    for views in ([masked(view), blind(view)], [blind(view), masked(view)]):
        grid = OccupancyMap(WORKSPACE, OccupancyConfig(), 1)
        grid.take_in(views)
        assert humans(grid) == humans(grid_of(masked(view)))


def test_thread_count_does_not_change_a_bit() -> None:
    grids = [OccupancyMap(WORKSPACE, OccupancyConfig(), threads) for threads in (1, 3)]
    for grid in grids:
        for view in (masked(frame(block=VISITOR)), masked(frame(block=VISITOR, x=0.15))):
            grid.take_in([view])
    assert grids[0].entity.tobytes() == grids[1].entity.tobytes()


def splats_at(*centers: tuple[float, float, float]) -> SplatBuffer:
    slots = SplatBuffer(len(centers) + 2)
    seeds = Seeds(
        centers=np.float32(centers),
        radii=np.full(len(centers), 0.02, np.float32),
        colors=np.zeros((len(centers), 3), np.float32),
    )
    slots.fill(seeds, 0.5)
    return slots


TOP, BELOW_TOP, FLOOR = (0.0, 0.0, 0.21), (0.0, 0.0, 0.19), (0.3, 0.2, 0.0)


def test_splats_in_human_voxels_are_human_and_stay_so_beside_them() -> None:
    grid = grid_of(masked(frame(block=0.205)))
    slots = splats_at(TOP, BELOW_TOP, FLOOR)
    assert human_splats(slots, grid).tolist() == [True, False, False, False, False]
    slots.labels[1] = Label.HUMAN
    assert human_splats(slots, grid).tolist() == [True, True, False, False, False]


def test_what_was_human_and_is_object_is_a_trail() -> None:
    slots = splats_at(TOP, FLOOR)
    assert not relabel(slots, grid_of(masked(frame(block=0.205))), None).any()
    assert slots.labels.tolist() == [Label.HUMAN, Label.OBJECT, 0, 0]
    is_trail = relabel(slots, grid_of(blind(frame(block=0.205))), None)
    assert is_trail.tolist() == [True, False, False, False]
    assert not slots.labels.any()


def test_a_splat_in_the_robot_is_the_robots_whatever_the_mask_says() -> None:
    slots = splats_at(TOP, FLOOR)
    robot = RobotPosture(centers=np.array([[0.0, 0.0, 0.2]]), radii=np.array([0.05]), T_world_link=np.eye(4)[None])
    relabel(slots, grid_of(masked(frame(block=0.205))), robot)
    assert slots.labels.tolist() == [Label.ROBOT, Label.OBJECT, 0, 0]


def test_every_splat_in_a_sphere_lies_in_a_voxel_that_the_sphere_marks() -> None:
    rng = np.random.default_rng(3)
    spheres, radii = rng.uniform(-0.2, 0.3, (12, 3)), rng.uniform(0.02, 0.1, 12)
    grid = OccupancyMap(WORKSPACE, OccupancyConfig(), 1)
    grid.mark_robot(spheres, radii)
    points = np.float32(rng.uniform(WORKSPACE.lower, WORKSPACE.upper, (20_000, 3)))
    inside = inside_spheres(points, spheres, radii, 0.0)
    assert inside.sum() > 100
    assert (grid.entity_at(points[inside]) & Label.ROBOT > 0).all()


def test_inside_spheres_counts_the_margin() -> None:
    points = np.float32([[0.0, 0.0, 0.0], [0.11, 0.0, 0.0], [0.13, 0.0, 0.0]])
    assert inside_spheres(points, np.zeros((1, 3)), np.array([0.1]), 0.02).tolist() == [True, True, False]


def steps(target: SceneFitter, views: list[tuple[RgbdFrame, UInt8 | None]]) -> SplatSet:
    for k, (view, human) in enumerate(views):
        target.step([replace(view, stamp_ns=(target.num_steps + k) * 100_000_000, human=human)])
    return target.splats()


def test_a_visitor_is_human_while_there_and_leaves_nothing_behind() -> None:
    target = SceneFitter(
        SceneConfig(max_splats=1200, first_iterations=60, iterations_per_step=10),
        OccupancyConfig(),
        WORKSPACE,
        threads=2,
    )
    here, gone = masked(frame(block=VISITOR)), blind(frame())
    assert not (steps(target, [(gone, gone.human)] * 2).labels == Label.HUMAN).any()
    splats = steps(target, [(here, here.human)] * 2)
    is_up, is_human = splats.centers[:, 2] > 0.1, splats.labels == Label.HUMAN
    assert is_up.sum() > 30
    assert is_human[is_up].all()
    assert not is_human[splats.centers[:, 2] < 0.03].any()
    splats = steps(target, [(gone, gone.human)])
    assert not (splats.labels == Label.HUMAN).any()
    assert not (splats.centers[:, 2] > 0.1).any()


def test_a_person_whom_the_mask_loses_stays_in_the_map_as_an_object() -> None:
    target = SceneFitter(
        SceneConfig(max_splats=1200, first_iterations=60, iterations_per_step=10), OccupancyConfig(), WORKSPACE
    )
    here = masked(frame(block=VISITOR))
    steps(target, [(here, here.human)] * 2)
    splats = steps(target, [(here, np.zeros_like(here.color[..., 0]))] * 2)
    assert (splats.centers[:, 2] > 0.1).sum() > 30
    assert not splats.labels.any()


def test_a_person_who_walks_leaves_no_trail() -> None:
    target = SceneFitter(
        SceneConfig(max_splats=1200, first_iterations=60, iterations_per_step=10), OccupancyConfig(), WORKSPACE
    )
    steps(target, [(frame(), np.zeros((60, 80), np.uint8))])
    for place in (-0.2, -0.14, -0.08, -0.02, 0.04):
        here = masked(frame(block=VISITOR, block_x=place))
        splats = steps(target, [(here, here.human)])
        is_up = splats.centers[:, 2] > 0.1
        assert is_up.sum() > 20
        assert (splats.labels[is_up] == Label.HUMAN).all()
        assert np.abs(splats.centers[is_up, 0] - place).max() < 0.13
    assert not (steps(target, [(frame(), np.zeros((60, 80), np.uint8))]).centers[:, 2] > 0.1).any()
