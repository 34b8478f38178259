"""What a thing without depth may hide, what is lost at an edge, and why a voxel beside the robot was never seen."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import ASKED_REACH
from splatctrl_cli.geometry import back_project
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.scene.depth_holes import explain_unseen, lost_edges, unanswered_points
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.self_mask import PixelKind, object_mask, self_mask
from splatctrl_cli.voxels import NO_EDGES, EvidenceClass, LostEdges, Unseen
from tests.scene.wall import HEIGHT, INTRINSICS, WORKSPACE, frame

CONFIG = OccupancyConfig()
NOBODY: Float32 = np.zeros((INTRINSICS.height, INTRINSICS.width), np.float32)
BLOCK = 0.1  # [m] of which no depth comes back


def dark(rows: slice = slice(20, 40), columns: slice = slice(30, 50), *, x: float = 0.0) -> RgbdFrame:
    """The floor, without depth in these pixels."""
    seen = frame(x=x)
    seen.depth[rows, columns] = 0.0
    return seen


def dark_block(x: float) -> RgbdFrame:
    """A block at the origin, 0.2 m wide, that the camera above (x, 0) gets no depth from."""
    seen = frame(block=BLOCK, x=x)
    seen.depth[seen.depth < HEIGHT] = 0.0
    return seen


def before_a_far_background(*dark: tuple[slice, slice], things: tuple[tuple[slice, slice], ...] = ()) -> RgbdFrame:
    """The floor below a horizon, things that rise above it, and none of the dark pixels' depth."""
    seen = frame()
    seen.depth[:20] = 0.0
    for thing in things:
        seen.depth[thing] = 0.8
    for pixels in dark:
        seen.depth[pixels] = 0.0
    return seen


def points_of(seen: RgbdFrame, robot: Float32 = NOBODY) -> Float64:
    return np.concatenate([np.empty((0, 3)), *unanswered_points(seen, robot, CONFIG)])


def marked(grid: OccupancyMap) -> Bool:
    return grid.last_seen == Unseen.UNANSWERED


def unanswered(*frames: RgbdFrame) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    grid.take_in(frames)
    for seen in frames:
        grid.mark_unseen(points_of(seen), Unseen.UNANSWERED)
    return grid


def test_points_lie_on_the_rays_of_the_hole_and_before_the_floor() -> None:
    points = points_of(dark())
    depth = HEIGHT - points[:, 2]
    u = INTRINSICS.fx * points[:, 0] / depth + INTRINSICS.cx
    v = -INTRINSICS.fy * points[:, 1] / depth + INTRINSICS.cy
    assert u.min() > 29.9 and u.max() < 49.1 and v.min() > 19.9 and v.max() < 39.1
    assert depth.min() == pytest.approx(CONFIG.min_range) and HEIGHT - CONFIG.voxel < depth.max() < HEIGHT
    rays = np.unique(np.round([u, v], 3), axis=1)
    assert rays.shape[1] == 20 * 20  # a pixel is 12.5 mm, less than a voxel


def test_a_large_hole_is_taken_a_piece_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = points_of(dark())
    monkeypatch.setattr("splatctrl_cli.scene.depth_holes.MOST_POINTS", 1000)
    pieces = list(unanswered_points(dark(), NOBODY, CONFIG))
    assert len(pieces) > 10 and max(map(len, pieces)) <= 1000
    assert np.concatenate(pieces).tolist() == whole.tolist()


ROBOT_BESIDE = np.zeros_like(NOBODY)
ROBOT_BESIDE[25:35, 51:60] = 0.5
IN_THE_LENS = np.asarray(np.mgrid[:60, :80][1] <= 45)
TWO_THINGS = (slice(5, 30), slice(20, 30)), (slice(5, 30), slice(36, 46))
DARK_THING = slice(14, 45), slice(30, 50)


@pytest.mark.parametrize(
    ("seen", "robot"),
    [
        pytest.param(frame(), NOBODY, id="no hole"),
        pytest.param(dark(columns=slice(60, 80)), NOBODY, id="at the border"),
        pytest.param(dark(columns=slice(30, 32)), NOBODY, id="narrower than two voxels"),
        pytest.param(dark(columns=slice(44, 50)), ROBOT_BESIDE, id="the robot's shadow"),
        pytest.param(replace(dark(), valid=IN_THE_LENS), NOBODY, id="not in the lens"),
        pytest.param(before_a_far_background(), NOBODY, id="a background without depth"),
        pytest.param(before_a_far_background(things=TWO_THINGS), NOBODY, id="the background between two things"),
        pytest.param(before_a_far_background(DARK_THING), NOBODY, id="a thing before the background"),
    ],
)
def test_other_gaps_are_no_holes(seen: RgbdFrame, robot: Float32) -> None:
    assert not len(points_of(seen, robot))


