"""What is put and kept beside the robot."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import CONTACT_REACH, ROBOT_REACH
from splatctrl_cli.records import Box, Label, RgbdFrame
from splatctrl_cli.robot.declared_contact import Carried, Declarations
from splatctrl_cli.scene import fitter as fitter_module
from splatctrl_cli.scene.buffer import Seeds
from splatctrl_cli.scene.contact import contact_pixels, count_carried, hidden_objects
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import kept_radii
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.seeding import world_points
from splatctrl_cli.scene.self_mask import PixelKind, self_mask
from splatctrl_cli.scene.steady_depth import steadied
from tests.scene.test_labels import VISITOR, ball, seen_with, splats_at
from tests.scene.wall import WORKSPACE, frame

CONFIG = SceneConfig(max_splats=1500, first_iterations=100, iterations_per_step=10)


def test_pixels_of_objects_beside_the_robot_are_those_within_the_distance() -> None:
    robot = ball(0.3)
    view = seen_with(robot, block=VISITOR)
    mask = self_mask(view, robot, OccupancyConfig())
    chosen = contact_pixels(view, mask, robot)
    assert (mask.kinds[chosen] == PixelKind.OBJECT).all()
    assert not contact_pixels(view, mask, ball(5.0)).any()
    low = ball(0.249, 0.05)
    view = seen_with(low, block=VISITOR, x=0.3)
    near = contact_pixels(view, self_mask(view, low, OccupancyConfig()), low)
    points = world_points(view)[near]
    assert len(points) > 3
    assert (np.linalg.norm(points - [0.0, 0.0, 0.249], axis=1) < 0.05 + CONTACT_REACH).all()
    assert (np.abs(points[:, 2] - VISITOR) < 1e-5).all()


def test_objects_in_contact_get_splats_of_one_radius_up_to_what_is_measured() -> None:
    target, robot = SceneFitter(CONFIG, OccupancyConfig(), WORKSPACE), ball(0.28, 0.08)
    for _ in range(3):
        target.step([frame(block=VISITOR)], ball(5.0))
    view = seen_with(robot, block=VISITOR)  # the ball's lowest point touches the block's top
    for _ in range(2):
        target.step([view], robot)
    splats = target.splats()
    is_object = splats.labels == Label.OBJECT
    is_near = is_object & (robot.distance_to_moving(splats.centers) < CONTACT_REACH)
    assert is_near.sum() > 5
    hidden = CONFIG.contact_radius / 2  # what the ball hides, and at a silhouette
    assert ((splats.radii[is_near] > (1 - 1e-5) * hidden) & (splats.radii[is_near] <= CONFIG.contact_radius)).all()
    clearance = (
        np.min(np.linalg.norm(splats.centers[is_object] - [0, 0, 0.28], axis=1) - splats.radii[is_object]) - 0.08
    )
    assert -0.02 < clearance < 0.0, "contact is reported"


def test_a_carried_box_that_pixels_need_is_used_and_one_in_the_air_is_not() -> None:
    robot = ball(0.3, 0.05)
    assert robot.surface is not None
    view = frame(block=VISITOR)
    held = Box(lower=np.array([-0.1, -0.1, -0.3]), upper=np.array([0.1, 0.1, VISITOR - 0.3]))  # in the ball's frame
    aside = Box(lower=np.array([0.2, 0.2, 0.0]), upper=np.array([0.3, 0.3, 0.1]))
    declared = Declarations(carried=tuple(Carried(link="arm", box=box, start=0.0, end=1.0) for box in (held, aside)))
    at_frame = {0: np.repeat(robot.T_world_surface[0], 3, axis=0)}  # the link's pose, and that of each box
    holding = replace(robot, surface=robot.surface.with_boxes(declared.carried_at(0.5)), T_world_surface=at_frame)
    mask = self_mask(view, holding, OccupancyConfig())
    assert (mask.kinds == PixelKind.ROBOT).sum() > 100
    count_carried(declared, view, mask, holding, robot.surface, 0.5)
    assert declared.unused() == [("carried", 1)]


def test_what_the_robot_hides_of_an_object_is_not_fitted_to_the_robot() -> None:
    robot = ball(0.3)
    view = seen_with(robot)
    seen = [(view, self_mask(view, robot, OccupancyConfig()))]
    slots = splats_at((0.0, 0.0, 0.19), (0.3, 0.2, 0.0), (0.0, 0.0, 0.4))
    slots.labels[2] = Label.ROBOT
    assert hidden_objects(slots, robot, seen, OccupancyConfig()).tolist() == [0]
    assert hidden_objects(slots, None, seen, OccupancyConfig()).tolist() == []
    assert robot.surface is not None
    base = replace(robot, surface=replace(robot.surface, fixed=("arm",)))
    assert hidden_objects(slots, base, seen, OccupancyConfig()).tolist() == [0]  # what it stands on, too


def robot_over_the_floor() -> tuple[SceneFitter, RobotPosture, RgbdFrame]:
    """A fitter that has seen the floor, a ball 5 cm over it, and what a camera then sees."""
    target, robot = SceneFitter(CONFIG, OccupancyConfig(), WORKSPACE), ball(0.15)
    target.step([frame()], ball(5.0))
    return target, robot, seen_with(robot)


def test_near_the_robot_no_splat_reaches_past_the_surface_that_depth_shows() -> None:
    target, robot, view = robot_over_the_floor()
    target.buffer.set_radius(np.flatnonzero(target.buffer.is_alive), 0.02)
    target.step([view], robot)
    splats, config = target.splats(), OccupancyConfig()
    is_near = (splats.labels == Label.OBJECT) & (robot.distance(splats.centers) < ROBOT_REACH)
    centers, radii, least = splats.centers[is_near], splats.radii[is_near], 0.5 * CONFIG.contact_radius
    assert (radii > least).any() and (radii == np.float32(least)).sum() > 5
    error = self_mask(view, robot, config).reach - config.self_mask_tolerance
    assert (kept_radii(centers, radii, [target.view(view)], error, least) == radii).all()


def test_a_splat_of_the_robot_that_depth_shows_to_be_the_floor_is_small_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target, robot, view = robot_over_the_floor()
    target.step([view], robot)
    buffer, own = target.buffer, target.descent.run
    turned = np.flatnonzero(buffer.is_alive & (np.abs(np.hypot(*buffer.centers[:, :2].T) - 0.2) < 0.02))
    buffer.labels[turned] = Label.ROBOT
    buffer.set_radius(turned, 0.02)
    radii: list[float] = []

    def noting(*given: Any, **named: Any) -> Any:
        radii.extend(buffer.radii[turned[buffer.labels[turned] == Label.OBJECT]])
        return own(*given, **named)

    monkeypatch.setattr(target.descent, "run", noting)
    target.step([view], robot)
    assert len(radii) > 3 and np.allclose(radii, 0.5 * CONFIG.contact_radius)


def test_splats_that_the_descent_lifts_near_the_robot_go_back_onto_the_surface(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target, robot, view = robot_over_the_floor()
    own = target.descent.run
    lifted: list[int] = []

    def lifting(*given: Any, **named: Any) -> Any:
        terms = own(*given, **named)
        lifted.extend(np.flatnonzero(target.buffer.is_alive & (np.hypot(*target.buffer.centers[:, :2].T) > 0.2)))
        target.buffer.centers[lifted, 2] = 0.01
        return terms

    monkeypatch.setattr(target.descent, "run", lifting)
    target.step([view], robot)
    centers = target.buffer.centers[lifted][target.buffer.is_alive[lifted]]
    is_near = robot.distance(centers) < ROBOT_REACH - 0.02
    assert is_near.any() and np.abs(centers[is_near, 2]).max() < 1e-4
    assert np.median(centers[robot.distance(centers) > ROBOT_REACH, 2]) == np.float32(0.01)


def test_what_was_the_robots_before_is_told_to_the_running_mean_of_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    target, robot, view = robot_over_the_floor()
    target.step([view], robot)
    shown = target.seen[0][1].kinds
    assert (shown == PixelKind.ROBOT).any()
    before: list[Any] = []

    def spy(now: RgbdFrame, last: Any, *rest: Any) -> Any:
        before.append(last)
        return steadied(now, last, *rest)

    monkeypatch.setattr(fitter_module, "steadied", spy)
    target.step([view], robot)
    np.testing.assert_array_equal(before[0][1], shown == PixelKind.OBJECT)


def test_a_splat_that_the_descent_moves_behind_the_robot_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    target, robot, view = robot_over_the_floor()
    own = target.descent.run
    moved: list[int] = []

    def drifting(*given: Any, **named: Any) -> Any:
        terms = own(*given, **named)
        shown = np.flatnonzero(target.buffer.is_alive & (np.hypot(*target.buffer.centers[:, :2].T) > 0.25))
        moved.append(int(shown[0]))
        target.buffer.centers[shown[0]] = [0.0, 0.0, 0.03]  # between the ball and the floor
        return terms

    monkeypatch.setattr(target.descent, "run", drifting)
    target.step([view], robot)
    assert np.hypot(*target.buffer.centers[moved[0], :2]) > 0.2


def test_a_seed_in_contact_that_a_view_looks_past_is_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 mm over the floor: less than `see_through`, more than noise explains."""
    target, robot, view = robot_over_the_floor()
    center = np.float32([[0.25, 0.0, 0.012]])
    seed = Seeds(centers=center, radii=np.float32([0.01]), colors=np.float32([[1, 0, 0]]))
    monkeypatch.setattr(fitter_module, "contact_seeds", lambda *given, **named: seed)
    before = self_mask(view, robot, OccupancyConfig()).reach
    assert 0 < before < 0.012 < OccupancyConfig().see_through
    target.step([view], robot)
    assert np.linalg.norm(target.splats().centers - center, axis=1).min() > 1e-4


def test_contact_is_looked_for_where_depth_has_been_measured_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    target, robot, view = robot_over_the_floor()
    asked: list[Any] = []

    def recorded(seen: Any, mappable: Any, *given: Any, **named: Any) -> Seeds:
        asked.append(mappable[0])
        return Seeds(centers=np.zeros((0, 3), np.float32), radii=np.zeros(0, np.float32), colors=np.zeros((0, 3)))

    monkeypatch.setattr(fitter_module, "contact_seeds", recorded)
    target.step([view], robot)
    target.step([view], robot)
    depth, places = view.depth.copy(), np.argwhere(asked[-1])
    v, u = places[len(places) // 2]
    depth[v, u] -= 0.05
    target.step([replace(view, depth=depth)], robot)
    assert not asked[-1][v, u]
    assert asked[-1].sum() > 0.9 * asked[-2].sum()
