"""Robot and human labels: where they come from, how long they stay, and that nothing is left behind when they go."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from splatctrl_cli.config import HumanConfig, OccupancyConfig, SceneConfig
from splatctrl_cli.geometry import back_project, pose_at, transform_points
from splatctrl_cli.records import Bool, Label, RgbdFrame, SplatSet
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import Shape
from splatctrl_cli.scene.buffer import SplatBuffer
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.labels import human_splats, relabel, robot_splats, shown_kinds
from splatctrl_cli.scene.occupancy import OccupancyMap, PeopleMemory
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask, object_mask, self_mask
from splatctrl_cli.voxels import SOLID, SWEPT, VoxelState
from tests.scene.wall import WORKSPACE, frame, plain_seeds

VISITOR = 0.2  # [m] height of the block that stands for a person


SCENE = SceneConfig(max_splats=1200, first_iterations=60, iterations_per_step=10)


def masked(view: RgbdFrame) -> RgbdFrame:
    """The frame with the block, which is all that is above the floor, as a person."""
    return replace(view, human=((view.depth > 0) & (view.depth < 0.99)).astype(np.uint8))


def blind(view: RgbdFrame) -> RgbdFrame:
    """The frame with a mask that shows nobody."""
    return replace(view, human=np.zeros(view.depth.shape, np.uint8))


def grid_of(*views: RgbdFrame, threads: int = 1) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, OccupancyConfig(), threads)
    for view in views:
        grid.take_in([view])
    return grid


def humans(grid: OccupancyMap) -> int:
    return int((grid.entity & Label.HUMAN > 0).sum())


def test_human_voxels_are_those_that_hold_the_point_of_a_human_pixel() -> None:
    view = masked(frame(block=0.21, x=0.013))
    grid = grid_of(view)
    points = transform_points(view.T_world_camera, back_project(view.intrinsics, view.depth.astype(np.float64)))
    expected = np.zeros(grid.entity.shape, bool)
    expected[tuple(np.floor((points[view.human > 0] - WORKSPACE.lower) / grid.config.voxel).astype(int).T)] = True
    assert ((grid.entity & Label.HUMAN > 0) == expected).all() and 50 < expected.sum() < 200


DARK = replace(frame(), depth=np.zeros_like(frame().depth))
PERSON, NOBODY = masked(frame(block=VISITOR)), blind(frame(block=VISITOR))


@pytest.mark.parametrize(
    ("views", "is_human"),
    [
        pytest.param([PERSON, NOBODY], False, id="other pixels hit it"),
        pytest.param([*[PERSON] * 5, blind(frame())], False, id="a ray passes it"),
        pytest.param([*[blind(frame())] * 8, PERSON], True, id="a person enters long free space"),
        pytest.param([PERSON, frame(block=VISITOR)], True, id="no masked image sees it"),
        pytest.param([PERSON, blind(DARK)], True, id="no image with depth sees it"),
    ],
)
def test_a_voxel_is_human_until_a_masked_image_sees_something_else(views: list[RgbdFrame], is_human: bool) -> None:
    assert humans(grid_of(PERSON)) > 50
    assert humans(grid_of(*views)) == (humans(grid_of(PERSON)) if is_human else 0)


def test_of_one_time_step_any_camera_that_sees_a_person_counts_whatever_the_order() -> None:
    for views in ([PERSON, NOBODY], [NOBODY, PERSON]):
        grid = grid_of()
        grid.take_in(views)
        assert humans(grid) == humans(grid_of(PERSON))


def test_thread_count_does_not_change_a_bit() -> None:
    views = PERSON, masked(frame(block=VISITOR, x=0.15))
    assert grid_of(*views).entity.tobytes() == grid_of(*views, threads=3).entity.tobytes()


def splats_at(*centers: tuple[float, float, float]) -> SplatBuffer:
    """Splats of 2 cm, and two slots that are free."""
    slots = SplatBuffer(len(centers) + 2)
    slots.fill(plain_seeds(centers, 0.02), 0.5)
    return slots


TOP, BELOW_TOP, FLOOR = (0.0, 0.0, 0.21), (0.0, 0.0, 0.19), (0.3, 0.2, 0.0)


def test_splats_in_human_voxels_are_human_and_stay_so_beside_them() -> None:
    grid, slots = grid_of(masked(frame(block=0.205))), splats_at(TOP, BELOW_TOP, FLOOR)
    assert human_splats(slots, grid).tolist() == [True, False, False, False, False]
    slots.labels[1] = Label.HUMAN
    assert human_splats(slots, grid).tolist() == [True, True, False, False, False]


def test_what_was_human_and_is_object_is_a_trail() -> None:
    slots = splats_at(TOP, FLOOR)
    assert not relabel(slots, grid_of(masked(frame(block=0.205))), None).any()
    assert slots.labels.tolist() == [Label.HUMAN, Label.OBJECT, 0, 0]
    assert relabel(slots, grid_of(blind(frame(block=0.205))), None).tolist() == [True, False, False, False]
    assert not slots.labels.any()


def test_a_splat_in_the_robot_is_the_robots_whatever_the_mask_says() -> None:
    slots = splats_at(TOP, FLOOR)
    relabel(slots, grid_of(masked(frame(block=0.205))), replace(ball(0.2, 0.05), surface=None, T_world_surface={}))
    assert slots.labels.tolist() == [Label.ROBOT, Label.OBJECT, 0, 0]


def test_every_splat_in_a_sphere_lies_in_a_voxel_that_the_sphere_marks() -> None:
    rng, grid = np.random.default_rng(3), grid_of()
    spheres, radii = rng.uniform(-0.2, 0.3, (12, 3)), rng.uniform(0.02, 0.1, 12)
    grid.mark_robot(spheres, radii)
    points = np.float32(rng.uniform(WORKSPACE.lower, WORKSPACE.upper, (20_000, 3)))
    inside = (np.linalg.norm(points[:, None] - spheres, axis=2) <= radii).any(axis=1)
    assert inside.sum() > 100 and (grid.entity_at(points[inside]) & Label.ROBOT > 0).all()


def up_and_human(target: SceneFitter, *views: RgbdFrame) -> tuple[SplatSet, Bool, Bool]:
    """The splats after these time steps, those above the floor and those of people."""
    for view in views:
        target.step([replace(view, stamp_ns=target.num_steps * 100_000_000)])
    splats = target.splats()
    return splats, splats.centers[:, 2] > 0.1, splats.labels == Label.HUMAN


def test_a_visitor_is_human_while_there_and_leaves_nothing_behind() -> None:
    target, gone = SceneFitter(SCENE, OccupancyConfig(), WORKSPACE, threads=2), blind(frame())
    *_, is_human = up_and_human(target, gone, gone)
    assert not is_human.any()
    splats, is_up, is_human = up_and_human(target, PERSON, PERSON)
    assert is_up.sum() > 30 and is_human[is_up].all() and not is_human[splats.centers[:, 2] < 0.03].any()
    _, is_up, is_human = up_and_human(target, gone)
    assert not is_human.any() and not is_up.any()


def test_a_person_whom_the_mask_loses_stays_in_the_map_as_an_object() -> None:
    splats, is_up, _ = up_and_human(SceneFitter(SCENE, OccupancyConfig(), WORKSPACE), PERSON, PERSON, NOBODY, NOBODY)
    assert is_up.sum() > 30 and not splats.labels.any()


def test_a_person_who_walks_leaves_no_trail() -> None:
    target = SceneFitter(SCENE, OccupancyConfig(), WORKSPACE)
    up_and_human(target, blind(frame()))
    for place in (-0.2, -0.14, -0.08, -0.02, 0.04):
        splats, is_up, is_human = up_and_human(target, masked(frame(block=VISITOR, block_x=place)))
        assert is_up.sum() > 20 and is_human[is_up].all()
        assert np.abs(splats.centers[is_up, 0] - place).max() < 0.13
    assert not up_and_human(target, blind(frame()))[1].any()


def ball(z: float, radius: float = 0.1) -> RobotPosture:
    """A robot that is one ball of collision geometry, above the middle of the floor."""
    T = pose_at([0.0, 0.0, z])
    surface = RobotSurface.from_parts([Shape(link="arm", kind="sphere", size=(radius,), T_link_shape=np.eye(4))])
    return RobotPosture(
        centers=np.array([[0.0, 0.0, z]]),
        radii=np.array([radius]),
        T_world_link=T[None],
        surface=surface,
        T_world_surface={0: T[None]},
    )


def seen_with(robot: RobotPosture, block: float = 0.0, lift: float = 0.0, x: float = 0.0) -> RgbdFrame:
    """The floor and a block, with the ball before them, its measured depth `lift` [m] nearer than it is."""
    view = frame(block=block, x=x)
    surface, T = robot.seen_at(0)
    shown = surface.render(T, view.intrinsics, view.T_world_camera, view.depth).depth
    nearer = (shown > 0) & ((shown < view.depth) | (lift > 0))
    return replace(view, depth=np.where(nearer, shown - np.float32(lift), view.depth).astype(np.float32))


@pytest.mark.parametrize(
    ("lift", "points", "expected"),
    [
        (
            0.0,
            [[0.0, 0.0, 0.4], [0.0, 0.0, 0.38], [0.0, 0.0, 0.0], [0.3, 0.2, 0.0], [0.3, 0.2, 0.1]],
            [PixelKind.ROBOT, *[PixelKind.NOTHING] * 2, PixelKind.OBJECT, PixelKind.NOTHING],
        ),
        (0.012, [[0.0, 0.0, 0.4], [0.0, 0.0, 0.412]], [PixelKind.NOTHING, PixelKind.OBJECT]),
    ],
)
def test_a_splat_is_what_the_pixel_shows_whose_depth_it_explains(
    lift: float, points: list[list[float]], expected: list[PixelKind]
) -> None:
    """One on the robot just behind an object, nearer than `see_through`, is not taken for the object."""
    assert (
        shown_kinds(np.float32(points), [seen_and_masked(ball(0.3), lift=lift)], OccupancyConfig()).tolist()
        == expected
    )


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_cameras_the_one_that_explains_a_splat_best_says_what_it_is(order: int) -> None:
    """The pixel of the robot explains it to 1 mm, that of an object in the other image to 15 mm."""
    ours, other = (replace(frame(), depth=np.full((60, 80), depth, np.float32)) for depth in (1.001, 1.015))
    robot = replace(object_mask(ours), kinds=np.full((60, 80), PixelKind.ROBOT, np.uint8))
    seen = [(ours, robot), (other, object_mask(other))][::order]
    assert shown_kinds(np.float32([[0.0, 0.0, 0.0]]), seen, OccupancyConfig()).tolist() == [PixelKind.ROBOT]


def test_what_the_robot_hides_keeps_its_label_and_what_it_shows_is_its_own() -> None:
    robot, slots = ball(0.3), splats_at((0.0, 0.0, 0.4), (0.0, 0.0, 0.15), (0.3, 0.2, 0.0), (0.0, 0.0, 0.3))
    seen = seen_and_masked(robot)
    assert not relabel(slots, grid_of(seen[0]), robot, [seen]).any()
    assert slots.labels[:4].tolist() == [Label.ROBOT, Label.OBJECT, Label.OBJECT, Label.ROBOT]


def test_an_object_that_arrives_before_the_robot_takes_its_splats_with_measured_depth() -> None:
    robot, slots = ball(0.3), splats_at((0.0, 0.0, 0.43), (0.0, 0.0, 0.4))
    slots.labels[:2] = Label.ROBOT
    seen = seen_and_masked(robot, lift=0.03)
    assert not relabel(slots, grid_of(seen[0]), robot, [seen], 0.005).any()
    assert slots.labels[:2].tolist() == [Label.OBJECT, Label.ROBOT]
    np.testing.assert_allclose(slots.radii[:2], [0.005, 0.02], rtol=1e-6)


def seen_and_masked(robot: RobotPosture, lift: float = 0.0, block: float = 0.0) -> tuple[RgbdFrame, SelfMask]:
    view = seen_with(robot, block, lift)
    return view, self_mask(view, robot, OccupancyConfig())


def labelled(grid: OccupancyMap, robot: RobotPosture, view: RgbdFrame, times: int = 1) -> None:
    """Time steps of the voxels' labels."""
    kinds = self_mask(view, robot, grid.config).kinds
    for _ in range(times):
        grid.take_in([view])
        grid.label_robot(robot.centers, robot.radii, [(view, kinds == PixelKind.ROBOT, kinds == PixelKind.OBJECT)])
        grid.forget_hidden(robot.centers, robot.radii, robot.is_within)


