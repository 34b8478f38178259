"""A recording of the same names is told from the one that made a scene, with figures."""

import json
from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.calibration.evidence import transform_of
from splatctrl_cli.geometry import look_at
from splatctrl_cli.jobs.recordings.provenance import changed_files, differences, first_frame
from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame, UInt8
from tests.plain import plain_frame

SECOND = 1_000_000_000


def frame(camera: str = "cam0", second: float = 1.0, eye: tuple[float, ...] = (0.0, 0.0, 0.0)) -> RgbdFrame:
    color = np.random.default_rng(3).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    lens = Intrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
    place = look_at(eye, [1.0, 0.0, 0.0])
    return plain_frame(1.0, lens, place, stamp_ns=round(second * SECOND), camera=camera, color=color)


def with_a_thing_moved() -> UInt8:
    color = frame().color.copy()
    color[8:16, 8:16] = 0
    return color


def kept(*frames: RgbdFrame) -> list[dict[str, object]]:
    """As ``run.json`` holds them."""
    return list(json.loads(json.dumps([first_frame(f) for f in frames])))


def turned(T: Float64, degrees: float) -> Float64:
    return T @ transform_of(np.array([0.0, 0.0, np.radians(degrees), 0.0, 0.0, 0.0]))


def test_the_same_recording_differs_in_nothing_nor_does_its_picture_saved_anew() -> None:
    recorded = kept(frame(), frame("cam1", 2.0))
    records = [frame(second=0.5), frame(), frame("cam1", 1.0), frame("cam1", 2.0), frame(second=3.0)]
    assert differences(recorded, iter(records)) == []
    noise = np.random.default_rng(0).integers(-3, 4, (48, 64, 3))
    again = replace(frame(), color=np.clip(frame().color.astype(int) + noise, 0, 255).astype(np.uint8))
    assert differences(kept(frame()), iter([again])) == []


def test_reading_stops_where_every_first_frame_was_met() -> None:
    def records() -> object:
        yield frame()
        yield frame(second=1.5)
        pytest.fail("read on")

    assert differences(kept(frame(second=1.0)), records()) == []  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("other", "line"),
    [
        (
            replace(frame(), intrinsics=Intrinsics(fx=66.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)),
            "cam0: intrinsics differ by 6.0 px",
        ),
        (frame(eye=(0.0, 0.031, 0.0)), "cam0: the pose differs by 31 mm and 1.8 degrees"),
        (replace(frame(), T_world_camera=turned(frame().T_world_camera, 5.0)), "by 0 mm and 5.0 degrees"),
        (frame(second=4.5), "cam0: its nearest frame is 3.5 s after the one that trained"),
        (frame(second=0.5), "cam0: its nearest frame is 0.5 s before the one that trained"),
        (replace(frame(), color=255 - frame().color), "cam0: the picture differs by up to "),
        (replace(frame(), color=with_a_thing_moved()), "the picture differs by up to"),
        (replace(frame(), camera="cam7"), "has no camera cam0"),
        (
            replace(
                frame(),
                color=frame().color[::2, ::2],
                intrinsics=Intrinsics(fx=30.0, fy=30.0, cx=15.5, cy=11.5, width=32, height=24),
            ),
            "cam0: images of 32x24, not 64x48",
        ),
    ],
)
def test_each_difference_is_named_with_its_figure(other: RgbdFrame, line: str) -> None:
    (found,) = differences(kept(frame()), iter([other]))
    assert line in found


def test_files_of_the_same_name_and_another_digest_are_counted() -> None:
    assert changed_files({"log.mcap": "1"}, {"log.mcap": "2"}) == ["log.mcap has other contents"]
    assert changed_files({"log.mcap": "1"}, {"desk.capture": "2"}) == []
    assert changed_files({"a.toml": "1", "b": "2"}, {"a.toml": "3", "b": "2"}) == []
    (line,) = changed_files({"a": "1", "b": "2", "c": "3"}, {"a": "1", "b": "0", "c": "0", "d": "4"})
    assert line == "2 of 3 files have other contents, such as b"