@pytest.mark.parametrize(
    ("before", "counts"),
    [
        pytest.param(frame(), False, id="new"),
        pytest.param(dark(columns=slice(60, 80)), False, id="open before"),
        pytest.param(dark(columns=slice(48, 58)), True, id="a part of it"),
        pytest.param(replace(frame(), T_world_camera=frame(x=0.1).T_world_camera), True, id="another view"),
    ],
)
def test_a_hole_counts_where_the_camera_showed_it_before(before: RgbdFrame, counts: bool) -> None:
    """Between two people the background may be closed off for one image."""
    assert sum(map(len, list(unanswered_points(dark(), NOBODY, CONFIG, (before, object_mask(before)))))) == (
        len(points_of(dark())) if counts else 0
    )


def test_a_hole_at_the_robot_before_does_not_count_either_after_a_resumed_run() -> None:
    """A restored mask has its kinds, and nothing rendered."""
    before = dark()
    restored = replace(
        object_mask(before), kinds=np.where(ROBOT_BESIDE > 0, np.uint8(PixelKind.ROBOT), object_mask(before).kinds)
    )
    assert not restored.robot_depth.any() and len(points_of(dark()))
    assert not list(unanswered_points(dark(), NOBODY, CONFIG, (before, restored)))


def test_a_dark_block_is_where_all_cameras_look_in_vain() -> None:
    """The others see through the space above it."""
    one, three = unanswered(dark_block(0.0)), unanswered(dark_block(0.0), dark_block(-0.15), dark_block(0.15))
    for grid, expected in ((one, [True, True]), (three, [True, False])):
        cells = np.round((np.array([[0.0, 0.0, BLOCK - 0.02], [0.0, 0.0, 0.5]]) - grid.origin) / CONFIG.voxel)
        assert marked(grid)[tuple(cells.astype(int).T)].tolist() == expected
    assert 0 < marked(three).sum() < 0.75 * marked(one).sum()


def test_what_a_later_image_sees_is_answered() -> None:
    grid = unanswered(dark())
    assert marked(grid).any()
    grid.take_in([frame()])
    assert not marked(grid).any()
    grid.mark_unseen(points_of(dark()), Unseen.UNANSWERED)
    assert not marked(grid).any()  # what was seen once has an age instead


def test_steps_that_are_thinned_leave_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatctrl_cli.scene.occupancy.MAX_STEPS", 1)
    grid = unanswered(dark())
    before = marked(grid)
    grid.take_in([replace(dark(), stamp_ns=1)])
    assert before.any() and (marked(grid) == before).all()


def test_a_fitted_scene_knows_it() -> None:
    fitter = SceneFitter(SceneConfig(max_splats=300, first_iterations=1, iterations_per_step=1), CONFIG, WORKSPACE)
    fitter.step([dark_block(0.0)])
    stamps_ns, classes = fitter.known_voxels().seen.look(
        np.array([[0.0, 0.0, 0.5 * BLOCK], [0.0, 0.0, -0.5], [9.0, 0.0, 0.0]])
    )
    assert stamps_ns.tolist() == [-1, -1, -1]
    assert classes.tolist() == [EvidenceClass.UNANSWERED, EvidenceClass.OUTSIDE, EvidenceClass.OUTSIDE]