def bits(grid: OccupancyMap, *points: tuple[float, float, float]) -> list[int]:
    return grid.entity_at(np.float32(points)).tolist()


def test_the_voxels_of_the_robots_pixels_are_its_own_and_those_of_objects_are_solid() -> None:
    grid, robot = grid_of(), ball(0.3)
    labelled(grid, robot, seen_with(robot))
    top, floor = bits(grid, (0.0, 0.0, 0.4), (0.3, 0.2, 0.0))
    assert top & Label.ROBOT and top & SWEPT and not top & SOLID
    assert floor & SOLID and not floor & Label.ROBOT


def test_an_object_that_arrives_where_the_robot_was_is_occupied() -> None:
    grid, robot = grid_of(), ball(0.2)
    labelled(grid, robot, seen_with(robot))
    labelled(grid, ball(5.0), frame(block=VISITOR), times=4)
    centers = grid.centers_of(grid.occupied_voxels())
    on_top = (np.abs(centers[:, :2]).max(axis=1) < 0.08) & (np.abs(centers[:, 2] - VISITOR) < 0.02)
    assert on_top.sum() > 30
    assert bits(grid, (0.0, 0.0, VISITOR))[0] & (SWEPT | SOLID) == SWEPT | SOLID


def test_what_the_robots_pixels_added_to_a_voxel_is_no_evidence_of_an_object() -> None:
    """And one hit of an object may be noise."""
    grid, robot = grid_of(), ball(0.3)
    labelled(grid, robot, seen_with(robot), times=3)
    for is_occupied in (False, True):
        labelled(grid, ball(5.0), frame(block=0.4))
        away = np.abs(grid.centers_of(grid.occupied_voxels()) - np.float32([0.0, 0.0, 0.4])).max(axis=1)
        assert bits(grid, (0.0, 0.0, 0.4))[0] & SOLID and (away.min() < 0.5 * grid.config.voxel) == is_occupied


