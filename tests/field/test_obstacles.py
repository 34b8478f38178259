"""Fields are made of splats and of occupied voxels without one."""

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.field.obstacles import NO_SPLAT, obstacle_spheres
from splatctrl_cli.records import Label
from splatctrl_cli.voxels import Balls
from tests.field.scenes import splat_set

CENTERS = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])


def balls(*labels: int) -> Balls:
    centers = np.array([[0.2, 0.1 * i, 0.3] for i in range(len(labels))], np.float32).reshape(-1, 3)
    return Balls.of_voxels(centers, 0.02, np.array(labels, np.uint8))


def test_balls_follow_the_splats_and_say_that_they_are_none() -> None:
    splats = splat_set(CENTERS, np.array([0.01, 0.02]))
    splats.labels[0] = Label.ROBOT
    found = obstacle_spheres(splats, balls(Label.OBJECT, Label.HUMAN))
    assert found.index.tolist() == [1, NO_SPLAT, NO_SPLAT]
    assert found.num_unrepresented == 2
    assert found.splats.centers.tolist() == np.float32([[0.5, 0, 0], [0.2, 0, 0.3], [0.2, 0.1, 0.3]]).tolist()
    assert found.splats.radii.tolist() == pytest.approx([0.02, 0.01 * 3**0.5, 0.01 * 3**0.5])
    assert found.splats.labels.tolist() == [Label.OBJECT, Label.OBJECT, Label.HUMAN]


def test_labels_choose_among_balls_too() -> None:
    splats = splat_set(CENTERS, np.array([0.01, 0.02]))
    found = obstacle_spheres(splats, balls(Label.OBJECT, Label.HUMAN), {Label.HUMAN})
    assert found.index.tolist() == [NO_SPLAT]
    assert found.splats.labels.tolist() == [Label.HUMAN]


@pytest.mark.parametrize("none", [None, balls()])
def test_without_balls_the_splats_are_as_before(none: Balls | None) -> None:
    found = obstacle_spheres(splat_set(CENTERS, np.array([0.01, 0.02])), none)
    assert found.index.tolist() == [0, 1]
    assert found.num_unrepresented == 0


def test_a_scene_of_nothing_at_all_has_no_field_and_a_wrong_label_is_named() -> None:
    robot = splat_set(CENTERS, np.array([0.01, 0.02]), Label.ROBOT)
    with pytest.raises(NotEvaluableError, match="none of 2"):
        obstacle_spheres(robot, balls())
    assert len(obstacle_spheres(robot, balls(Label.OBJECT)).splats) == 1
    robot.labels[1] = 7
    with pytest.raises(InputError, match="splat 1: expected a label"):
        obstacle_spheres(robot, balls(Label.OBJECT))
