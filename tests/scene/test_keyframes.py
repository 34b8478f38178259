"""Which views the optimiser looks at."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.scene.keyframes import View, Window, make_view, move_to_surface, shrink_radii
from splatctrl_cli.scene.self_mask import pixels_at
from tests.scene.wall import frame

CONFIG = SceneConfig(window=3)


def view(stamp_ns: int, x: float = 0.0, camera: str = "cam0") -> View:
    seen = frame(stamp_ns, x=x, camera=camera)
    return make_view(seen, seen.depth > 0)


def stamps(views: list[View]) -> list[int]:
    return [v.frame.stamp_ns for v in views]


def moving() -> Window:
    """A window of a camera that moved in seven time steps."""
    window = Window(CONFIG)
    for k in range(7):
        window.advance([view(k, x=0.1 * k)])
    return window


def test_a_camera_that_stands_still_makes_no_keyframes() -> None:
    """And a silent camera keeps its newest view."""
    window = Window(CONFIG)
    for k in range(6):
        window.advance([view(k), view(k, x=0.3, camera="cam1")])
    assert (window.keyframes, stamps(window.newest)) == ([], [5, 5])
    window.advance([view(6)])
    assert sorted(stamps(window.newest)) == [5, 6]


def test_a_camera_that_moves_leaves_keyframes_oldest_dropped_first() -> None:
    assert (stamps(moving().keyframes), stamps(moving().newest)) == ([3, 4, 5], [6])


def test_every_round_shows_all_newest_views_and_as_many_keyframes() -> None:
    shown = stamps(moving().schedule(10, np.random.default_rng(0)))
    assert len(shown) == 10 and len(set(shown)) > 2 and all(6 in shown[i : i + 2] for i in range(0, 10, 2))
    assert Window(CONFIG).schedule(5, np.random.default_rng(0)) == []


def test_pixels_without_depth_count_and_pixels_outside_the_workspace_do_not() -> None:
    seen = frame()
    seen.depth[:10] = 0.0
    mappable = (seen.depth > 0) & (np.arange(60) < 50)[:, None]
    made = make_view(seen, mappable)
    assert made.target.counted[:50].all() and not made.target.counted[50:].any()
    assert np.array_equal(made.mappable, mappable)


def test_pixels_that_the_lens_did_not_see_count_neither_for_colour_nor_for_depth() -> None:
    seen, valid = frame(), np.broadcast_to(np.arange(80) >= 7, (60, 80))
    made = make_view(replace(seen, valid=valid), seen.depth > 0)
    assert np.array_equal(made.target.counted > 0, valid)
    assert np.array_equal(made.mappable, valid & (seen.depth > 0))


def test_a_sphere_sticks_out_of_what_depth_shows_by_the_sensors_error_at_most() -> None:
    """On the floor, beneath it, at the rim of a block and within it, and where no camera looks."""
    views = [make_view(frame(block=0.2), np.ones((60, 80), bool))]
    centers = np.float32(
        [[0.25, 0.2, 0.0], [0.25, 0.2, -0.015], [0.09, 0.0, 0.15], [0.0, 0.0, 0.15], [9.0, 0.0, 0.0]]
    )
    large, small = (np.full(5, radius, np.float32) for radius in (0.03, 0.003))
    kept = shrink_radii(centers, large, views, 0.004, 0.005)
    assert kept[[0, 3, 4]].tolist() == np.float32([0.005, 0.03, 0.03]).tolist()
    assert 0.015 < kept[1] < 0.02 and 0.01 < kept[2] < 0.028  # at its side, where the next pixel is 1 cm away
    assert (shrink_radii(centers, small, views, 0.004, 0.005) == small).all()


def test_a_centre_in_the_air_goes_back_onto_what_every_camera_sees_behind_it() -> None:
    """Above the floor, beneath it, far out in the air, and where no camera looks."""
    centers = np.float32([[0.2, 0.1, 0.012], [0.2, 0.1, -0.012], [0.2, 0.1, 0.05], [9.0, 0.0, 0.012]])
    put = move_to_surface(centers, [view(0, x=x) for x in (-0.1, 0.15)], 0.02)
    np.testing.assert_array_equal(put[1:], centers[1:])
    assert abs(put[0, 2]) < 1e-4 and np.abs(put[0, :2] - centers[0, :2]).max() < 0.012


POST = np.float32([[0.2, 0.1, 0.012]])


def test_a_centre_that_one_camera_sees_on_a_surface_stays() -> None:
    """A post's side is before the floor for the camera above it, and on the post for the one beside it."""
    above, beside = view(0), view(0, x=0.1)
    for hidden, height in ((0.0, 0.012), (0.03, 0.0)):  # hidden: it does not see the place
        beside.frame.depth[:] = pixels_at(beside.frame, POST)[1] - hidden
        assert abs(move_to_surface(POST, [above, beside], 0.02)[0, 2] - height) < 1e-4


def test_a_centre_beside_a_step_of_depth_stays_with_the_nearer_surface() -> None:
    seen = view(0)
    pixel, z = pixels_at(seen.frame, POST)
    seen.frame.depth.reshape(-1)[pixel + 1] = z
    np.testing.assert_array_equal(move_to_surface(POST, [seen], 0.02), POST)


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    """Nor the camera's own place: the point mirrored at it has one."""
    seen = view(0).frame
    place = seen.T_world_camera[:3, 3]
    pixel, z = pixels_at(seen, np.array([POST[0], place, 2.0 * place - POST[0]]))
    assert (pixel >= 0).tolist() == [True, False, False] and z[2] == -z[0]
