"""Scenes with a cube to carry: the same by layout and number, of the heights stated, with room about the cube."""

import numpy as np
import pytest

from experiments.pick_and_place import (
    BOWL_RADIUS,
    CUBE,
    FREE,
    HEIGHTS,
    HELD,
    HOVER,
    LAYOUTS,
    TIP,
    PickAndPlace,
    drawn_scene,
)
from splatctrl_cli.records import Float64
from splatctrl_cli.simulate.primitives import Primitive, signed_distance

SCENES = [(layout, number) for layout in LAYOUTS for number in range(len(HEIGHTS))]


def others(scene: PickAndPlace) -> list[Primitive]:
    """What stands there beside the table, the bowl and what the cube stands on."""
    return [p for p in scene.things if p.name not in ("table", "bowl", "block")]


def corners(thing: Primitive) -> Float64:
    """Of a box, (8, 3) [m], world."""
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    return 0.5 * signs * thing.size @ thing.T_world_shape[:3, :3].T + thing.T_world_shape[:3, 3]


@pytest.mark.parametrize(("layout", "number"), SCENES)
def test_a_layout_and_a_number_draw_one_scene_and_another_attempt_another(layout: str, number: int) -> None:
    def solids(attempt: int) -> list[tuple[object, ...]]:
        scene = drawn_scene(layout, number, attempt)
        return [(p.name, p.size, p.T_world_shape.tolist(), p.texture) for p in (*scene.things, scene.cube)]

    assert solids(0) == solids(0) != solids(1)


@pytest.mark.parametrize(("layout", "number"), SCENES)
def test_nothing_stands_in_the_room_about_cube_and_bowl_nor_in_another_thing(layout: str, number: int) -> None:
    scene = drawn_scene(layout, number, 0)
    assert len(others(scene)) >= 5
    bowl = next(p for p in scene.things if p.name == "bowl")
    low, high = HEIGHTS[number]
    for place in (scene.cube.T_world_shape[:3, 3], bowl.T_world_shape[:3, 3]):
        heights = np.linspace(0.0, 0.35, 15)
        column = np.column_stack([np.tile(place[:2], (15, 1)), heights])
        assert min(signed_distance(p, column).min() for p in others(scene)) > FREE - 1e-9
    for thing in others(scene):
        tall = thing.size[2] if thing.kind == "box" else thing.size[-1] * (2 if thing.kind == "sphere" else 1)
        assert tall <= high and (tall >= low / 3)
        middle = thing.T_world_shape[:3, 3][None]
        apart = [p for p in others(scene) if p is not thing]
        assert min(signed_distance(p, middle)[0] for p in apart) > 0.0


def test_the_hand_about_the_cube_has_it_in_its_box_and_over_the_bowl_holds_it_clear_of_the_rim() -> None:
    for layout, number in SCENES:
        scene = drawn_scene(layout, number, 0)
        T_hand_world = np.linalg.inv(scene.T_world_grasp)
        held = corners(scene.cube) @ T_hand_world[:3, :3].T + T_hand_world[:3, 3]
        np.testing.assert_allclose([held.min(axis=0), held.max(axis=0)], [HELD.lower, HELD.upper], atol=1e-9)
        top = scene.cube.T_world_shape[2, 3] + CUBE / 2
        assert scene.T_world_hover[2, 3] - TIP - top == pytest.approx(HOVER)
        bowl = next(p for p in scene.things if p.name == "bowl")
        bottom = scene.T_world_place[2, 3] - HELD.upper[2]
        assert bottom - (bowl.T_world_shape[2, 3] + bowl.size[1] / 2) == pytest.approx(HOVER)
        assert bowl.size[0] == BOWL_RADIUS


def test_the_three_numbers_of_a_layout_are_low_mixed_and_tall() -> None:
    scenes = [others(drawn_scene("stacked", number, 0)) for number in range(len(HEIGHTS))]
    tallest = [max(corners(p)[:, 2].max() for p in scene if p.kind == "box") for scene in scenes]
    assert tallest[0] <= HEIGHTS[0][1] < max(tallest[1:])
