"""Which views the optimiser looks at."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.scene.keyframes import View, Window, kept_radii, make_view, on_surface
from splatctrl_cli.scene.self_mask import pixels_at
from tests.scene.wall import frame

CONFIG = SceneConfig(window=3)


def view(stamp_ns: int, x: float = 0.0, camera: str = "cam0") -> View:
    seen = frame(stamp_ns, x=x, camera=camera)
    return make_view(seen, seen.depth > 0)


def stamps(views: list[View]) -> list[int]:
    return [v.frame.stamp_ns for v in views]


def test_a_camera_that_stands_still_makes_no_keyframes() -> None:
    window = Window(CONFIG)
    for k in range(6):
        window.advance([view(k), view(k, x=0.3, camera="cam1")])
    assert window.keyframes == []
    assert stamps(window.newest) == [5, 5]


def test_a_camera_that_moves_leaves_keyframes_oldest_dropped_first() -> None:
    window = Window(CONFIG)
    for k in range(7):
        window.advance([view(k, x=0.1 * k)])
    assert stamps(window.keyframes) == [3, 4, 5]
    assert stamps(window.newest) == [6]


def test_a_silent_camera_keeps_its_newest_view() -> None:
    window = Window(CONFIG)
    window.advance([view(0), view(0, x=0.3, camera="cam1")])
    window.advance([view(1)])
    assert sorted(stamps(window.newest)) == [0, 1]


def test_every_round_shows_all_newest_views_and_as_many_keyframes() -> None:
    window = Window(CONFIG)
    for k in range(7):
        window.advance([view(k, x=0.1 * k)])
    shown = stamps(window.schedule(10, np.random.default_rng(0)))
    assert len(shown) == 10
    assert all(6 in shown[i : i + 2] for i in range(0, 10, 2))
    assert len(set(shown)) > 2
    assert Window(CONFIG).schedule(5, np.random.default_rng(0)) == []


def test_pixels_without_depth_count_and_pixels_outside_the_workspace_do_not() -> None:
    seen = frame()
    seen.depth[:10] = 0.0
    mappable = seen.depth > 0
    mappable[50:] = False
    view = make_view(replace(seen), mappable)
    assert view.target.counted[:50].all()
    assert not view.target.counted[50:].any()
    assert np.array_equal(view.mappable, mappable)


def test_pixels_that_the_lens_did_not_see_count_neither_for_colour_nor_for_depth() -> None:
    seen = frame()
    valid = np.ones(seen.depth.shape, bool)
    valid[:, :7] = False
    made = make_view(replace(seen, valid=valid), seen.depth > 0)
    assert np.array_equal(made.target.counted > 0, valid)
    assert np.array_equal(made.mappable, valid & (seen.depth > 0))


def test_a_sphere_sticks_out_of_what_depth_shows_by_the_sensors_error_at_most() -> None:
    """On the floor, beneath it, at the rim of a block and within it, and where no camera looks."""
    view = make_view(frame(block=0.2), frame(block=0.2).depth > 0)
    centers = np.float32(
        [[0.25, 0.2, 0.0], [0.25, 0.2, -0.015], [0.09, 0.0, 0.15], [0.0, 0.0, 0.15], [9.0, 0.0, 0.0]]
    )
    kept = kept_radii(centers, np.full(5, 0.03, np.float32), [view], 0.004, 0.005)
    assert kept[0] == np.float32(0.005)
    assert 0.015 < kept[1] < 0.02
    assert 0.01 < kept[2] < 0.028  # at its side, where the next pixel is 1 cm away
    assert kept[3] == kept[4] == np.float32(0.03)
    assert (kept_radii(centers, np.full(5, 0.003, np.float32), [view], 0.004, 0.005) == np.float32(0.003)).all()


def test_a_centre_in_the_air_goes_back_onto_what_every_camera_sees_behind_it() -> None:
    """Above the floor, beneath it, far out in the air, and where no camera looks."""
    views = [view(0, x=x) for x in (-0.1, 0.15)]
    centers = np.float32([[0.2, 0.1, 0.012], [0.2, 0.1, -0.012], [0.2, 0.1, 0.05], [9.0, 0.0, 0.012]])
    put = on_surface(centers, views, 0.02)
    assert abs(put[0, 2]) < 1e-4
    np.testing.assert_array_equal(put[1:], centers[1:])
    np.testing.assert_allclose(put[0, :2], centers[0, :2], atol=0.012)


def test_a_centre_that_one_camera_sees_on_a_surface_stays() -> None:
    """A post's side is before the floor for the camera above it, and on the post for the one beside it."""
    above, beside = view(0), view(0, x=0.1)
    center = np.float32([[0.2, 0.1, 0.012]])
    beside.frame.depth[:] = pixels_at(beside.frame, center)[1]
    np.testing.assert_array_equal(on_surface(center, [above, beside], 0.02), center)
    beside.frame.depth[:] = pixels_at(beside.frame, center)[1] - 0.03  # hidden: it does not see the place
    assert abs(on_surface(center, [above, beside], 0.02)[0, 2]) < 1e-4


def test_a_centre_beside_a_step_of_depth_stays_with_the_nearer_surface() -> None:
    seen = view(0)
    center = np.float32([[0.2, 0.1, 0.012]])
    pixel, z = pixels_at(seen.frame, center)
    seen.frame.depth.reshape(-1)[pixel + 1] = z
    np.testing.assert_array_equal(on_surface(center, [seen], 0.02), center)
