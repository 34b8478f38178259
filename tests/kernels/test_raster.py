"""The rasteriser against eq. 1 to 3 in float64, forward and backward."""

import numpy as np
import pytest
import torch

from splatctrl_cli.geometry import look_at, transform_points
from splatctrl_cli.kernels.raster import Float32, Float64, Rasteriser, empty_planes, pack_camera
from tests.kernels.scenes import Arrays, camera, splats, visible
from tests.reference import raster as reference


def rendered(arrays: Arrays, view: Float64, threads: int = 1) -> tuple[Rasteriser, Float32]:
    raster = Rasteriser(threads)
    raster.prepare(view, *arrays)
    return raster, raster.forward()


def tensors(arrays: Arrays) -> list[torch.Tensor]:
    return [torch.tensor(a.astype(np.float64), requires_grad=True) for a in arrays]


def test_planes_begin_at_a_whole_cache_line() -> None:
    assert all(empty_planes(7, width).ctypes.data % 64 == 0 for width in range(1, 40))


def opaque_layers() -> Arrays:
    """Most pixels are finished long before their tile's list; some opacities are above the clamp at 0.99."""
    rng = np.random.default_rng(7)
    return (
        rng.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.3], (120, 3)).astype(np.float32),
        rng.uniform(0.1, 0.3, 120).astype(np.float32),
        rng.choice(np.float32([0.5, 0.9, 0.995, 0.999]), 120),
        rng.uniform(0, 1, (120, 3)).astype(np.float32),
    )


@pytest.mark.parametrize(("arrays", "is_opaque"), [(splats(), False), (opaque_layers(), True)])
def test_planes_and_gradients_equal_the_reference_and_its_autograd(arrays: Arrays, is_opaque: bool) -> None:
    raster, planes = rendered(arrays, camera())
    assert (np.mean(planes[4] > 1 - 1e-3) > 0.5) == is_opaque
    upstream = np.random.default_rng(1).normal(size=planes.shape).astype(np.float32)
    gradients = raster.backward(planes, upstream)
    g_centers, g_radii = raster.project_backward(gradients)
    leaves = tensors(arrays)
    expected = reference.render(torch.tensor(camera()), *leaves)
    expected.backward(torch.tensor(upstream.astype(np.float64)))
    difference = np.abs(planes - expected.detach().numpy())
    # A pixel whose alpha lies within rounding of 1/255 may fall on either side of the cut.
    assert difference.max() < 1.2 / 255 and np.median(difference) < 1e-6 and np.mean(difference > 1e-5) < 1e-3
    for got, leaf in zip([g_centers, g_radii, gradients[:, 6], gradients[:, 7:]], leaves, strict=True):
        want = leaf.grad.numpy()
        assert np.abs(got - want).max() < 2e-3 * np.abs(want).max()
        assert np.median(np.abs(got - want)) < 1e-5 * np.abs(want).max()


def test_thread_count_does_not_change_a_bit() -> None:
    arrays, view = splats(500), camera(200, 150)
    upstream = np.random.default_rng(1).normal(size=(5, 150, 200)).astype(np.float32)
    raster, planes = rendered(arrays, view, 1)
    gradients = raster.backward(planes, upstream)
    for threads in (2, 3, 5):
        other, other_planes = rendered(arrays, view, threads)
        assert other_planes.tobytes() == planes.tobytes()
        assert other.backward(planes, upstream).tobytes() == gradients.tobytes()


def test_splat_order_in_memory_does_not_matter() -> None:
    arrays, view = splats(), camera()
    order = np.random.default_rng(5).permutation(len(arrays[1]))
    shuffled = tuple(np.ascontiguousarray(a[order]) for a in arrays)
    assert np.array_equal(rendered(arrays, view)[1], rendered(shuffled, view)[1])  # type: ignore[arg-type]


def test_moving_camera_and_splats_together_changes_nothing() -> None:
    centers, *others = splats()
    motion = look_at((0.1, -0.3, 0.2), (0.5, 0.4, 0.1))
    before = rendered((centers, *others), camera())[1]
    moved = transform_points(motion, centers).astype(np.float32)
    assert np.mean(np.abs(before - rendered((moved, *others), camera(motion=motion))[1]) > 1e-4) < 2e-3


def test_a_centred_splat_peaks_at_its_pixel_with_its_opacity() -> None:
    view = pack_camera(100.0, 100.0, 20.0, 15.0, 41, 31, np.eye(4))
    planes = rendered(
        (np.float32([[0.0, 0.0, 1.0]]), np.float32([0.02]), np.float32([0.7]), np.float32([[1.0, 0.5, 0.0]])), view
    )[1]
    assert np.unravel_index(planes[4].argmax(), planes[4].shape) == (15, 20)
    assert planes[4, 15, 20] == pytest.approx(0.7, abs=1e-6)
    assert planes[:4, 15, 20] == pytest.approx([0.7, 0.35, 0.0, 0.7], abs=1e-6)


def test_unseeable_splats_are_left_out() -> None:
    nan = np.float32(np.nan)
    centers = np.float32([[0, 0, -1], [0, 0, 0.01], [50, 0, 1], [nan, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]])
    radii = np.float32([0.02, 0.02, 0.02, 0.02, 0.0, nan, 0.02])
    opacities = np.float32([0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.001])
    view = pack_camera(100.0, 100.0, 20.0, 15.0, 41, 31, np.eye(4))
    raster, planes = rendered((centers, radii, opacities, np.ones((7, 3), np.float32)), view)
    assert not visible(raster).any()
    assert not planes.any() and not raster.backward(planes, np.ones_like(planes)).any()
    assert not rendered(splats(0), view)[1].any()


def test_wrong_dtype_and_backward_before_forward_are_refused() -> None:
    centers, *others = splats()
    raster = Rasteriser(1)
    with pytest.raises(TypeError):
        raster.prepare(camera(), centers.astype(np.float64), *others)  # type: ignore[arg-type]
    raster.prepare(camera(), *splats())
    planes = np.zeros((5, 37, 45), np.float32)
    with pytest.raises(RuntimeError, match="expected forward"):
        raster.backward(planes, planes)
