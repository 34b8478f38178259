"""What is put and kept beside the robot."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import CONTACT_REACH, ROBOT_REACH
from splatctrl_cli.records import Box, Label, RgbdFrame
from splatctrl_cli.robot.declared_contact import Declarations, DeclaredContact
from splatctrl_cli.scene import fitter as fitter_module
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import shrink_radii
from splatctrl_cli.scene.labels import contact_pixels, count_carried, hidden_objects, lasts_at_fixed_links
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.seeding import world_points
from splatctrl_cli.scene.self_mask import PixelKind, self_mask
from splatctrl_cli.scene.surface_depth import steady_depth
from tests.scene.test_labels import VISITOR, ball, seen_and_masked, seen_with, splats_at
from tests.scene.wall import WORKSPACE, frame, plain_seeds

CONFIG = SceneConfig(max_splats=1500, first_iterations=100, iterations_per_step=10)


def test_pixels_of_objects_beside_the_robot_are_those_within_the_distance() -> None:
    robot, low = ball(0.3), ball(0.249, 0.05)
    view, mask = seen_and_masked(robot, block=VISITOR)
    assert (mask.kinds[contact_pixels(view, mask, robot)] == PixelKind.OBJECT).all()
    assert not contact_pixels(view, mask, ball(5.0)).any()
    view = seen_with(low, block=VISITOR, x=0.3)
    points = world_points(view)[contact_pixels(view, self_mask(view, low, OccupancyConfig()), low)]
    assert len(points) > 3 and (np.abs(points[:, 2] - VISITOR) < 1e-5).all()
    assert (np.linalg.norm(points - [0.0, 0.0, 0.249], axis=1) < 0.05 + CONTACT_REACH).all()


def test_objects_in_contact_get_splats_of_one_radius_up_to_what_is_measured() -> None:
    """The ball's lowest point touches the block's top; half of the radius has what the ball hides."""
    target, robot = SceneFitter(CONFIG, OccupancyConfig(), WORKSPACE), ball(0.28, 0.08)
    for view, posture in (*[(frame(block=VISITOR), ball(5.0))] * 3, *[(seen_with(robot, block=VISITOR), robot)] * 2):
        target.step([view], posture)
    objects = target.splats().select(target.splats().labels == Label.OBJECT)
    radii = objects.radii[robot.distance(objects.centers, to_moving=True) < CONTACT_REACH]
    assert len(radii) > 5
    assert ((radii > (1 - 1e-5) * CONFIG.contact_radius / 2) & (radii <= CONFIG.contact_radius)).all()
    clearance = np.min(np.linalg.norm(objects.centers - [0, 0, 0.28], axis=1) - objects.radii) - 0.08
    assert -0.02 < clearance < 0.0, "contact is reported"


def test_a_carried_box_that_pixels_need_is_used_and_one_in_the_air_is_not() -> None:
    robot, view = ball(0.3, 0.05), frame(block=VISITOR)
    held = Box(lower=np.array([-0.1, -0.1, -0.3]), upper=np.array([0.1, 0.1, VISITOR - 0.3]))  # in the ball's frame
    aside = Box(lower=np.array([0.2, 0.2, 0.0]), upper=np.array([0.3, 0.3, 0.1]))
    declared = Declarations(
        carried=tuple(DeclaredContact(link="arm", box=box, start=0.0, end=1.0) for box in (held, aside))
    )
    at_frame = {0: np.repeat(robot.T_world_surface[0], 3, axis=0)}  # the link's pose, and that of each box
    holding = replace(robot, surface=robot.surface.add_boxes(declared.carried_at(0.5)), T_world_surface=at_frame)
    mask = self_mask(view, holding, OccupancyConfig())
    assert (mask.kinds == PixelKind.ROBOT).sum() > 100
    count_carried(declared, view, mask, holding, robot.surface, 0.5)
    assert declared.unused() == [("carried", 1)]


def test_what_the_robot_hides_of_an_object_is_not_fitted_to_the_robot() -> None:
    """Nor what stands on what a robot's base hides."""
    robot, slots = ball(0.3), splats_at((0.0, 0.0, 0.19), (0.3, 0.2, 0.0), (0.0, 0.0, 0.4))
    slots.labels[2] = Label.ROBOT
    base = replace(robot, surface=replace(robot.surface, fixed=("arm",)))
    for posture, hidden in ((robot, [0]), (None, []), (base, [0])):
        assert hidden_objects(slots, posture, [seen_and_masked(robot)], OccupancyConfig()).tolist() == hidden


