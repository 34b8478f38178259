"""Frames by time steps: a depth image that comes again with a new stamp shows nothing new."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.time_steps import TimeStep, time_steps
from tests.scene.wall import frame

EVERY_NS = 100_000_000


def frames(*depths: float, camera: str = "cam0") -> list[RgbdFrame]:
    """Frames of one camera at 10 Hz. They differ in the depth [m] of one pixel, and all in their live colour."""
    found = [frame(stamp_ns=number * EVERY_NS, camera=camera) for number in range(len(depths))]
    for number, seen in enumerate(found):
        seen.depth[0, 0], seen.color[:] = depths[number], number
    return found


def steps(*cameras: Sequence[RgbdFrame], has_clock: bool = True) -> tuple[list[TimeStep], Counter[str]]:
    records = sorted((each for its in cameras for each in its), key=lambda each: each.stamp_ns)
    repeats: Counter[str] = Counter()
    return list(
        time_steps(iter(records), {each.camera for each in records}, has_clock=has_clock, repeats=repeats)
    ), repeats


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [
        ([frames(1.0, 1.1, 1.1, 1.1, 1.0)], [(0, ["cam0"]), (1, ["cam0"]), (4, ["cam0"])]),
        (
            [frames(1.0, 1.0, 1.0), frames(1.0, 1.1, 1.2, camera="cam1")],
            [(0, ["cam0", "cam1"]), (1, ["cam1"]), (2, ["cam1"])],
        ),
    ],
    ids=["one camera", "beside a camera that goes on"],
)
def test_depth_that_equals_the_image_before_is_left_out_and_counted_though_its_colour_is_new(
    cameras: list[list[RgbdFrame]], expected: list[tuple[int, list[str]]]
) -> None:
    found, repeats = steps(*cameras)
    assert [(step.stamp_ns // EVERY_NS, [each.camera for each in step.frames]) for step in found] == expected
    assert repeats == {"cam0": 2}


def test_images_without_depth_and_views_without_a_clock_never_repeat() -> None:
    dark = [replace(each, depth=np.zeros_like(each.depth)) for each in frames(1.0, 1.0)]
    assert [len(step.frames) for step in steps(dark)[0]] == [1, 1]
    assert [len(step.frames) for step in steps(frames(1.0, 1.0), has_clock=False)[0]] == [2]
