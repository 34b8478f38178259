"""The bend of a camera's depth: told by views that see the same, and not told where it cannot be."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.calibration.evidence import FIXED, transform_of
from splatctrl_cli.calibration.gray_views import gray_view, rows_of
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
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Float64, RgbdFrame
from tests.calibration.scan import a_bend, bent, disturbed, shrink_refinement, views_of
from tests.reference.depth_bend import unbent_depth


@pytest.fixture(scope="module")
def views(sample_data: Path) -> list[RgbdFrame]:
    return views_of(sample_data)


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


def told(views: Sequence[RgbdFrame]) -> FoundBends:
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
    """Where surfaces lie on each other: normals and sigmas are held in a round, and change by little."""
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
    found = told(noisy(bent(views, a_bend(0.02))))
    assert error(found.grids["camera"], a_bend(0.02)) < 0.15
    noise = told(noisy(disturbed(views, 10.0, 0.5)))
    assert not noise.grids
    assert noise.unlike == ("camera",)


@pytest.mark.usefixtures("small")
def test_a_wrong_focal_length_is_no_bend(views: list[RgbdFrame]) -> None:
    """The halves tell the same, and it holds for one of them alone."""
    wrong = [replace(v, intrinsics=replace(v.intrinsics, fx=1.04 * v.intrinsics.fx, fy=1.04 * v.intrinsics.fy))
             for v in views]  # fmt: skip
    found = told(wrong)
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
    assert not told(add(change(views))).grids


@pytest.mark.usefixtures("small")
def test_each_camera_has_its_own_bend_and_an_exact_one_none(
    views: list[RgbdFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fixed, "BEND_VIEWS", 4)
    of_a, of_b = bent(views[::2], a_bend(-0.02)), bent(views[1::2], a_bend(0.03))
    both = [replace(v, camera="ab"[k]) for pair in zip(of_a, of_b, strict=True) for k, v in enumerate(pair)]
    found = told(both)
    assert error(found.grids["a"], a_bend(-0.02)) < 0.15
    assert error(found.grids["b"], a_bend(0.03)) < 0.15
    monkeypatch.setattr(fixed, "REFINE_ROWS", 150)  # in smaller images the exact camera is not exact
    one = told([replace(views[k], camera="a") if view.camera == "a" else view for k, view in enumerate(both)])
    assert error(one.grids["b"], a_bend(0.03)) < 0.15
    assert one.unlike == ("a",)


def test_a_bend_has_no_part_in_what_poses_take_up(views: list[RgbdFrame]) -> None:
    bends = BentViews(recorded=[gray_view(view, 1.0) for view in views[:2]], cameras=[0, FIXED])
    bends.move(np.ones(bends_alone().shape[1]))
    v, u = np.indices(fixed.BEND_GRID)
    for part in (np.ones_like(u), u, v):
        assert float((bends.grids[0] * part).sum()) == pytest.approx(0.0, abs=1e-9)
    assert bends.now[1] is bends.recorded[1]
