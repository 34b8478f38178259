"""Which views are scored, what counts as known at their time, and which points cameras saw."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.evaluate.views import seen_by, seen_pixels, surface_points, views_to_score
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Float64, Intrinsics, JointState, LossReport, Record, RgbdFrame
from tests.plain import plain_frame


def frame(stamp_ns: int, camera: str) -> RgbdFrame:
    lens = Intrinsics(fx=1.0, fy=1.0, cx=0.5, cy=0.5, width=2, height=2)
    return plain_frame(1.0, lens, stamp_ns=stamp_ns, camera=camera)


class FakeSource:
    """Records from a list."""

    name = "fake"
    cameras = ("a", "b", "held/out")
    joint_names: tuple[str, ...] = ()
    has_clock = True
    loss = LossReport()

    def __init__(self, records: list[Record]) -> None:
        self._records = records

    def records(self) -> Iterator[Record]:
        return iter(self._records)

    def digests(self) -> dict[str, str]:
        return {}


JOINTS = JointState(stamp_ns=1, position=np.zeros(1), velocity=np.zeros(1))
RECORDS: list[Record] = [
    *(frame(0, "held/out"), JOINTS, frame(1, "a"), frame(1, "held/out"), frame(1, "b")),
    *(frame(2, "a"), frame(3, "held/out"), frame(4, "b")),
]


def known(has_clock: bool, training: tuple[str, ...] = ("a", "b")) -> list[tuple[str, list[tuple[str, int]]]]:
    views = views_to_score(FakeSource(RECORDS), scoring=["held/out"], training=training, has_clock=has_clock)
    return [(view.name, sorted((f.camera, f.stamp_ns) for f in view.training)) for view in views]


def test_with_a_clock_the_newest_frame_of_each_camera_up_to_that_very_stamp_counts() -> None:
    assert known(has_clock=True) == [
        ("held_out-0000", []),
        ("held_out-0001", [("a", 1), ("b", 1)]),
        ("held_out-0002", [("a", 2), ("b", 1)]),
    ]


def test_without_a_clock_every_training_frame_counts() -> None:
    every = [("a", 1), ("a", 2), ("b", 1), ("b", 4)]
    assert known(has_clock=False) == [("held_out-0000", every), ("held_out-0002", every), ("held_out-0005", every)]


def test_only_training_cameras_count() -> None:
    assert known(has_clock=True, training=("b",))[2] == ("held_out-0002", [("b", 1)])


def test_nothing_is_scored_where_no_frame_is() -> None:
    assert list(views_to_score(FakeSource([]), scoring=["a"], training=["b"], has_clock=True)) == []


def test_a_log_is_scored_at_the_poses_that_its_scene_was_trained_at() -> None:
    def corrected(frame: RgbdFrame) -> RgbdFrame:
        return replace(frame, T_world_camera=2.0 * np.eye(4))

    source = FakeSource(RECORDS)
    views = [*views_to_score(source, scoring=["held/out"], training=["a"], has_clock=True, corrected=corrected)]
    frames = [frame for view in views for frame in (view.frame, *view.training)]
    assert len(frames) > len(views) > 0
    assert all(np.array_equal(frame.T_world_camera, 2.0 * np.eye(4)) for frame in frames)


def test_stamps_that_number_the_views_name_them() -> None:
    views = views_to_score(
        FakeSource(RECORDS), scoring=["held/out"], training=["a"], has_clock=False, numbered_by_stamp=True
    )
    assert [view.name for view in views] == ["held_out-0000", "held_out-0001", "held_out-0003"]


INTRINSICS = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)


def wall_frame(T_world_camera: Float64 | None = None) -> RgbdFrame:
    depth = np.full((48, 64), 2.0, dtype=np.float32)
    depth[:, :32] = 1.0
    depth[0] = 0.0
    return plain_frame(depth, INTRINSICS, T_world_camera)


def points(values: ArrayLike) -> Float64:
    return np.asarray(values, dtype=np.float64).reshape(-1, 3)


def test_a_point_on_a_measured_surface_is_seen_within_the_tolerance() -> None:
    frame = wall_frame()
    on_wall = points([[0.5, 0.0, 2.0], [0.5, 0.0, 2.019], [0.5, 0.0, 2.021], [0.5, 0.0, 1.979]])
    assert seen_by(on_wall, [frame]).tolist() == [True, True, False, False]
    assert seen_by(on_wall, [frame], tolerance=0.03).all()


def test_a_point_behind_a_surface_or_in_front_of_it_or_behind_the_camera_is_not_seen() -> None:
    assert not seen_by(
        points([[-0.5, 0.0, 2.0], [0.5, 0.0, 1.0], [0.5, 0.0, -2.0], [0.0, 0.0, 0.0]]), [wall_frame()]
    ).any()


def test_a_point_outside_the_image_or_at_a_pixel_without_depth_is_not_seen() -> None:
    top_row = [0.5, (0 - 23.5) / 50 * 2.0, 2.0]
    assert not seen_by(points([[5.0, 0.0, 2.0], [0.5, -3.0, 2.0], top_row]), [wall_frame()]).any()


def test_a_pixel_reaches_half_a_pixel_around_its_centre() -> None:
    last = (63 + 0.49 - 31.5) / 50 * 2.0
    beyond = (63 + 0.51 - 31.5) / 50 * 2.0
    assert seen_by(points([[last, 0.0, 2.0], [beyond, 0.0, 2.0]]), [wall_frame()]).tolist() == [True, False]


def test_a_frame_sees_all_its_own_surface_from_any_pose() -> None:
    frame = wall_frame(look_at([1.0, 2.0, 3.0], [0.0, 0.0, 0.5]))
    own, valid = surface_points(frame)
    assert len(own) == 47 * 64 == valid.sum()
    assert seen_by(own, [frame]).all()
    assert np.array_equal(seen_pixels(frame, [frame]), valid)


def test_what_is_seen_does_not_hang_on_the_order_of_the_cameras() -> None:
    frame = wall_frame(look_at([0.5, -2.0, 0.4], [0.0, 0.0, 0.5]))
    others = [wall_frame(look_at([0.1 * n, -2.0, 0.4], [0.2, 0.0, 0.5])) for n in (4, 0, 6)]
    seen = seen_pixels(frame, others)
    assert 0 < seen.sum() < seen.size
    assert np.array_equal(seen, seen_pixels(frame, others[::-1]))


def test_any_frame_suffices_and_no_frame_sees_nothing() -> None:
    away = wall_frame(look_at([0.0, 0.0, 0.0], [0.0, 0.0, -1.0], up=(0.0, 1.0, 0.0)))
    target = points([[0.5, 0.0, 2.0]])
    assert not seen_by(target, [away]).any()
    assert seen_by(target, [away, wall_frame()]).all()
    assert not seen_by(target, []).any()
    assert seen_by(points([]), [wall_frame()]).shape == (0,)