def test_a_fitted_scene_knows_a_hole_from_its_second_image_on() -> None:
    fitter = SceneFitter(SceneConfig(max_splats=300, first_iterations=1, iterations_per_step=1), CONFIG, WORKSPACE)
    hole = dark_block(0.0)
    joined = hole.depth.copy()
    joined[INTRINSICS.height // 2, :] = 0.0  # joins the hole and the border
    classes = []
    for number, depth in enumerate((joined, hole.depth, hole.depth)):
        fitter.step([replace(hole, depth=depth.copy(), stamp_ns=number * 100_000_000)])
        _, found = fitter.known_voxels().seen.look(np.array([[0.0, 0.0, 0.5 * BLOCK]]))
        classes.append(EvidenceClass(found[0]))
    assert [kind == EvidenceClass.UNANSWERED for kind in classes] == [False, False, True]


DEPTH = HEIGHT - 0.1  # [m] of the block, 0.2 m wide


def with_lost_edges(x: float = 0.0) -> RgbdFrame:
    """A block on the floor from above (x, 0), without depth in the pixels on both sides of its outline."""
    seen = frame(block=0.1, x=x)
    step = np.abs(np.diff(seen.depth, axis=1)) > 0.05, np.abs(np.diff(seen.depth, axis=0)) > 0.05
    seen.depth[:, 1:][step[0]] = seen.depth[:, :-1][step[0]] = 0.0
    seen.depth[1:][step[1]] = seen.depth[:-1][step[1]] = 0.0
    return seen


def edges_of(*frames: RgbdFrame) -> LostEdges:
    named = [replace(each, camera=f"cam{number}") for number, each in enumerate(frames)]
    return NO_EDGES.joined(*lost_edges([(each, object_mask(each)) for each in named], None, CONFIG).values())


def at_the_block(edges: LostEdges) -> np.ndarray:
    """Which balls (K,) are at the depth of the block's top."""
    return np.abs(edges.centers[:, 2] - 0.1) < 0.005


def test_the_lost_outline_of_a_block_is_as_wide_as_a_pixel_and_at_its_depth() -> None:
    """Images without lost pixels, and images without depth, have no lost edges."""
    edges, pixel, nothing = edges_of(with_lost_edges()), DEPTH / INTRINSICS.fx, frame()
    mine = at_the_block(edges)
    assert mine.sum() > 40
    np.testing.assert_allclose(edges.radii[mine], pixel, rtol=0.02)
    reach = np.abs(edges.centers[mine, :2]).max(axis=1) + edges.radii[mine]
    assert np.all(reach >= 0.1) and np.all(reach < 0.1 + 2 * pixel)  # the block's true edge is inside the balls
    nothing.depth[:] = 0.0
    assert len(edges_of(frame()).radii) == len(edges_of(nothing).radii) == 0


def test_a_pixel_lost_between_two_surfaces_may_be_of_the_nearer() -> None:
    """One column alone, with the block at its left and the floor at its right."""
    seen = frame(block=0.1)
    seen.depth[20:40, np.flatnonzero(np.diff(seen.depth[30]) > 0.05)[0]] = 0.0
    edges = edges_of(seen)
    assert len(edges.radii) == 20 and at_the_block(edges).all()


@pytest.mark.parametrize(("above", "has_edge"), [(0.15, False), (0.0, True), (0.3, True)])
def test_a_depth_between_two_surfaces_has_no_edge(above: float, has_edge: bool) -> None:
    """Beside a block of 30 cm one column at a height above the floor, as lasers mix depths, and one without depth."""
    seen = frame(block=0.3)
    column = int(np.flatnonzero(np.diff(seen.depth[30]) > 0.05)[0]) + 1
    seen.depth[20:40, column] = HEIGHT - above
    seen.depth[20:40, column + 1] = 0.0
    assert bool(np.isclose(edges_of(seen).centers[:, 2], above, atol=0.01).any()) == has_edge


def test_the_outline_is_not_where_another_camera_looks_past_it() -> None:
    """A camera that sees no block at all; one that sees it does not."""
    for beside, has_outline in (([], True), ([frame(x=0.15)], False), ([with_lost_edges(0.15)], True)):
        assert at_the_block(edges_of(with_lost_edges(), *beside)).any() == has_outline


def test_the_outline_of_the_robot_is_its_own() -> None:
    seen = with_lost_edges()
    mask = object_mask(seen)
    kinds = np.where(np.abs(seen.depth - DEPTH) < 0.01, np.uint8(PixelKind.ROBOT), mask.kinds)
    assert not at_the_block(lost_edges([(seen, replace(mask, kinds=kinds))], None, CONFIG)["cam0"]).any()


MIDDLE, RADIUS = np.array([0.0, 0.0, 0.3]), 0.1  # of a robot that is a ball
ROBOT = RobotPosture(centers=MIDDLE[None], radii=np.array([RADIUS]), T_world_link=np.eye(4)[None])


def robot_and_floor() -> RgbdFrame:
    """The floor and the ball, from above."""
    seen, to_ball = frame(), np.array([0.0, 0.0, HEIGHT - MIDDLE[2]])
    rays = back_project(INTRINSICS, np.ones((INTRINSICS.height, INTRINSICS.width)))
    squared, half = np.sum(rays**2, axis=2), rays @ to_ball
    root = half**2 - squared * (to_ball @ to_ball - RADIUS**2)
    seen.depth[root > 0] = ((half - np.sqrt(np.maximum(root, 0))) / squared)[root > 0]
    return seen


def explained(*frames: RgbdFrame, robot: RobotPosture = ROBOT) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    grid.take_in(frames)
    return explain(grid, *frames, robot=robot)


def explain(grid: OccupancyMap, *frames: RgbdFrame, robot: RobotPosture = ROBOT) -> OccupancyMap:
    explain_unseen(grid, [(seen, self_mask(seen, robot, CONFIG)) for seen in frames], robot)
    return grid


def class_at(grid: OccupancyMap, *points: tuple[float, float, float]) -> list[EvidenceClass]:
    last = grid.last_seen[tuple(np.round((np.array(points) - grid.origin) / CONFIG.voxel).astype(int).T)].tolist()
    return [EvidenceClass[Unseen(each).name] if each >= min(Unseen) else EvidenceClass.FREE for each in last]


UNDER = (0.0, 0.0, 0.15)


def test_each_voxel_beside_the_robot_has_its_reason() -> None:
    """A thing to the left is nearer to the camera than the robot, and the far background returns nothing."""
    seen = robot_and_floor()
    seen.depth[:, :28] = 0.6
    seen.depth[:12] = 0.0
    grid = explained(seen)
    assert class_at(grid, (0.0, 0.0, 0.45), (0.0, 0.0, 0.3), UNDER, (-0.15, 0.0, 0.2), (0.0, 0.2, 0.3)) == [
        EvidenceClass.FREE,
        EvidenceClass.SWEPT,
        EvidenceClass.HIDDEN_BY_ARM,
        EvidenceClass.HIDDEN_BY_THING,
        EvidenceClass.NO_RETURN,
    ]
    assert not (grid.last_seen == 0)[grid.last_seen.shape[0] // 2].all()


def test_what_no_camera_looks_at_is_out_of_view() -> None:
    grid = explained(frame(x=-0.4), robot=replace(ROBOT, centers=MIDDLE[None] + [0.4, 0.0, 0.2]))
    assert class_at(grid, (0.43, 0.0, 0.35)) == [EvidenceClass.OUT_OF_VIEW]


def test_only_what_is_near_the_robot_is_asked_about() -> None:
    grid = explained(robot_and_floor())
    centers = grid.origin + CONFIG.voxel * np.argwhere(grid.last_seen >= min(Unseen))
    away = np.linalg.norm(centers - MIDDLE, axis=1) - RADIUS
    assert len(away) and away.max() < ASKED_REACH + CONFIG.voxel


def test_a_reason_passes_when_a_ray_does_and_another_may_follow() -> None:
    """The robot goes, and its shadow with it; a thing hides what it hid."""
    grid, thing = explained(robot_and_floor()), frame()
    assert class_at(grid, UNDER) == [EvidenceClass.HIDDEN_BY_ARM]
    thing.depth[:] = 0.4
    assert class_at(explain(grid, thing), UNDER) == [EvidenceClass.HIDDEN_BY_THING]
    grid.take_in([frame()])
    assert class_at(grid, UNDER) == [EvidenceClass.FREE]


def test_what_was_looked_at_in_vain_stays_so() -> None:
    """The first reason stays."""
    grid = explained(robot_and_floor())
    for reason in (Unseen.CONTRADICTED, Unseen.UNANSWERED):
        grid.mark_unseen(np.array([UNDER]), reason)
        assert class_at(explain(grid, robot_and_floor()), UNDER) == [EvidenceClass.CONTRADICTED]


@pytest.mark.parametrize("is_drawn", [True, False])
def test_the_robots_body_sweeps_and_what_sticks_out_of_it_does_not(is_drawn: bool) -> None:
    """Its spheres are 5 cm larger than what is drawn of it."""
    large = replace(ROBOT, radii=np.array([RADIUS + 0.05]))
    if is_drawn:
        large = replace(
            large,
            surface=RobotSurface.from_balls(MIDDLE[None], np.array([RADIUS])),
            T_world_surface={0: np.eye(4)[None]},
        )
    expected = EvidenceClass.HIDDEN_BY_ARM if is_drawn else EvidenceClass.SWEPT
    assert class_at(explained(robot_and_floor(), robot=large), (0.0, 0.0, 0.175)) == [expected]
