"""The splats and balls that a field is made of, and whether they are dense and thick enough."""

import numpy as np
import pytest

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.field.clusters import NO_SPLAT, obstacle_spheres
from splatctrl_cli.field.slabs import field_health, median_spacing
from splatctrl_cli.records import Label
from splatctrl_cli.voxels import Balls
from tests.field.scenes import splat_set
from tests.refused import expect_refusal

KERNELS = ("se", "gpdf")


def square_lattice(spacing: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(10) * spacing, np.arange(10) * spacing)
    return np.stack([x.ravel(), y.ravel(), np.zeros(100)], axis=1)


FINE = square_lattice(0.01)


@pytest.mark.parametrize(
    ("centers", "radii", "length", "words"),
    [
        (FINE, np.full(100, 0.01), 0.02, ()),
        (FINE, np.full(100, 0.005), 0.02, (": the exact field's surface has holes between splats;",)),
        (FINE, np.full(100, 0.008), 0.009, ("spacing", "the sur")),
        (FINE, np.full(100, 0.01), 0.1, ("exceeds the extent of the splats, 0.09 m",)),
        (FINE, np.full(100, 0.01), 0.08, ()),
        (square_lattice(5.0), np.full(100, 5.0), 10.0, ("rounding",)),
        (square_lattice(5.0), np.full(100, 5.0), 9.9, ()),
        (FINE, np.r_[0.0, np.full(99, 0.01)], 0.02, ()),
        (FINE, np.r_[0.0, 0.00033, np.full(98, 0.01)], 0.02, ("radii from 0.33 to 10 mm in one set",)),
        (np.ones((5, 3)), np.full(5, 0.01), 0.02, ("all 5 splats have one centre",)),
        (np.ones((1, 3)), np.full(1, 0.01), 0.02, ()),
    ],
)
def test_each_ratio_out_of_range_has_its_warning(
    centers: np.ndarray, radii: np.ndarray, length: float, words: tuple[str, ...]
) -> None:
    for warning, part in zip(field_health(centers, radii, length, kernels=KERNELS)["warnings"], words, strict=True):
        assert part in warning


def test_a_field_is_not_warned_of_kernels_that_it_has_not() -> None:
    health = [field_health(FINE, np.full(100, 0.008), 0.009, kernels=names) for names in ((), ("se",), KERNELS)]
    assert [len(found["warnings"]) for found in health] == [0, 1, 2]
    assert health[0]["radius_per_spacing"] == pytest.approx(0.8)
    assert [median_spacing(points) for points in (np.zeros((1, 3)), np.zeros((5, 3)))] == [0.0, 0.0]


CENTERS = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])


def balls(*labels: int) -> Balls:
    centers = np.array([[0.2, 0.1 * i, 0.3] for i in range(len(labels))], np.float32).reshape(-1, 3)
    return Balls.from_voxels(centers, 0.02, np.array(labels, np.uint8))


def test_balls_follow_the_splats_and_say_that_they_are_none() -> None:
    splats = splat_set(CENTERS, np.array([0.01, 0.02]))
    for none in (None, balls()):
        assert obstacle_spheres(splats, none).index.tolist() == [0, 1]
    splats.labels[0] = Label.ROBOT
    found = obstacle_spheres(splats, balls(Label.OBJECT, Label.HUMAN))
    assert (found.index.tolist(), found.num_unrepresented) == ([1, NO_SPLAT, NO_SPLAT], 2)
    assert found.splats.centers.tolist() == np.float32([[0.5, 0, 0], [0.2, 0, 0.3], [0.2, 0.1, 0.3]]).tolist()
    assert found.splats.radii.tolist() == pytest.approx([0.02, 0.01 * 3**0.5, 0.01 * 3**0.5])
    assert found.splats.labels.tolist() == [Label.OBJECT, Label.OBJECT, Label.HUMAN]
    human = obstacle_spheres(splats, balls(Label.OBJECT, Label.HUMAN), {Label.HUMAN})
    assert (human.index.tolist(), human.splats.labels.tolist()) == ([NO_SPLAT], [Label.HUMAN])


def test_a_scene_of_nothing_at_all_has_no_field_and_a_wrong_label_is_named() -> None:
    robot = splat_set(CENTERS, np.array([0.01, 0.02]), Label.ROBOT)
    expect_refusal("none of 2", obstacle_spheres, robot, balls(), error=NotEvaluableError)
    assert len(obstacle_spheres(robot, balls(Label.OBJECT)).splats) == 1
    robot.labels[1] = 7
    expect_refusal("splat 1: expected a label", obstacle_spheres, robot, balls(Label.OBJECT))
