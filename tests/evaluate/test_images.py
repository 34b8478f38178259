"""PSNR, SSIM and depth errors against known answers."""

import math

import numpy as np
import pytest

from splatctrl_cli.evaluate.images import depth_errors, psnr, published_ssim, ssim_map
from splatctrl_cli.records import Float64
from tests.reference.images import ssim_at


def noise(seed: int, shape: tuple[int, ...] = (24, 31, 3)) -> Float64:
    return np.random.default_rng(seed).random(shape)


def test_psnr_of_a_constant_offset_of_a_tenth_is_20_db() -> None:
    image = np.full((8, 9, 3), 0.5)
    assert psnr(image + 0.1, image) == pytest.approx(20.0, abs=1e-9)


def test_psnr_of_identical_images_is_infinite() -> None:
    assert psnr(noise(0), noise(0)) == math.inf


def test_psnr_averages_only_masked_pixels() -> None:
    image = np.full((10, 10, 3), 0.5)
    other = image.copy()
    mask = np.zeros((10, 10), dtype=bool)
    mask[:, :1] = True
    other[mask] += 0.1
    other[~mask] = 0.0
    assert psnr(other, image, mask) == pytest.approx(20.0, abs=1e-9)
    zero_filled = psnr(other * mask[..., None], image * mask[..., None])
    assert zero_filled == pytest.approx(30.0, abs=1e-9), "the mean over a zero-filled image would read 10 dB more"


def test_psnr_of_an_empty_mask_is_not_a_number() -> None:
    assert math.isnan(psnr(noise(0), noise(1), np.zeros((24, 31), dtype=bool)))


def test_ssim_map_equals_the_reference_window_by_window_and_at_the_border() -> None:
    x, y = noise(3), np.clip(noise(3) + 0.2 * noise(4), 0, 1)
    similarity = ssim_map(x, y)
    for row, column in [(0, 0), (0, 15), (12, 15), (23, 30), (5, 5), (22, 1)]:
        for channel in range(3):
            expected = ssim_at(x[..., channel], y[..., channel], row, column)
            assert similarity[row, column, channel] == pytest.approx(expected, abs=1e-12)


def test_depth_errors_count_only_pixels_where_both_have_depth() -> None:
    reference = np.array([[1.0, 1.0, 1.0, 0.0, 1.0]], dtype=np.float32)
    depth = np.array([[1.005, 1.015, 1.1, 1.0, 0.0]], dtype=np.float32)
    errors = depth_errors(depth, reference)
    assert errors.num_pixels == 3
    assert errors.median == pytest.approx(0.015, abs=1e-6)
    assert errors.mean == pytest.approx(0.04, abs=1e-6)
    assert errors.p90 == pytest.approx(0.015 + 0.8 * 0.085, abs=1e-6)
    assert errors.within_1cm == pytest.approx(1 / 3)
    assert errors.within_2cm == pytest.approx(2 / 3)


def test_depth_errors_without_a_common_pixel_are_not_numbers() -> None:
    errors = depth_errors(np.zeros((3, 3), np.float32), np.ones((3, 3), np.float32))
    assert errors.num_pixels == 0
    assert math.isnan(errors.median)
    assert math.isnan(errors.within_1cm)


def test_zeros_beyond_the_border_make_it_look_alike() -> None:
    rng = np.random.default_rng(5)
    image, reference = rng.random((24, 30, 3)), rng.random((24, 30, 3))
    padded = [np.pad(x, ((5, 5), (5, 5), (0, 0))) for x in (image, reference)]
    expected = ssim_map(*padded)[5:-5, 5:-5]
    found = ssim_map(image, reference, is_zero_padded=True)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(found[5:-5, 5:-5], ssim_map(image, reference)[5:-5, 5:-5], atol=1e-12)
    assert found[0].mean() > ssim_map(image, reference)[0].mean() + 0.05


def test_published_ssim_is_the_box_window_of_scikit_image_on_filled_images() -> None:
    rng = np.random.default_rng(5)
    image, reference = rng.random((14, 17, 3)), rng.random((14, 17, 3))
    mask = rng.random((14, 17)) < 0.7
    x, y = (np.where(mask[:, :, None], picture, 1.0) for picture in (image, reference))
    values = []
    for row in range(3, 11):
        for column in range(3, 14):
            for channel in range(3):
                a = x[row - 3 : row + 4, column - 3 : column + 4, channel].ravel()
                b = y[row - 3 : row + 4, column - 3 : column + 4, channel].ravel()
                covariance = np.cov(a, b)
                c1, c2 = 0.02**2, 0.06**2
                values.append(
                    (2 * a.mean() * b.mean() + c1)
                    * (2 * covariance[0, 1] + c2)
                    / ((a.mean() ** 2 + b.mean() ** 2 + c1) * (covariance[0, 0] + covariance[1, 1] + c2))
                )
    assert published_ssim(image, reference, mask, 1.0) == pytest.approx(np.mean(values), abs=1e-12)
    assert np.isnan(published_ssim(image, reference, mask & False, 1.0)), "not the 1 of two white images"
    assert math.isnan(published_ssim(image[:5], reference[:5], mask[:5], 1.0))
