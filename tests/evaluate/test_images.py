"""PSNR, SSIM and depth errors against known answers; LPIPS against torch's own convolutions with random weights."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import conv2d, max_pool2d

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.images import Lpips, depth_errors, psnr, published_ssim, ssim, ssim_map
from splatctrl_cli.records import Float32, Float64
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


def test_ssim_averages_only_masked_pixels() -> None:
    x, y = noise(0), noise(1)
    y[:, :15] = x[:, :15]
    far_left = np.zeros((24, 31), dtype=bool)
    far_left[:, :10] = True
    assert ssim(x, y, far_left) == pytest.approx(1.0, abs=1e-12)
    assert ssim(x, y) < 0.9
    assert math.isnan(ssim(x, y, np.zeros((24, 31), dtype=bool)))


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


ALEX = {1: [(0, 3, 8, 11, 4, 2, 0)], 2: [(3, 8, 12, 5, 1, 2, 3)], 3: [(6, 12, 16, 3, 1, 1, 3)],
        4: [(8, 16, 10, 3, 1, 1, 0)], 5: [(10, 10, 10, 3, 1, 1, 0)]}  # fmt: skip
VGG = {1: [(0, 3, 4, 3, 1, 1, 0), (2, 4, 4, 3, 1, 1, 0)], 2: [(5, 4, 6, 3, 1, 1, 2), (7, 6, 6, 3, 1, 1, 0)],
       3: [(10, 6, 8, 3, 1, 1, 2), (12, 8, 8, 3, 1, 1, 0), (14, 8, 8, 3, 1, 1, 0)],
       4: [(17, 8, 8, 3, 1, 1, 2), (19, 8, 8, 3, 1, 1, 0), (21, 8, 8, 3, 1, 1, 0)],
       5: [(24, 8, 8, 3, 1, 1, 2), (26, 8, 8, 3, 1, 1, 0), (28, 8, 8, 3, 1, 1, 0)]}  # fmt: skip
Network = dict[int, list[tuple[int, int, int, int, int, int, int]]]


def weights(network: Network) -> dict[str, Float32]:
    rng = np.random.default_rng(0)
    arrays = {}
    for part, layers in network.items():
        for number, before, after, size, *_ in layers:
            arrays[f"net.slice{part}.{number}.weight"] = rng.normal(0, 0.2, (after, before, size, size))
            arrays[f"net.slice{part}.{number}.bias"] = rng.normal(0, 0.2, after)
        arrays[f"lin{part - 1}.model.1.weight"] = rng.random((1, layers[-1][2], 1, 1))
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def by_torch(network: Network, arrays: dict[str, Float32], a: Float64, b: Float64) -> float:
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    pair = [((2 * torch.from_numpy(x).float() - 1 - shift) / scale).permute(2, 0, 1)[None] for x in (a, b)]
    total = 0.0
    for part, layers in network.items():
        for number, _, _, _, stride, padding, pool in layers:
            weight, bias = (
                torch.from_numpy(arrays[f"net.slice{part}.{number}.{kind}"]) for kind in ("weight", "bias")
            )
            pair = [max_pool2d(x, pool, 2) if pool else x for x in pair]
            pair = [torch.relu(conv2d(x, weight, bias, stride, padding)) for x in pair]
        unit = [x / (torch.sqrt(torch.sum(x**2, dim=1, keepdim=True)) + 1e-10) for x in pair]
        linear = torch.from_numpy(arrays[f"lin{part - 1}.model.1.weight"])
        total += float(conv2d((unit[0] - unit[1]) ** 2, linear).mean())
    return total


def pictures() -> tuple[Float64, Float64]:
    rng = np.random.default_rng(1)
    return rng.random((70, 93, 3)), rng.random((70, 93, 3))


@pytest.mark.parametrize(("name", "network"), [("alex", ALEX), ("vgg", VGG)])
def test_it_is_what_torch_makes_of_the_same_weights(tmp_path: Path, name: str, network: Network) -> None:
    arrays = weights(network)
    np.savez(tmp_path / "weights.npz", **arrays)  # type: ignore[arg-type]
    lpips = Lpips(tmp_path / "weights.npz")
    assert lpips.name == name
    a, b = pictures()
    assert lpips(a, b) == pytest.approx(by_torch(network, arrays, a, b), rel=1e-4)
    assert lpips(a, a) == 0.0


@pytest.mark.filterwarnings("ignore")  # torchvision calls its own arguments deprecated
@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_it_is_what_the_authors_package_makes_of_its_own_linear_layers(tmp_path: Path, name: str) -> None:
    """Random convolutions: those that were trained have to be downloaded, the linear layers come with the package."""
    lpips = pytest.importorskip("lpips", reason="the authors' package lpips is not installed")
    torch.manual_seed(7)
    model = lpips.LPIPS(net=name, pnet_rand=True, verbose=False).eval()
    np.savez(tmp_path / "weights.npz", **{key: value.numpy() for key, value in model.state_dict().items()})
    a, b = pictures()
    pair = [(2 * torch.from_numpy(x).float() - 1).permute(2, 0, 1)[None] for x in (a, b)]
    with torch.no_grad():
        expected = model(*pair).item()
    assert Lpips(tmp_path / "weights.npz")(a, b) == pytest.approx(expected, rel=1e-5)


def test_what_is_no_file_of_weights_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.npz: cannot be read: No such file"):
        Lpips(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(InputError, match=r"text.npz: expected LPIPS weights .*.*splatctrl help score says how"):
        Lpips(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with pytest.raises(
        InputError, match=r"expected LPIPS weights of alex or vgg, got none called net.slice1.0.weight"
    ):
        Lpips(tmp_path / "other.npz")