def test_a_voxel_that_the_robot_left_is_not_occupied() -> None:
    grid, robot = grid_of(), ball(0.3)
    labelled(grid, robot, seen_with(robot), times=3)
    labelled(grid, ball(5.0), DARK)
    assert not (np.linalg.norm(grid.centers_of(grid.occupied_voxels()) - [0.0, 0.0, 0.3], axis=1) < 0.15).any()


def test_what_the_robot_hides_of_an_object_is_solid_as_long_as_the_rest_of_it_is_there() -> None:
    """The ball stands in the block's top, and then the block is gone."""
    grid, robot = grid_of(), ball(0.22, 0.08)
    labelled(grid, ball(5.0), frame(block=VISITOR), times=3)
    for block in (VISITOR, 0.0):
        labelled(grid, robot, seen_with(robot, block=block))
        assert bool(bits(grid, (0.0, 0.0, VISITOR))[0] & SOLID) is (block > 0)


@pytest.mark.parametrize("is_drawn", [False, True])
def test_within_a_robot_of_which_all_is_drawn_no_splat_is_an_objects(is_drawn: bool) -> None:
    """A splat 4 cm within a ball, in a voxel that an object's pixel has hit; a box or a hull may be larger than what
    it stands for.
    """
    robot, buffer, grid = ball(0.3), splats_at((0.0, 0.0, 0.34)), grid_of()
    if is_drawn:
        triangles = trimesh.creation.icosphere(radius=0.1).triangles + np.array([0.0, 0.0, 0.3])
        drawn = RobotSurface.from_parts([], [("arm", triangles)])
        robot = replace(robot, surface=drawn, T_world_surface={0: np.eye(4)[None]})
    grid.entity[:] = SOLID
    assert robot_splats(buffer, grid, robot, [])[0].tolist() == [is_drawn, False, False]
    center = np.float32([[0.0, 0.0, 0.34]])
    assert robot.holds(center, 0.03).tolist() == [is_drawn] and not robot.holds(center, 0.07).any()


