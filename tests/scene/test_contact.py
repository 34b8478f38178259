"""What is put and kept beside the robot."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import CONTACT_REACH
from splatctrl_cli.records import Box, Label
from splatctrl_cli.robot.declared_contact import Carried, Declarations
from splatctrl_cli.scene.contact import contact_pixels, count_carried, hidden_objects
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.seeding import world_points
from splatctrl_cli.scene.self_mask import PixelKind, self_mask
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
    np.testing.assert_allclose(splats.radii[is_near], CONFIG.contact_radius, rtol=1e-5)
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
