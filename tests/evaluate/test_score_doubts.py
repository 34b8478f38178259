"""What speaks against a score: masks, poses and pictures that are wrong on purpose."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.score_doubts import Doubts
from splatctrl_cli.evaluate.views import View
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Bool, Float64, Intrinsics, RgbdFrame
from tests.plain import plain_frame

H, W = 24, 32


def frame(number: int) -> RgbdFrame:
    rng = np.random.default_rng(number)
    lens = Intrinsics(fx=30.0, fy=30.0, cx=15.5, cy=11.5, width=W, height=H)
    place = look_at([0.1 * number, -1.0, 0.4], [0.0, 0.0, 0.0])
    color = np.kron(rng.integers(0, 256, (3, 4, 3)), np.ones((8, 8, 1)))
    return plain_frame(1.0, lens, place, stamp_ns=number, camera="camera", color=color)


TRAINING = (frame(7), frame(8))


def view(number: int) -> View:
    return View(name=f"holdout-{number:04d}", frame=frame(number), training=TRAINING)


def render(number: int) -> Float64:
    return np.asarray(frame(number).color / 255.0 * 0.9)


def disc() -> Bool:
    v, u = np.mgrid[:H, :W]
    return np.asarray((u - 16) ** 2 + (v - 12) ** 2 < 60)


def lines_of(doubts: Doubts, numbers: tuple[int, ...], mask: Bool | None = None) -> list[str]:
    for number in numbers:
        doubts.look(view(number), render(number), mask)
    return doubts.lines()


def test_nothing_speaks_against_views_that_are_as_they_should_be() -> None:
    assert lines_of(Doubts(is_still=True, mask_rule="object mask"), (0, 1, 2), disc()) == []


def test_a_mask_inside_out_is_told_by_the_border_of_the_image() -> None:
    (line,) = lines_of(Doubts(is_still=True, mask_rule="object mask"), (0, 1), ~disc())
    assert line.startswith(
        "holdout-0000 has its mask on 100% of the image's border and 76% of the image (and 1 more)"
    )
    assert "is the mask turned inside out? it has to be 255 on the object" in line
    assert lines_of(Doubts(is_still=True, mask_rule="pixels with a reference depth"), (0, 1), ~disc()) == []


def test_a_mask_without_a_pixel_is_refused_with_the_view() -> None:
    with pytest.raises(
        InputError, match=r"holdout-0003: mask rule 'object mask': expected pixels .* got none of 768"
    ):
        lines_of(Doubts(is_still=True, mask_rule="object mask"), (3,), disc() & False)


def test_a_view_that_stands_where_one_trained_is_named_unless_that_is_meant() -> None:
    (line,) = lines_of(Doubts(is_still=True), (0, 8))
    assert line.startswith("holdout-0008 stands 0.0 mm and 0.00 degrees from a training view: a view that trained")
    assert lines_of(Doubts(is_still=True, may_train=True), (0, 8)) == []


def test_a_hair_beside_a_training_view_is_another_view() -> None:
    beside = replace(frame(8), T_world_camera=frame(8).T_world_camera.copy())
    beside.T_world_camera[0, 3] += 0.0011
    doubts = Doubts(is_still=True)
    doubts.look(View(name="a", frame=beside, training=TRAINING), render(8), None)
    assert doubts.lines() == []


def test_photos_that_belong_to_other_cameras_are_found() -> None:
    doubts = Doubts(is_still=True)
    for number, shown in ((0, 1), (1, 0), (2, 2)):
        doubts.look(view(number), render(shown), None)
    (line,) = doubts.lines()
    assert line.startswith("holdout-0000's photo is nearer the render of holdout-0001 (")
    assert line.endswith("(and 1 more): do the cameras belong to these images, and in this order?")


def test_where_things_move_a_photo_may_resemble_another_time() -> None:
    doubts = Doubts(is_still=False)
    for number, shown in ((0, 1), (1, 0)):
        doubts.look(view(number), render(shown), None)
    assert doubts.lines() == []
