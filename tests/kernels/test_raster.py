"""The rasteriser against eq. 1 to 3 in float64, forward and backward."""

import numpy as np
import pytest
import torch

from splatctrl_cli.geometry import invert_transform, look_at
from splatctrl_cli.kernels.raster import Float32, Float64, Rasteriser, empty_planes, pack_camera
from tests.reference import raster as reference

Arrays = tuple[Float32, Float32, Float32, Float32]


def camera(width: int = 45, height: int = 37) -> Float64:
    """Off-centre principal point, sizes that are no multiple of a tile."""
    T_world_camera = look_at((0.9, 0.2, 0.6), (0.0, 0.0, 0.05))
    return pack_camera(50.0, 48.0, 24.3, 16.1, width, height, invert_transform(T_world_camera))


def splats(count: int = 60, seed: int = 0) -> Arrays:
    rng = np.random.default_rng(seed)
    centers = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.3], (count, 3)).astype(np.float32)
    radii = rng.uniform(0.01, 0.08, count).astype(np.float32)
    opacities = rng.uniform(0.02, 0.98, count).astype(np.float32)
    colors = rng.uniform(0, 1, (count, 3)).astype(np.float32)
    return centers, radii, opacities, colors


def rendered(arrays: Arrays, view: Float64, threads: int = 1) -> tuple[Rasteriser, Float32]:
    raster = Rasteriser(threads)
    raster.prepare(view, *arrays)
    return raster, raster.forward()


def tensors(arrays: Arrays) -> list[torch.Tensor]:
    return [torch.tensor(a.astype(np.float64), requires_grad=True) for a in arrays]


def test_planes_equal_the_reference() -> None:
    arrays, view = splats(), camera()
    planes = rendered(arrays, view)[1]
    expected = reference.render(torch.tensor(view), *tensors(arrays)).detach().numpy()
    # A pixel whose alpha lies within rounding of 1/255 may fall on either side of the cut.
    assert np.abs(planes - expected).max() < 1.2 / 255
    assert np.median(np.abs(planes - expected)) < 1e-6
    assert np.mean(np.abs(planes - expected) > 1e-5) < 1e-3


def test_planes_begin_at_a_whole_cache_line() -> None:
    assert all(empty_planes(7, width).ctypes.data % 64 == 0 for width in range(1, 40))


def test_gradients_equal_autograd_of_the_reference() -> None:
    arrays, view = splats(40, seed=3), camera()
    raster, planes = rendered(arrays, view)
    upstream = np.random.default_rng(1).normal(size=planes.shape).astype(np.float32)
    gradients = raster.backward(planes, upstream)
    g_centers, g_radii = raster.project_backward(gradients)
    leaves = tensors(arrays)
    reference.render(torch.tensor(view), *leaves).backward(torch.tensor(upstream.astype(np.float64)))
    expected = [leaf.grad.numpy() for leaf in leaves if leaf.grad is not None]
    for got, want in zip([g_centers, g_radii, gradients[:, 6], gradients[:, 7:]], expected, strict=True):
        assert np.abs(got - want).max() < 2e-3 * np.abs(want).max()
        assert np.median(np.abs(got - want)) < 1e-5 * np.abs(want).max()


def test_opaque_layers_that_use_up_the_light_equal_the_reference() -> None:
    """Most pixels are finished long before their tile's list; some opacities are above the clamp at 0.99."""
    rng = np.random.default_rng(7)
    count = 120
    arrays = (
        rng.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.3], (count, 3)).astype(np.float32),
        rng.uniform(0.1, 0.3, count).astype(np.float32),
        rng.choice(np.float32([0.5, 0.9, 0.995, 0.999]), count),
        rng.uniform(0, 1, (count, 3)).astype(np.float32),
    )
    view = camera()
    raster, planes = rendered(arrays, view)
    assert np.mean(planes[4] > 1 - 1e-3) > 0.5
    upstream = rng.normal(size=planes.shape).astype(np.float32)
    gradients = raster.backward(planes, upstream)
    leaves = tensors(arrays)
    expected = reference.render(torch.tensor(view), *leaves)
    expected.backward(torch.tensor(upstream.astype(np.float64)))
    difference = np.abs(planes - expected.detach().numpy())
    assert difference.max() < 1.2 / 255
    assert np.mean(difference > 1e-5) < 1e-3
    for got, leaf in zip(
        [*raster.project_backward(gradients), gradients[:, 6], gradients[:, 7:]], leaves, strict=True
    ):
        assert leaf.grad is not None
        want = leaf.grad.numpy()
        assert np.abs(got - want).max() < 2e-3 * np.abs(want).max()


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
    arrays = splats()
    T_world_camera = look_at((0.9, 0.2, 0.6), (0.0, 0.0, 0.05))
    motion = look_at((0.1, -0.3, 0.2), (0.5, 0.4, 0.1))
    moved = (arrays[0] @ motion[:3, :3].T.astype(np.float32) + motion[:3, 3].astype(np.float32), *arrays[1:])
    size = (50.0, 48.0, 24.3, 16.1, 45, 37)
    before = rendered(arrays, pack_camera(*size, invert_transform(T_world_camera)))[1]
    after = rendered(
        (np.ascontiguousarray(moved[0]), *moved[1:]), pack_camera(*size, invert_transform(motion @ T_world_camera))
    )[1]
    assert np.mean(np.abs(before - after) > 1e-4) < 2e-3


def test_a_centred_splat_peaks_at_its_pixel_with_its_opacity() -> None:
    view = pack_camera(100.0, 100.0, 20.0, 15.0, 41, 31, np.eye(4))
    one = np.float32([[0.0, 0.0, 1.0]]), np.float32([0.02]), np.float32([0.7]), np.float32([[1.0, 0.5, 0.0]])
    planes = rendered(one, view)[1]
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
    assert not raster.visible().any()
    assert not planes.any()
    assert not raster.backward(planes, np.ones_like(planes)).any()


def test_an_empty_set_renders_black() -> None:
    empty = (
        np.zeros((0, 3), np.float32),
        np.zeros(0, np.float32),
        np.zeros(0, np.float32),
        np.zeros((0, 3), np.float32),
    )
    assert not rendered(empty, camera())[1].any()


def test_wrong_dtype_is_refused() -> None:
    centers, radii, opacities, colors = splats()
    with pytest.raises(TypeError):
        Rasteriser(1).prepare(camera(), centers.astype(np.float64), radii, opacities, colors)  # type: ignore[arg-type]


def test_backward_before_forward_is_refused() -> None:
    raster = Rasteriser(1)
    raster.prepare(camera(), *splats())
    planes = np.zeros((5, 37, 45), np.float32)
    with pytest.raises(RuntimeError, match="expected forward"):
        raster.backward(planes, planes)
