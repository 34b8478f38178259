"""Which views are scored, and which training frames count as known at their time."""

from collections.abc import Iterator

import numpy as np

from splatctrl_cli.evaluate.views import views_to_score
from splatctrl_cli.records import Intrinsics, JointState, LossReport, Record, RgbdFrame


def frame(stamp_ns: int, camera: str) -> RgbdFrame:
    return RgbdFrame(
        stamp_ns=stamp_ns,
        camera=camera,
        color=np.zeros((2, 2, 3), np.uint8),
        depth=np.ones((2, 2), np.float32),
        intrinsics=Intrinsics(fx=1.0, fy=1.0, cx=0.5, cy=0.5, width=2, height=2),
        T_world_camera=np.eye(4),
    )


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


def test_stamps_that_number_the_views_name_them() -> None:
    views = views_to_score(
        FakeSource(RECORDS), scoring=["held/out"], training=["a"], has_clock=False, numbered_by_stamp=True
    )
    assert [view.name for view in views] == ["held_out-0000", "held_out-0001", "held_out-0003"]
