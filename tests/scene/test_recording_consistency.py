"""Whether views agree on where the surfaces are, and poses on a path."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config.fixed import PAIR_LIMIT
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.scene.recording_consistency import Agreement, agreements, differences, largest_jump
from tests.scene.wall import frame

RANGE = (0.2, 3.0)


def moved(view: RgbdFrame, **offset: float) -> RgbdFrame:
    """The same images with a pose that is off [m]."""
    T = view.T_world_camera.copy()
    T[:3, 3] += [offset.get(axis, 0.0) for axis in "xyz"]
    return replace(view, T_world_camera=T)


def views(**offset: float) -> list[RgbdFrame]:
    return [frame(block=0.2, x=0.1), moved(frame(block=0.2, x=-0.1, camera="cam1"), **offset)]


def test_cameras_with_good_poses_agree() -> None:
    (pair,) = agreements(views(), *RANGE)
    assert pair.cameras == ("cam0", "cam1") and pair.median < 1e-6 and pair.holds


@pytest.mark.parametrize(("offset", "holds"), [(0.01, True), (0.025, True), (0.035, False), (-0.09, False)])
def test_a_pose_that_is_off_shows_as_that_much(offset: float, holds: bool) -> None:
    """Views of one camera are compared, too."""
    for cameras in (("cam0", "cam1"), ("camera", "camera")):
        (pair,) = agreements(
            [replace(view, camera=name) for view, name in zip(views(z=offset), cameras, strict=True)], *RANGE
        )
        assert (pair.cameras, pair.holds, pair.median) == (cameras, holds, pytest.approx(abs(offset), abs=1e-6))


@pytest.mark.parametrize(
    ("values", "holds"),
    [
        ({"median": 0.1, "quartile": 0.01}, True),
        ({"median": 0.1, "quartile": 0.02}, False),
        ({"median": 1.01 * PAIR_LIMIT, "quartile": PAIR_LIMIT}, False),
        ({"median": 0.08, "quartile": 0.06, "depth": 3.0}, True),
        ({"median": 0.1, "quartile": 0.1, "detour": 0.9 * PAIR_LIMIT}, True),
        ({"median": 0.1, "quartile": 0.1, "detour": 1.1 * PAIR_LIMIT}, False),
    ],
)
def test_what_only_some_pixels_disagree_on_is_no_wrong_pose(values: dict[str, float], holds: bool) -> None:
    assert Agreement(**{"cameras": ("a", "b"), "num_pixels": 900, "depth": 0.8} | values).holds is holds  # type: ignore[arg-type]


def test_cameras_that_agree_with_a_third_see_two_sides_of_things_of_each_other() -> None:
    three = [*views(z=0.02), moved(frame(block=0.2, x=0.0, camera="cam2"), z=0.012)]
    detours = {pair.cameras: pair.detour for pair in agreements(three, *RANGE)}
    assert detours == {
        ("cam0", "cam1"): pytest.approx(0.02, abs=1e-6),
        ("cam0", "cam2"): pytest.approx(0.028, abs=1e-6),
        ("cam1", "cam2"): pytest.approx(0.032, abs=1e-6),
    }
    assert [pair.detour for pair in agreements(views(), *RANGE)] == [np.inf]


def test_too_few_common_pixels_say_nothing() -> None:
    for given in (views(x=5.0, z=0.5), views()[:1], []):
        assert agreements(given, *RANGE) == []


def test_neither_the_order_of_views_nor_a_common_motion_matters() -> None:
    a, b = views(z=0.05)
    (want,) = agreements([a, b], *RANGE)
    assert agreements([b, a], *RANGE) == [want]
    turn = pose_at([1.0, -2.0, 0.5], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    (got,) = agreements([replace(v, T_world_camera=turn @ v.T_world_camera) for v in (a, b)], *RANGE)
    assert got.median == pytest.approx(want.median, abs=1e-6)


def test_depth_that_is_missing_or_out_of_range_is_not_compared() -> None:
    a, b = views()
    blind = replace(b, depth=np.zeros_like(b.depth))
    for one, other, most in ((a, blind, 3.0), (blind, a, 3.0), (a, b, 0.7)):
        assert len(differences(one, other, 0.2, most)) == 0


def poses(*xs: float, period_ns: int = 100_000_000, camera: str = "a") -> list[tuple[int, str, Float64]]:
    return [(k * period_ns, camera, pose_at([x, 0.0, 0.0])) for k, x in enumerate(xs)]


def test_the_largest_jump_of_a_camera_is_found() -> None:
    jump = largest_jump([*poses(0.0, 0.1, 3.1, 3.2), *poses(9.0, 9.1, camera="b")])
    assert jump.distance == pytest.approx(3.0)
    assert (jump.camera, jump.before_ns, jump.after_ns) == ("a", 100_000_000, 200_000_000)


def test_cameras_apart_and_frames_long_after_each_other_are_no_jump() -> None:
    for given in (poses(0.0, 5.0, period_ns=2_000_000_000), poses(0.0) + poses(5.0, camera="b"), []):
        jump = largest_jump(given)
        assert jump is None or jump.distance == 0.0