@pytest.mark.parametrize(
    ("is_fixed", "place", "lasts", "is_kept"),
    [
        pytest.param(True, (0.15, 0.0, 0.03), True, False, id="before what a lasting pixel shows"),
        pytest.param(True, (0.15, 0.0, 0.0), True, True, id="where a lasting pixel shows it"),
        pytest.param(True, (0.15, 0.0, 0.0), False, False, id="where no pixel lasts"),
        pytest.param(False, (0.15, 0.0, 0.03), False, True, id="at a link that moves"),
        pytest.param(True, (0.5, 0.4, 0.03), False, True, id="far from the robot"),
    ],
)
def test_gaps_at_a_fixed_link_are_filled_where_a_surface_lasts(
    is_fixed: bool, place: tuple[float, float, float], lasts: bool, is_kept: bool
) -> None:
    robot = ball(0.15)
    view = seen_with(robot)
    base = replace(robot, surface=replace(robot.surface, fixed=("arm",) if is_fixed else ()))
    found = lasts_at_fixed_links(
        base, [view], [np.full(view.depth.shape, lasts)], OccupancyConfig(), np.array([place], np.float32)
    )
    assert found.tolist() == [is_kept]


def test_the_first_map_is_filled_before_anything_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    spy = Mock(side_effect=lambda *given: np.zeros(len(given[4]), bool))
    monkeypatch.setattr(fitter_module, "lasts_at_fixed_links", spy)
    target, robot, view = robot_over_the_floor()
    assert not spy.called
    target.step([view], robot)
    spy.assert_called_once()
    assert spy.call_args.args[2][0].any()


def robot_over_the_floor() -> tuple[SceneFitter, RobotPosture, RgbdFrame]:
    """A fitter that has seen the floor, a ball 5 cm over it, and what a camera then sees."""
    target, robot = SceneFitter(CONFIG, OccupancyConfig(), WORKSPACE), ball(0.15)
    target.step([frame()], ball(5.0))
    return target, robot, seen_with(robot)


def with_descent(
    target: SceneFitter,
    monkeypatch: pytest.MonkeyPatch,
    *,
    before: Callable[[], object] = int,
    after: Callable[[], object] = int,
) -> None:
    """Do something before or after each descent."""
    own = target.descent.run

    def run(*given: Any, **named: Any) -> Any:
        before()
        terms = own(*given, **named)
        after()
        return terms

    monkeypatch.setattr(target.descent, "run", run)


def test_near_the_robot_no_splat_reaches_past_the_surface_that_depth_shows() -> None:
    target, robot, view = robot_over_the_floor()
    target.buffer.set_radius(np.flatnonzero(target.buffer.is_alive), 0.02)
    target.step([view], robot)
    config, least = OccupancyConfig(), 0.5 * CONFIG.contact_radius
    objects = target.splats().select(target.splats().labels == Label.OBJECT)
    near = objects.select(robot.distance(objects.centers) < ROBOT_REACH)
    assert (near.radii > least).any() and (near.radii == np.float32(least)).sum() > 5
    error = self_mask(view, robot, config).reach - config.self_mask_tolerance
    assert (shrink_radii(near.centers, near.radii, [target.view(view)], error, least) == near.radii).all()


def test_a_splat_of_the_robot_that_depth_shows_to_be_the_floor_is_small_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target, robot, view = robot_over_the_floor()
    target.step([view], robot)
    buffer, radii = target.buffer, []
    turned = np.flatnonzero(buffer.is_alive & (np.abs(np.hypot(*buffer.centers[:, :2].T) - 0.2) < 0.02))
    buffer.labels[turned] = Label.ROBOT
    buffer.set_radius(turned, 0.02)
    with_descent(
        target, monkeypatch, before=lambda: radii.extend(buffer.radii[turned[buffer.labels[turned] == Label.OBJECT]])
    )
    target.step([view], robot)
    assert len(radii) > 3 and np.allclose(radii, 0.5 * CONFIG.contact_radius)


