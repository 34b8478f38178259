"""Recorded poses that are off, put right by what the views see, and those that are right; views that are brighter
than others, brought to one exposure; the bend of a camera's depth: told by views that see the same, and not told
where it cannot be.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.calibration.evidence import FIXED, transform_of
from splatctrl_cli.calibration.gray_views import exposed, exposure_gains, gray_view, rows_of, scaled
from splatctrl_cli.calibration.pose_refinement import (
    BentViews,
    FoundBends,
    bends_alone,
    depth_bends,
    freed,
    largest_share,
    refined_poses,
    stretch,
    unbent,
)
from splatctrl_cli.config import fixed
from splatctrl_cli.formats.scene.scene_folder import ViewCorrection
from splatctrl_cli.geometry import invert_transform, transform_from
from splatctrl_cli.jobs.reconstruct.correct_views import Corrections, corrected_among
from splatctrl_cli.jobs.running.progress import SILENT
from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame
from tests.calibration.scan import a_bend, bent, disturbed, gains_of, shrink_refinement, views_of
from tests.jobs.score.wall import FakeSource
from tests.plain import plain_frame
from tests.reference.depth_bend import unbent_depth


@pytest.fixture(scope="module")
def views(sample_data: Path) -> list[RgbdFrame]:
    return views_of(sample_data)


def errors(poses: Sequence[Float64], truth: Sequence[RgbdFrame]) -> tuple[float, float]:
    """The largest error [mm] and [deg] of a pose as the first view sees it."""
    moves, turns = [0.0], [0.0]
    for T, view in zip(poses, truth, strict=True):
        true = invert_transform(truth[0].T_world_camera) @ view.T_world_camera
        off = invert_transform(true) @ invert_transform(poses[0]) @ T
        moves.append(1e3 * float(np.linalg.norm(off[:3, 3])))
        turns.append(float(np.degrees(np.linalg.norm(cv2.Rodrigues(off[:3, :3])[0]))))
    return max(moves), max(turns)


@pytest.mark.parametrize(("millimetres", "degrees"), [(10.0, 0.5), (30.0, 1.5)])
def test_poses_that_are_off_are_put_right(views: list[RgbdFrame], millimetres: float, degrees: float) -> None:
    off = disturbed(views, millimetres, degrees)
    before = errors([view.T_world_camera for view in off], views)
    found = refined_poses(off)
    assert found.is_better and not found.is_held.any()
    after = errors(found.T_world_camera, views)
    assert after[0] < 0.05 * before[0] and after[1] < 0.05 * before[1]
    assert found.after < 0.1 * found.before
    assert 0.3 * millimetres < 1e3 * np.median(found.moved) < 2 * millimetres
    moves = [T[:3, 3] - view.T_world_camera[:3, 3] for T, view in zip(found.T_world_camera, off, strict=True)]
    assert np.linalg.norm(np.mean(moves, axis=0)) < 0.25e-3 * millimetres, "as a whole they stay where they were"


def test_poses_that_are_right_stay_to_the_last_bit(views: list[RgbdFrame]) -> None:
    found = refined_poses(views)
    assert not found.is_better
    assert all(np.array_equal(T, view.T_world_camera) for T, view in zip(found.T_world_camera, views, strict=True))


def blotched(views: Sequence[RgbdFrame], share: float, num: int = 8) -> list[RgbdFrame]:
    """Depths that err by `share` at 1 m, growing with their square, alike over the width of an image by `num`."""
    rng, found = np.random.default_rng(0), []
    for view in views:
        height, width = view.depth.shape
        error = cv2.resize(rng.normal(size=(3 * num // 4, num)), (width, height), interpolation=cv2.INTER_CUBIC)
        found.append(replace(view, depth=(view.depth / (1 + share * view.depth * error)).astype(np.float32)))
    return found


@pytest.mark.parametrize(("is_gray", "num"), [(False, 4), (False, 8), (True, 8)])
def test_right_poses_stay_where_depth_errs_alike_in_neighbouring_pixels(
    views: list[RgbdFrame], is_gray: bool, num: int
) -> None:
    """Poses that are wrong by a centimetre bring such surfaces nearer to each other."""
    off = blotched(views, 0.01, num)
    if is_gray:
        off = [replace(view, color=np.full_like(view.color, 128)) for view in off]
    found = refined_poses(off)
    assert not found.is_better and found.after == found.before
    assert all(np.array_equal(T, view.T_world_camera) for T, view in zip(found.T_world_camera, off, strict=True))


@pytest.mark.parametrize(("share", "num", "millimetres"), [(0.005, 8, 10.0), (0.01, 32, 3.0)])
def test_poses_that_are_off_are_put_right_where_depth_errs_too(
    views: list[RgbdFrame], share: float, num: int, millimetres: float
) -> None:
    off = disturbed(blotched(views, share, num), millimetres, 0.05 * millimetres)
    before, found = errors([view.T_world_camera for view in off], views), refined_poses(off)
    assert errors(found.T_world_camera, views)[0] < 0.5 * before[0]


def test_one_view_among_many_that_is_off_is_put_right(views: list[RgbdFrame]) -> None:
    """It hardly changes the median distance."""
    off = [disturbed(views, 30.0, 1.5)[k] if k == 3 else view for k, view in enumerate(views)]
    assert errors(refined_poses(off).T_world_camera, views)[0] < 1.0


def test_a_scene_ten_times_as_large_is_put_right_alike(views: list[RgbdFrame]) -> None:
    def large(view: RgbdFrame) -> RgbdFrame:
        T = scaled(view.T_world_camera, 10.0)
        return replace(view, T_world_camera=T, depth=view.depth * np.float32(10))

    off = disturbed(views[:5], 20.0, 1.0)
    small, tenfold = refined_poses(off), refined_poses([large(view) for view in off], 10.0)
    for a, b in zip(small.T_world_camera, tenfold.T_world_camera, strict=True):
        assert 10 * a[:3, 3] == pytest.approx(b[:3, 3], abs=1e-3)


def test_a_view_of_something_else_is_held_and_the_others_are_put_right(views: list[RgbdFrame]) -> None:
    off = disturbed(views, 20.0, 1.0)
    away = off[2].T_world_camera.copy()
    away[:3, 3] += [30.0, 0.0, 0.0]
    off[2] = replace(off[2], T_world_camera=away)
    found = refined_poses(off)
    assert found.is_held.tolist() == [number == 2 for number in range(len(views))]
    assert np.array_equal(found.T_world_camera[2], away)
    rest = [number for number in range(len(views)) if number != 2]
    assert errors([found.T_world_camera[k] for k in rest], [views[k] for k in rest])[0] < 1.0


def test_along_a_bare_wall_nothing_moves_far() -> None:
    """Depth and colour that are the same everywhere say nothing of a move along the wall."""
    lens = Intrinsics(fx=120.0, fy=120.0, cx=79.5, cy=59.5, width=160, height=120)
    poses = [transform_from([x, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]) for x in (0.0, 0.1, 0.2)]
    walls = [plain_frame(np.full((120, 160), 1.0 + 0.01 * k, np.float32), lens, T) for k, T in enumerate(poses)]
    found = refined_poses(walls)
    assert found.is_better  # the wall was seen at three distances
    for k, T in enumerate(found.T_world_camera):
        assert T[:2, 3] == pytest.approx([0.1 * k, 0.0], abs=1e-3)
    assert found.after < 0.1 * found.before


def test_one_view_is_put_among_others_that_stay(views: list[RgbdFrame]) -> None:
    off = disturbed(views[:1], 20.0, 1.0)[0]
    there = corrected_among(off, views[1:], {("other", 0): ViewCorrection(T_world_camera=np.eye(4), gain=None)})
    T = invert_transform(views[0].T_world_camera) @ there.T_world_camera
    assert 1e3 * np.linalg.norm(T[:3, 3]) < 1.0


def test_what_is_stored_is_where_each_view_is(views: list[RgbdFrame]) -> None:
    off = disturbed(views, 20.0, 1.0)
    moved, told = Corrections(poses=True).of(off, FakeSource(frames=off, has_clock=False), SILENT)
    for frame, row in zip(moved, told["corrected_views"], strict=True):
        assert np.array_equal(np.reshape(row["T_world_camera"], (4, 4)), frame.T_world_camera)
    assert told["pose_residual"] < 0.1 * told["poses"]["residual_before"]
    assert told["poses"]["held"] == []


def test_gains_are_found_to_a_percent_and_none_where_none_is_needed(views: list[RgbdFrame]) -> None:
    gains = gains_of(len(views))
    off = [exposed(view, 1 / gain) for view, gain in zip(views, gains, strict=True)]
    assert np.abs(np.log(exposure_gains(off) / gains)).max() < 0.01
    assert np.abs(np.log(exposure_gains(views))).max() < 0.005
    assert exposure_gains(views[:1]) == pytest.approx(1.0), "it shares nothing"


def test_one_view_is_brought_to_the_others_that_stay(views: list[RgbdFrame]) -> None:
    gain = np.array([1.2, 1.0, 0.9])
    found = exposure_gains([exposed(views[0], 1 / gain), *views[1:]], 1.0, np.arange(len(views)) == 0)
    assert found[0] == pytest.approx(gain, rel=0.01)
    assert found[1:] == pytest.approx(1.0)


def test_what_is_white_or_black_says_nothing(views: list[RgbdFrame]) -> None:
    """A white wall stays 255 at any exposure; it must not pull a gain to 1."""
    gains = np.ones((len(views), 3))
    gains[0] = 1.25
    white = []
    for view, gain in zip(views, gains, strict=True):
        brighter = exposed(view, 1 / gain)
        brighter.color[view.color.min(axis=-1) > 120] = 255
        white.append(brighter)
    found = exposure_gains(white)
    assert np.median(found[0] / found[1:].mean(axis=0)) == pytest.approx(1.25, rel=0.02)


Change = Callable[[Sequence[RgbdFrame]], list[RgbdFrame]]


def noisy(views: Sequence[RgbdFrame]) -> list[RgbdFrame]:
    """The views with the noise of a structured-light camera: patches off in disparity, and steps of it."""
    rng, found = np.random.default_rng(1), []
    for view in views:
        patches = rng.normal(0, 0.0015, np.array(view.depth.shape) // 4 + 1)
        noise = np.kron(patches, np.ones((4, 4)))[: view.depth.shape[0], : view.depth.shape[1]]
        steps = np.round((1 / view.depth.astype(np.float64) + noise) / 0.0029)
        found.append(replace(view, depth=(1 / (0.0029 * steps)).astype(np.float32)))
    return found


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_refinement(monkeypatch)


def bends_of(views: Sequence[RgbdFrame]) -> FoundBends:
    """Bends found after poses are refined."""
    return depth_bends(views, refined_poses(views))


def error(found: Float64, true: Float64) -> float:
    """Root mean square, in proportion to that of the true bend."""
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def test_depth_is_freed_as_the_reference_has_it(views: list[RgbdFrame]) -> None:
    rng = np.random.default_rng(2)
    grid = rng.normal(0, 0.05, fixed.BEND_GRID)  # some of it beyond what is corrected
    depth = rng.uniform(0.3, 4.0, (37, 50)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0.0
    lens = replace(views[0].intrinsics, width=50, height=37)
    frame = replace(views[0], depth=depth, color=np.zeros((37, 50, 3), np.uint8), intrinsics=lens)
    expected = unbent_depth(depth.astype(np.float64), grid, fixed.BEND_MOST)
    assert unbent(frame, grid).depth == pytest.approx(expected, rel=2e-7)
    assert np.abs(expected - depth).max() > 0.1
    assert largest_share(grid, 100.0) == pytest.approx(1 / (1 - fixed.BEND_MOST) - 1)


def test_a_stretch_changes_with_the_offset_as_the_derivative_says() -> None:
    depth, offset = np.array([0.4, 1.0, 3.0, 3.0]), np.array([0.02, -0.03, 0.01, 0.05])
    high, low = stretch(depth, offset + 1e-7)[0], stretch(depth, offset - 1e-7)[0]
    assert stretch(depth, offset)[1] == pytest.approx(np.log(high / low) / 2e-7, rel=1e-6)
    assert stretch(depth, offset)[1][-1] == 0.0


def test_residuals_change_with_the_offsets_as_the_derivative_says(views: list[RgbdFrame]) -> None:
    """On surfaces that coincide. A round keeps normals and sigmas fixed, so the derivative leaves them out."""
    pair = [gray_view(view, 1.0) for view in views[:2]]
    T = invert_transform(views[1].T_world_camera) @ views[0].T_world_camera
    bends = BentViews(recorded=pair, cameras=[0, 1])
    smooth = bends_alone().T @ a_bend(1e-6).ravel()
    step = np.concatenate([smooth, -2 * smooth])

    def distances() -> tuple[Float64, Float64]:
        rows = rows_of(bends.now[0], bends.now[1], T, 1e9)  # so wide that all weights are the same
        basis = np.kron(np.eye(2), bends_alone())
        return rows.residuals, bends.derive_by_offsets(0, 1, rows) @ basis @ step

    first, by_offsets = distances()
    bends.move(step)
    second, _ = distances()
    assert len(first) == len(second)
    near = np.abs(first) < 0.5
    change, by_offsets = (second - first)[near], by_offsets[near]
    assert np.corrcoef(change, by_offsets)[0, 1] > 0.999
    assert np.linalg.norm(change - by_offsets) < 0.05 * np.linalg.norm(change)


@pytest.mark.usefixtures("small")
def test_a_bend_is_found_with_the_poses(views: list[RgbdFrame]) -> None:
    off = bent(disturbed(views, 10.0, 0.5), a_bend(0.03))
    without = refined_poses(off)
    found = depth_bends(off, without)
    assert min(found.gains) > 0.9
    assert error(found.grids["camera"], a_bend(0.03)) < 0.1
    assert refined_poses(freed(off, found.grids)).after < 0.1 * without.after


@pytest.mark.usefixtures("small")
def test_a_bend_under_noise_is_found_and_noise_alone_is_none(views: list[RgbdFrame]) -> None:
    found = bends_of(noisy(bent(views, a_bend(0.02))))
    assert error(found.grids["camera"], a_bend(0.02)) < 0.15
    noise = bends_of(noisy(disturbed(views, 10.0, 0.5)))
    assert not noise.grids
    assert noise.unlike == ("camera",)


@pytest.mark.usefixtures("small")
def test_a_wrong_focal_length_is_no_bend(views: list[RgbdFrame]) -> None:
    """The halves tell the same, and it holds for one of them alone."""
    wrong = [replace(v, intrinsics=replace(v.intrinsics, fx=1.04 * v.intrinsics.fx, fy=1.04 * v.intrinsics.fy))
             for v in views]  # fmt: skip
    found = bends_of(wrong)
    assert not found.grids
    assert not found.unlike
    assert min(found.gains) < 0 < max(found.gains)


def drifting(views: Sequence[RgbdFrame]) -> list[RgbdFrame]:
    """An arc of the poses, which looks like a bowl of the depth to who holds the poses."""
    arc = [transform_of(np.array([0, 0.004 * k, 0, 0.003 * k, 0, 0.002 * k * k])) for k in range(len(views))]
    return [replace(v, T_world_camera=v.T_world_camera @ T) for v, T in zip(views, arc, strict=True)]


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("add", [list, noisy])
@pytest.mark.parametrize(
    "change",
    [
        drifting,
        lambda views: [*bent(views[3:4], a_bend(0.03)), *views[:3], *views[4:]],  # a curved wall that is seen once
        lambda views: bent(views[: fixed.BEND_VIEWS - 1], a_bend(0.03)),
    ],
    ids=["drifting", "a curved wall", "few"],
)
def test_what_a_bend_does_not_explain_is_no_bend_of_the_camera(
    views: list[RgbdFrame], change: Change, add: Change
) -> None:
    assert not bends_of(add(change(views))).grids


@pytest.mark.usefixtures("small")
def test_each_camera_has_its_own_bend_and_an_exact_one_none(
    views: list[RgbdFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fixed, "BEND_VIEWS", 4)
    of_a, of_b = bent(views[::2], a_bend(-0.02)), bent(views[1::2], a_bend(0.03))
    both = [replace(v, camera="ab"[k]) for pair in zip(of_a, of_b, strict=True) for k, v in enumerate(pair)]
    found = bends_of(both)
    assert error(found.grids["a"], a_bend(-0.02)) < 0.15
    assert error(found.grids["b"], a_bend(0.03)) < 0.15
    monkeypatch.setattr(fixed, "REFINE_ROWS", 150)  # in smaller images the exact camera is not exact
    one = bends_of([replace(views[k], camera="a") if view.camera == "a" else view for k, view in enumerate(both)])
    assert error(one.grids["b"], a_bend(0.03)) < 0.15
    assert one.unlike == ("a",)


def test_a_bend_has_no_part_in_what_poses_take_up(views: list[RgbdFrame]) -> None:
    bends = BentViews(recorded=[gray_view(view, 1.0) for view in views[:2]], cameras=[0, FIXED])
    bends.move(np.ones(bends_alone().shape[1]))
    v, u = np.indices(fixed.BEND_GRID)
    for part in (np.ones_like(u), u, v):
        assert float((bends.grids[0] * part).sum()) == pytest.approx(0.0, abs=1e-9)
    assert bends.now[1] is bends.recorded[1]
