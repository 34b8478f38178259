"""The fused image loss against eq. 4 in float64."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from splatctrl_cli.kernels.raster import Float32, ImageLoss, LossTerms, LossWeights, TargetView
from tests.kernels.scenes import target
from tests.reference import loss as reference

WEIGHTS = LossWeights(dssim=0.2, color=1.0, depth=0.7, opacity=0.1, normalised=False)


def images(height: int = 29, width: int = 43) -> tuple[Float32, TargetView]:
    planes = np.random.default_rng(9).uniform(0.05, 1.0, (5, height, width)).astype(np.float32)
    return planes, target(width, height)


def evaluated(planes: Float32, view: TargetView, weights: LossWeights, threads: int = 1) -> tuple[LossTerms, Float32]:
    gradient = np.full_like(planes, np.nan)
    return ImageLoss(threads).evaluate(planes, view, weights, gradient), gradient


BACKGROUND = (0.9, 0.2, 0.5)


def expected(planes: Float32, view: TargetView, weights: LossWeights) -> tuple[float, Float32]:
    """Value and gradient of the reference."""
    leaf = torch.tensor(planes.astype(np.float64), requires_grad=True)
    value = reference.loss(
        leaf,
        torch.tensor(view.color.astype(np.float64) / 255.0),
        torch.tensor(view.depth.astype(np.float64)),
        torch.tensor(view.counted > 0),
        dssim=weights.dssim,
        color_weight=weights.color,
        depth_weight=weights.depth,
        opacity_weight=weights.opacity,
        normalised=weights.normalised,
        background=weights.background,
    )
    value.backward()  # type: ignore[no-untyped-call]
    return value.item(), leaf.grad.numpy()


VARIANTS = [{"normalised": n, "background": b} for n in (False, True) for b in ((0.0, 0.0, 0.0), BACKGROUND)]
SIZES = [(3, 70), (60, 8), (61, 7), (97, 21), (121, 33)]


@pytest.mark.parametrize(
    ("size", "changes"), [*(((29, 43), changes) for changes in VARIANTS), *((size, {}) for size in SIZES)]
)
def test_value_and_gradient_equal_the_reference(size: tuple[int, int], changes: dict[str, Any]) -> None:
    (planes, view), weights = images(*size), replace(WEIGHTS, **changes)
    terms, gradient = evaluated(planes, view, weights)
    value = 0.8 * terms.l1 + 0.2 * terms.dssim + 0.7 * terms.depth + 0.1 * terms.transmittance
    want_value, want = expected(planes, view, weights)
    assert value == pytest.approx(want_value, rel=1e-5)
    assert np.abs(gradient - want).max() < 1e-5 * np.abs(want).max()


def test_one_object_compares_images_of_different_sizes() -> None:
    loss = ImageLoss(2)
    for height, width in ((60, 50), (29, 43), (90, 10)):
        planes, view = images(height, width)
        gradient = np.full_like(planes, np.nan)
        assert loss.evaluate(planes, view, WEIGHTS, gradient) == evaluated(planes, view, WEIGHTS)[0]
        assert np.array_equal(gradient, evaluated(planes, view, WEIGHTS)[1])


def test_identical_images_have_no_colour_loss() -> None:
    planes, view = images()
    planes[:3] = view.color / np.float32(255.0)
    terms, gradient = evaluated(planes, view, WEIGHTS)
    assert (terms.l1, terms.squared, terms.dssim) == (0.0, 0.0, pytest.approx(0.0, abs=1e-6))
    assert np.abs(gradient[:3]).max() < 1e-6


def test_pixels_that_do_not_count_change_neither_value_nor_gradient() -> None:
    planes, view = images()
    other = planes.copy()
    other[:3, view.counted == 0] += 0.3
    a, b = evaluated(planes, view, WEIGHTS), evaluated(other, view, WEIGHTS)
    assert a[0] == b[0] and np.array_equal(a[1], b[1]) and not a[1][:3, view.counted == 0].any()


def test_the_background_is_seen_through_what_is_transparent() -> None:
    planes, view = images()
    composed = planes.copy()
    composed[:3] += (1 - planes[4]) * np.float32(BACKGROUND)[:, None, None]
    terms, gradient = evaluated(planes, view, replace(WEIGHTS, background=BACKGROUND))
    painted_terms, painted = evaluated(composed, view, WEIGHTS)
    assert (terms.l1, terms.dssim, terms.squared) == pytest.approx(
        (painted_terms.l1, painted_terms.dssim, painted_terms.squared), rel=1e-6
    )
    assert np.abs(gradient[:4] - painted[:4]).max() < 1e-5 * np.abs(painted[:4]).max()
    share = np.tensordot(np.float32(BACKGROUND), painted[:3], axes=1)
    assert np.abs(gradient[4] - (painted[4] - share)).max() < 1e-5 * np.abs(share).max()
    assert np.abs(share[(view.depth == 0) & (view.counted > 0)]).min() > 0


def test_the_gradient_is_the_slope_of_the_value() -> None:
    """Central differences up the slope of each plane; smooth but for the few pixels whose error changes sign."""
    planes, view = images()
    planes[4] = 0.3 + 0.7 * planes[4]  # a normalised depth jumps where the opacity passes 0.1
    weights = replace(WEIGHTS, background=BACKGROUND, normalised=True)
    gradient = evaluated(planes, view, weights)[1]
    for plane in range(5):
        step = np.zeros_like(planes)
        step[plane] = np.float32(1e-3) * np.sign(gradient[plane])
        terms = [evaluated(planes + sign * step, view, weights)[0] for sign in (1, -1)]
        high, low = (0.8 * t.l1 + 0.2 * t.dssim + 0.7 * t.depth + 0.1 * t.transmittance for t in terms)
        assert high - low == pytest.approx(2 * float((gradient * step).sum(dtype=np.float64)), rel=1e-2)


def test_a_frame_without_depth_has_no_depth_loss() -> None:
    planes, view = images()
    view = TargetView(color=view.color, depth=np.zeros_like(view.depth), counted=view.counted)
    terms, gradient = evaluated(planes, view, WEIGHTS)
    assert terms.depth == 0.0
    assert not gradient[3:].any()


def test_thread_count_does_not_change_a_bit() -> None:
    planes, view = images(120, 161)
    one, two = evaluated(planes, view, WEIGHTS, 1), evaluated(planes, view, WEIGHTS, 2)
    assert (one[0], one[1].tobytes()) == (two[0], two[1].tobytes())