@pytest.mark.parametrize("to_moving", [False, True])
def test_points_within_a_reach_are_those_whose_distance_says_so(to_moving: bool) -> None:
    """Two meshes that overlap and a ball, one mesh of a fixed link; a reach of each point, below 0 too."""
    tip = Shape(link="arm", kind="sphere", size=(0.05,), T_link_shape=pose_at([0.1, 0.1, 0.2]))
    meshes = [
        trimesh.creation.icosphere(radius=radius).triangles + shift for radius, shift in ((0.1, 0.0), (0.2, 0.15))
    ]
    surface = RobotSurface.from_parts([tip], [("arm", meshes[0]), ("base", meshes[1])], fixed=("base",))
    robot = replace(ball(0.3), surface=surface, T_world_surface={0: np.tile(np.eye(4), (2, 1, 1))})
    rng = np.random.default_rng(3)
    points, reach = rng.uniform(-0.25, 0.35, (2000, 3)).astype(np.float32), rng.choice([-0.02, 0.0, 0.03, 0.1], 2000)
    expected = robot.distance(points, to_moving=to_moving) <= reach
    assert 100 < np.count_nonzero(expected) < 1900
    assert (robot.is_within(points, reach, to_moving=to_moving) == expected).all()


HERE, GONE = masked(frame(block=VISITOR)), blind(frame())
COVERED = replace(HERE, depth=np.zeros_like(HERE.depth))


