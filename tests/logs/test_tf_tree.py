"""The tf tree: chains, time, and what it does not know."""

import numpy as np
import pytest

from splatctrl_cli.geometry import quat_from_rotation, rotation_from_quat, transform_from
from splatctrl_cli.logs.tf_tree import TfTree

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
QUARTER_TURN = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])  # about z


def moving_tree() -> TfTree:
    """base moves along world x at 1 m/s for one second and turns a quarter; the camera sits 0.5 m above it."""
    tree = TfTree()
    tree.add("world", "base", 0, np.zeros(3), IDENTITY, static=False)
    tree.add("world", "base", 1_000_000_000, np.array([1.0, 0, 0]), QUARTER_TURN, static=False)
    tree.add("base", "camera", 0, np.array([0, 0, 0.5]), IDENTITY, static=True)
    return tree


def test_a_moving_frame_is_interpolated_and_a_static_one_holds_always() -> None:
    T = moving_tree().lookup("world", "camera", 500_000_000)
    assert T is not None
    angle = np.pi / 4
    assert T[:3, 3] == pytest.approx([0.5, 0, 0.5])
    assert T[:2, :2] == pytest.approx(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]))
    early = moving_tree().lookup("world", "camera", 200_000_000)
    assert early is not None
    assert early[:3, 3] == pytest.approx([0.2, 0, 0.5])
    assert early[1, 0] == pytest.approx(np.sin(0.2 * np.pi / 2))


def test_siblings_are_joined_through_their_common_ancestor() -> None:
    tree = moving_tree()
    tree.add("base", "lamp", 0, np.array([0.2, 0, 0]), IDENTITY, static=True)
    tree.add("base", "arm", 0, np.array([0, 0.3, 0.1]), QUARTER_TURN, static=True)
    T = tree.lookup("arm", "lamp", 777_000_000)
    assert T is not None
    assert pytest.approx(transform_from([-0.3, -0.2, -0.1], -QUARTER_TURN * [1, 1, 1, -1]), abs=1e-12) == T


def test_outside_the_recorded_time_nothing_is_known_beyond_the_tolerance() -> None:
    tree = moving_tree()
    assert tree.lookup("world", "camera", 1_030_000_000, tolerance_ns=20_000_000) is None
    assert tree.lookup("world", "camera", -30_000_000, tolerance_ns=20_000_000) is None
    late = tree.lookup("world", "camera", 1_010_000_000, tolerance_ns=20_000_000)
    assert late is not None
    assert late[:3, 3] == pytest.approx([1.0, 0, 0.5])


def test_a_long_gap_is_bridged_only_where_nothing_moved() -> None:
    tree = TfTree()
    for stamp_s, x in ((0, 0.0), (5, 0.0), (10, 1.0)):
        tree.add("world", "base", stamp_s * 1_000_000_000, np.array([x, 0, 0]), IDENTITY, static=False)
    assert tree.lookup("world", "base", 2_000_000_000) is not None
    assert tree.lookup("world", "base", 7_000_000_000) is None


def test_unconnected_frames_have_no_transform() -> None:
    tree = moving_tree()
    tree.add("map", "other", 0, np.zeros(3), IDENTITY, static=True)
    assert tree.lookup("world", "other", 0) is None
    assert tree.roots == ("map", "world")
    assert tree.root_of("camera") == "world"


def test_a_second_parent_is_noted_and_the_first_kept() -> None:
    tree = moving_tree()
    tree.add("elsewhere", "camera", 0, np.array([9.0, 9, 9]), IDENTITY, static=True)
    T = tree.lookup("world", "camera", 0)
    assert T is not None
    assert T[:3, 3] == pytest.approx([0, 0, 0.5])
    assert "camera has parents base and elsewhere" in tree.notes[0]


@pytest.mark.parametrize("bottom", ["world", "base", "camera"])
def test_a_transform_that_would_close_a_loop_is_left_out_and_noted(bottom: str) -> None:
    tree = moving_tree()
    tree.add(bottom, "world", 0, np.array([9.0, 9, 9]), IDENTITY, static=True)
    T = tree.lookup("world", "camera", 0)
    assert T is not None
    assert T[:3, 3] == pytest.approx([0, 0, 0.5])
    assert tree.roots == ("world",) and tree.connects("world", "camera")
    assert f"tf: {bottom} -> world would close a loop" in tree.notes[0]


def test_a_zero_quaternion_is_refused() -> None:
    with pytest.raises(ValueError, match="not a rigid transform"):
        TfTree().add("a", "b", 0, np.zeros(3), np.zeros(4), static=True)


def test_slerp_passes_through_the_shorter_arc() -> None:
    tree = TfTree()
    tree.add("world", "base", 0, np.zeros(3), QUARTER_TURN, static=False)
    tree.add("world", "base", 100, np.zeros(3), -QUARTER_TURN, static=False)
    T = tree.lookup("world", "base", 50)
    assert T is not None
    assert quat_from_rotation(T[:3, :3]) == pytest.approx(QUARTER_TURN)
    assert T[:3, :3] == pytest.approx(rotation_from_quat(QUARTER_TURN))
