"""View scores with known answers, how they are averaged, and what speaks against them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.score import (
    CORRECTABLE,
    CORRECTED,
    Doubts,
    as_json,
    counts_of,
    free_mass,
    metric_scales,
    score_view,
    share_in_front,
    total_score,
)
from splatctrl_cli.evaluate.views import View
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Bool, Float32, Float64, Intrinsics, Label, RgbdFrame
from tests.plain import plain_frame, plain_grid, plain_splats
from tests.refused import expect_refusal

H, W = 20, 30
NONE = np.zeros((H, W), dtype=bool)
LEFT = np.broadcast_to(np.arange(W) < W // 2, (H, W))
ONES = np.ones((H, W), np.float32)


def photo() -> RgbdFrame:
    color = np.random.default_rng(0).integers(51, 153, (H, W, 3))
    return plain_frame(
        np.broadcast_to((np.arange(H) >= 5)[:, None], (H, W)),
        Intrinsics(fx=30.0, fy=30.0, cx=14.5, cy=9.5, width=W, height=H),
        stamp_ns=7,
        camera="cam3",
        color=color,
    )


def perfect(offset: float = 0.0) -> Float32:
    return (photo().color / 255.0 + offset).astype(np.float32)


def score(
    color: Float32, depth: Float32 = ONES, seen: Bool = NONE, frame: RgbdFrame | None = None
) -> dict[str, float]:
    return score_view(color=color, depth=depth, frame=frame or photo(), seen=seen)


def masked_score() -> dict[str, float]:
    """Right under the mask (the left half), 0.1 off elsewhere."""
    return score_view(
        color=np.where(LEFT[..., None], perfect(0.01), perfect(0.1)),
        depth=ONES,
        frame=photo(),
        seen=NONE,
        mask=LEFT,
        fill=1.0,
    )


def test_a_mask_is_a_region_of_its_own() -> None:
    figures = masked_score()
    assert figures["psnr_masked"] == pytest.approx(40.0, abs=1e-3)
    assert (figures["mask_share"], figures["depth_pixels_masked"]) == (0.5, (H - 5) * W // 2)
    assert figures["ssim_published"] > 0.99 > figures["ssim_all"]
    assert "psnr_masked" not in score(perfect())


def test_what_the_lens_did_not_see_is_in_no_region() -> None:
    """Whatever the render shows there."""
    valid = np.broadcast_to(np.arange(W) >= 4, (H, W))
    frame, color = replace(photo(), valid=valid), perfect()
    frame.color[~valid], frame.depth[~valid], color[~valid] = 0, 0.0, 1.0
    result = score_view(color=color, depth=ONES, frame=frame, seen=LEFT, mask=LEFT)
    assert min(result["psnr_all"], result["psnr_seen"]) > 150.0
    assert (result["ssim_all"], result["ssim_published"]) == pytest.approx((1.0, 1.0))
    assert (result["mask_share"], result["seen_share"]) == pytest.approx(((W // 2 - 4) / W, (W // 2 - 4) / W))


def test_regions_are_scored_apart_and_none_is_zero_filled() -> None:
    color = np.where(LEFT[..., None], perfect(0.1), perfect(0.2))
    result = score(color, np.where(LEFT, np.float32(1.004), np.float32(1.03)), LEFT & (photo().depth > 0))
    assert result["psnr_seen"] == pytest.approx(20.0, abs=1e-3)
    assert result["psnr_all"] == pytest.approx(-10 * math.log10((0.01 + 0.04) / 2), abs=1e-3)
    assert (result["depth_median_seen"], result["depth_mean_all"]) == pytest.approx((0.004, 0.017), abs=1e-6)
    assert (result["depth_within_1cm_all"], result["valid_share"], result["seen_share"]) == (0.5, 0.75, 0.375)


def test_pixels_without_reference_depth_count_for_colour_but_not_for_depth() -> None:
    color, depth = perfect(), ONES.copy()
    color[:5] += 0.1
    depth[:5] = 9.0
    result = score(color, depth)
    assert result["psnr_all"] == pytest.approx(20.0 + 10 * math.log10(4), abs=1e-3)
    assert (result["depth_pixels_all"], result["depth_median_all"]) == (15 * W, 0.0)


def test_holes_in_the_render_lower_the_depth_coverage_and_nothing_else_of_depth() -> None:
    result = score(perfect(), ONES * (np.arange(W) >= 3), photo().depth > 0)
    assert (result["depth_coverage_seen"], result["depth_mean_seen"]) == (pytest.approx(0.9), 0.0)


def test_a_render_beyond_0_to_1_is_scored_as_a_screen_shows_it() -> None:
    result = score(
        np.full((H, W, 3), 1.5, np.float32), frame=replace(photo(), color=np.full((H, W, 3), 255, np.uint8))
    )
    assert (result["psnr_all"], result["ssim_all"]) == (math.inf, pytest.approx(1.0))


def test_an_empty_region_has_no_figures_and_is_left_out_of_the_mean() -> None:
    blind, sharp = score(perfect(0.1)), score(perfect(0.1), seen=~NONE)
    assert math.isnan(blind["psnr_seen"]) and math.isnan(blind["ssim_seen"])
    totals = total_score([blind, sharp])
    assert totals["psnr_seen"] == pytest.approx(20.0, abs=1e-3)
    assert (totals["seen_share"], totals["num_views"]) == (0.5, 2)


def test_totals_are_means_over_views() -> None:
    totals = total_score([score(perfect(off), ONES + np.float32(off / 10), ~NONE) for off in (0.1, 0.01)])
    assert totals["psnr_all"] == pytest.approx((20.0 + 40.0) / 2, abs=1e-2)
    assert totals["depth_median_all"] == pytest.approx((0.01 + 0.001) / 2, abs=1e-6)
    expect_refusal("no view was scored", total_score, [], error=NotEvaluableError)


def test_the_names_of_the_totals_are_known_beforehand() -> None:
    view = masked_score()
    assert set(metric_scales()) >= set(total_score([score(perfect())]))
    assert set(metric_scales()) == set(total_score([view])) | {
        f"{name}{CORRECTED}" for name in view if name in CORRECTABLE
    }
    assert as_json({"a": math.nan, "b": math.inf, "c": 1.5}) == {"a": None, "b": None, "c": 1.5}


def test_a_figure_of_views_rests_on_the_views_that_have_it() -> None:
    views = [{"psnr_seen": 20.0, "in_front_seen": None}, {"psnr_seen": 21.0, "in_front_seen": 0.0}]
    metrics = {"num_views": 2, "psnr_seen": 20.5, "in_front_seen": 0.0, "num_warnings": 0, "change_psnr_seen": 0.1}
    counts = counts_of({"metrics": metrics, "views": views})
    assert counts == {"num_views": 2, "psnr_seen": 2, "in_front_seen": 1, "num_warnings": 2, "change_psnr_seen": 2}
    both = {"metrics": metrics | {"num_views": 4}, "results": {"a": {"views": views}, "b": {"views": views}}}
    assert counts_of(both)["in_front_seen"] == 2


@pytest.mark.parametrize(
    ("x", "opacities", "radii", "labels", "threshold", "expected"),
    [
        pytest.param(
            [0.02, 0.18, 0.25, 7.0], [0.5, 0.5, 1.0, 1.0], [0.02, 0.01, 0.01, 0.01], 0, 0.3, 2.0 / 4.5, id="share"
        ),
        pytest.param([0.15, 0.25], 0.9, 0.01, 0, 0.3, 0.0, id="full or never seen"),
        pytest.param([0.05], 0.9, 0.01, 0, 0.3, 1.0, id="free"),
        pytest.param([0.05], 0.9, 0.01, 0, 0.1, 0.0, id="not below 1 / (1 + e^2) = 0.12"),
        pytest.param([0.05, 0.15], 0.9, 0.01, [Label.ROBOT, Label.HUMAN], 0.3, 0.0, id="the robot has no mass"),
        pytest.param([0.05], 0.9, 0.01, Label.ROBOT, 0.3, math.nan, id="no mass has no share"),
    ],
)
def test_mass_is_opacity_times_radius_squared_of_what_stands_in_free_voxels(
    x: list[float], opacities: ArrayLike, radii: ArrayLike, labels: ArrayLike, threshold: float, expected: float
) -> None:
    """Three voxels of 10 cm lie along x from 0 on: free, full, never seen."""
    odds, updates = np.reshape([-2.0, 2.0, 0.0], (3, 1, 1)), np.reshape([4, 4, 0], (3, 1, 1))
    grid = plain_grid((3, 1, 1), 0.1, 0.05, log_odds=odds, num_updates=updates)
    scene = plain_splats([[value, 0.05, 0.05] for value in x], radii, opacities=opacities, labels=labels)
    assert free_mass(scene, grid, threshold) == pytest.approx(expected, nan_ok=True)


def test_in_front_counts_pixels_that_have_both_depths() -> None:
    reference, depth = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 1.0]), np.array([0.9, 0.98, 1.2, 0.0, 0.5, 0.5])
    assert share_in_front(depth, reference, np.arange(6) < 5) == pytest.approx(1 / 3)
    assert math.isnan(share_in_front(depth, reference, np.zeros(6, bool)))


HIGH, WIDE = 24, 32


def frame(number: int) -> RgbdFrame:
    rng = np.random.default_rng(number)
    lens = Intrinsics(fx=30.0, fy=30.0, cx=15.5, cy=11.5, width=WIDE, height=HIGH)
    place = look_at([0.1 * number, -1.0, 0.4], [0.0, 0.0, 0.0])
    color = np.kron(rng.integers(0, 256, (3, 4, 3)), np.ones((8, 8, 1)))
    return plain_frame(1.0, lens, place, stamp_ns=number, camera="camera", color=color)


TRAINING = (frame(7), frame(8))


def view(number: int) -> View:
    return View(name=f"holdout-{number:04d}", frame=frame(number), training=TRAINING)


def render(number: int) -> Float64:
    return np.asarray(frame(number).color / 255.0 * 0.9)


def disc() -> Bool:
    v, u = np.mgrid[:HIGH, :WIDE]
    return np.asarray((u - 16) ** 2 + (v - 12) ** 2 < 60)


def lines_of(doubts: Doubts, numbers: tuple[int, ...], mask: Bool | None = None, shown: tuple[int, ...] = ()) -> str:
    """Doubts about views; `shown` names the renders that they are compared with."""
    for number, of in zip(numbers, shown or numbers, strict=True):
        doubts.look(view(number), render(of), mask)
    return "\n".join(doubts.lines())


def test_a_mask_inside_out_is_told_by_the_border_of_the_image() -> None:
    """Nothing speaks against views that are as they should be."""
    masked = Doubts(is_still=True, mask_rule="object mask")
    assert lines_of(masked, (0, 1, 2), disc()) == ""
    line = lines_of(masked, (0, 1), ~disc())
    assert line.startswith(
        "holdout-0000 has its mask on 100% of the image's border and 76% of the image (and 1 more)"
    )
    assert "is the mask turned inside out? it has to be 255 on the object" in line
    assert lines_of(Doubts(is_still=True, mask_rule="pixels with a reference depth"), (0, 1), ~disc()) == ""


def test_a_mask_without_a_pixel_is_refused_with_the_view() -> None:
    expect_refusal(
        r"holdout-0003: mask rule 'object mask': expected pixels .* got none of 768",
        lines_of,
        Doubts(is_still=True, mask_rule="object mask"),
        (3,),
        disc() & False,
    )


def test_a_view_that_stands_where_one_trained_is_named_unless_that_is_meant() -> None:
    assert lines_of(Doubts(is_still=True), (0, 8)).startswith(
        "holdout-0008 stands 0.0 mm and 0.00 degrees from a training view: a view that trained"
    )
    assert lines_of(Doubts(is_still=True, may_train=True), (0, 8)) == ""


def test_a_hair_beside_a_training_view_is_another_view() -> None:
    T, doubts = frame(8).T_world_camera.copy(), Doubts(is_still=True)
    T[0, 3] += 0.0011
    doubts.look(View(name="a", frame=replace(frame(8), T_world_camera=T), training=TRAINING), render(8), None)
    assert doubts.lines() == []


def test_photos_that_belong_to_other_cameras_are_found() -> None:
    """If objects move, a photo may resemble another time."""
    line = lines_of(Doubts(is_still=True), (0, 1, 2), shown=(1, 0, 2))
    assert line.startswith("holdout-0000's photo is nearer the render of holdout-0001 (")
    assert line.endswith("(and 1 more): do the cameras belong to these images, and in this order?")
    assert lines_of(Doubts(is_still=False), (0, 1), shown=(1, 0)) == ""