def seen(memory: float, *views: tuple[float, RgbdFrame]) -> tuple[OccupancyMap, list[int], PeopleMemory]:
    """The grid that took in these views at their times [s], how many voxels were human after each, and the memory."""
    voxels, people, counts = OccupancyMap(WORKSPACE, OccupancyConfig(), 1), PeopleMemory(memory), []
    for time_s, view in views:
        people.take_in(voxels, [replace(view, stamp_ns=round(time_s * 1e9))])
        counts.append(humans(voxels))
    return voxels, counts, people


def test_what_nobody_sees_stays_human_for_the_memory_and_is_then_unknown() -> None:
    """COVERED is of a camera that sees nothing."""
    there = seen(2.0, (0.0, HERE))[0].entity & Label.HUMAN > 0
    voxels, counts, _ = seen(2.0, (0.0, HERE), (1.0, COVERED), (2.0, COVERED), (2.1, COVERED))
    assert there.sum() > 50 and counts == [there.sum()] * 3 + [0]
    assert (voxels.grid().states(0.3, 0.7)[there] == VoxelState.NEVER_SEEN).all()


def test_a_person_who_is_seen_again_is_remembered_anew() -> None:
    _, counts, _ = seen(2.0, (0.0, HERE), (1.5, HERE), (3.0, COVERED), (3.4, COVERED), (3.6, COVERED))
    assert counts[3] > 50 and counts[4] == 0


@pytest.mark.parametrize("after", [GONE, frame()], ids=["masked", "without masks"])
def test_what_is_seen_free_is_human_no_longer_whatever_the_memory(after: RgbdFrame) -> None:
    _, counts, people = seen(99.0, (0.0, HERE), (0.1, after))
    assert counts[1] == len(people.voxels) == 0


@pytest.mark.parametrize(("memory", "stays"), [(0.5, False), (5.0, True)])
def test_the_splats_of_a_forgotten_person_go(memory: float, stays: bool) -> None:
    config, human = (
        SceneConfig(max_splats=1200, first_iterations=60, iterations_per_step=0),
        HumanConfig(memory=memory),
    )
    target = SceneFitter(config, OccupancyConfig(), WORKSPACE, human=human)
    target.step([HERE])
    assert (target.splats().labels == Label.HUMAN).sum() > 20
    target.step([replace(COVERED, stamp_ns=1_000_000_000)])
    splats = target.splats()
    assert ((splats.labels == Label.HUMAN).sum() > 20) == ((splats.centers[:, 2] > 0.1).sum() > 20) == stays
