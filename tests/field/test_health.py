"""The splats and balls that a field is made of, and whether they are dense and thick enough."""

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.field.health import FieldHealth, median_spacing
from splatctrl_cli.field.health import field_health as health_of
from splatctrl_cli.field.unknown import NO_SPLAT, obstacle_spheres
from splatctrl_cli.records import Label
from splatctrl_cli.voxels import Balls
from tests.field.scenes import splat_set

KERNELS = ("se", "gpdf")


HOLES = "the exact field's surface has holes between splats"


def field_health(centers: np.ndarray, radii: np.ndarray, length: float) -> FieldHealth:
    return health_of(centers, radii, length, kernels=KERNELS)


def square_lattice(spacing: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(10) * spacing, np.arange(10) * spacing)
    return np.stack([x.ravel(), y.ravel(), np.zeros(100)], axis=1)


def test_spacing_of_a_lattice_is_its_pitch() -> None:
    assert median_spacing(square_lattice(0.01)) == pytest.approx(0.01)
    assert median_spacing(np.zeros((1, 3))) == 0.0
    assert median_spacing(np.zeros((5, 3))) == 0.0


def test_dense_thick_splats_have_no_warning() -> None:
    assert field_health(square_lattice(0.01), np.full(100, 0.01), 0.02).warnings == ()


def test_each_ratio_out_of_range_has_its_warning() -> None:
    thin = field_health(square_lattice(0.01), np.full(100, 0.005), 0.02)
    assert [w.partition(": ")[2].partition(";")[0] for w in thin.warnings] == [HOLES]
    short = field_health(square_lattice(0.01), np.full(100, 0.008), 0.009)
    assert [w.split(":")[0][:7] for w in short.warnings] == ["spacing", "the sur"]
    assert short.radius_per_spacing == pytest.approx(0.8)


def warnings_of(centers: np.ndarray, radii: np.ndarray, length: float) -> str:
    return "; ".join(field_health(centers, radii, length).warnings)


def test_a_length_scale_beyond_the_scene_is_warned_of() -> None:
    lattice, radii = square_lattice(0.01), np.full(100, 0.01)
    assert "exceeds the extent of the splats, 0.09 m" in warnings_of(lattice, radii, 0.1)
    assert "extent" not in warnings_of(lattice, radii, 0.08)
    assert "rounding" in warnings_of(square_lattice(5.0), np.full(100, 5.0), 10.0)
    assert "rounding" not in warnings_of(square_lattice(5.0), np.full(100, 5.0), 9.9)


def test_radii_that_differ_thirtyfold_are_warned_of() -> None:
    radii = np.full(100, 0.01)
    radii[3] = 0.0
    assert "in one set" not in warnings_of(square_lattice(0.01), radii, 0.02)
    radii[4] = 0.00033
    assert "radii from 0.33 to 10 mm in one set" in warnings_of(square_lattice(0.01), radii, 0.02)


def test_splats_at_one_place_are_warned_of_and_a_single_one_is_not() -> None:
    assert "all 5 splats stand at one place" in warnings_of(np.ones((5, 3)), np.full(5, 0.01), 0.02)
    assert warnings_of(np.ones((1, 3)), np.full(1, 0.01), 0.02) == ""


def test_a_field_is_not_warned_of_kernels_that_it_has_not() -> None:
    lattice, radii = square_lattice(0.01), np.full(100, 0.008)
    by_kernels = [len(health_of(lattice, radii, 0.009, kernels=names).warnings) for names in ((), ("se",), KERNELS)]
    assert by_kernels == [0, 1, 2]


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