def test_splats_that_the_descent_lifts_go_back_onto_the_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    """The descent lifts some into the air, near the robot and far from it, and moves one behind the robot."""
    target, robot, view = robot_over_the_floor()
    buffer, moved = target.buffer, []

    def move() -> None:
        moved.extend(np.flatnonzero(buffer.is_alive & (np.hypot(*buffer.centers[:, :2].T) > 0.2)))
        buffer.centers[moved, 2] = 0.01
        buffer.centers[moved[0]] = [0.0, 0.0, 0.03]  # between the ball and the floor

    with_descent(target, monkeypatch, after=move)
    target.step([view], robot)
    assert np.hypot(*buffer.centers[moved[0], :2]) > 0.2
    centers = buffer.centers[moved][buffer.is_alive[moved]]
    assert np.unique(robot.distance(centers) < ROBOT_REACH).tolist() == [False, True]
    assert np.abs(centers[:, 2]).max() < 1e-4


@pytest.mark.parametrize(
    ("place", "is_removed"),
    [
        pytest.param((0.35, 0.3, -0.045), True, id="far away, behind the floor"),
        pytest.param((0.35, 0.3, -0.015), False, id="far away, within a voxel of the floor"),
        pytest.param((0.0, 0.0, -0.045), False, id="behind the floor, near the robot"),
    ],
)
def test_far_splats_in_unseen_space_are_removed(place: tuple[float, float, float], is_removed: bool) -> None:
    target, robot, view = robot_over_the_floor()
    target.buffer.centers[np.flatnonzero(target.buffer.is_alive)[0]] = place
    assert target.step([view], robot).removed["uncertain"] == is_removed
    assert (np.linalg.norm(target.splats().centers - np.float32(place), axis=1).min() < 0.005) == (not is_removed)


@pytest.mark.parametrize("max_splats", [1500, 60])
def test_far_splats_shrink_to_a_centimetre_while_slots_are_left(max_splats: int) -> None:
    target = SceneFitter(replace(CONFIG, max_splats=max_splats), OccupancyConfig(), WORKSPACE)
    target.step([frame()], ball(5.0))
    alive = np.flatnonzero(target.buffer.is_alive)
    assert (len(alive) > 0.95 * max_splats) == (max_splats < 100)
    target.buffer.set_radius(alive, 0.02)
    target.step([frame()], ball(5.0))
    protrusion = target.splats().centers[:, 2] + target.splats().radii
    assert np.median(protrusion) > 0.015 if max_splats < 100 else protrusion.max() < 0.0101


def test_what_was_the_robots_before_is_told_to_the_running_mean_of_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    target, robot, view = robot_over_the_floor()
    target.step([view], robot)
    shown = target.seen[0][1].kinds
    assert (shown == PixelKind.ROBOT).any()
    spy = Mock(side_effect=steady_depth)
    monkeypatch.setattr(fitter_module, "steady_depth", spy)
    target.step([view], robot)
    np.testing.assert_array_equal(spy.call_args_list[0].args[1][1], shown == PixelKind.OBJECT)


def test_a_seed_in_contact_that_a_view_looks_past_is_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 mm over the floor: less than `see_through`, more than noise explains."""
    target, robot, view = robot_over_the_floor()
    center = np.float32([[0.25, 0.0, 0.012]])
    monkeypatch.setattr(fitter_module, "contact_seeds", lambda *given, **named: plain_seeds(center, 0.01))
    assert 0 < self_mask(view, robot, OccupancyConfig()).reach < 0.012 < OccupancyConfig().see_through
    target.step([view], robot)
    assert np.linalg.norm(target.splats().centers - center, axis=1).min() > 1e-4


def test_contact_is_looked_for_where_depth_has_been_measured_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    target, robot, view = robot_over_the_floor()
    spy = Mock(return_value=plain_seeds([], 0.01))
    monkeypatch.setattr(fitter_module, "contact_seeds", spy)
    target.step([view], robot)
    target.step([view], robot)
    depth, places = view.depth.copy(), np.argwhere(spy.call_args.args[1][0])
    v, u = places[len(places) // 2]
    depth[v, u] -= 0.05
    target.step([replace(view, depth=depth)], robot)
    asked = spy.call_args.args[1][0]
    assert not asked[v, u] and asked.sum() > 0.9 * len(places)
