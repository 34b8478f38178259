"""Rendered anisotropic Gaussians against a float64 reference, and against the isotropic path."""

import numpy as np
import pytest
import torch

from splatctrl_cli.geometry import invert_transform, look_at
from splatctrl_cli.kernels.raster import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    QUAT,
    Float32,
    Float64,
    GaussianRasteriser,
    Rasteriser,
    pack_camera,
)
from tests.reference import gaussians as reference

SIZE = (50.0, 48.0, 24.3, 16.1, 45, 37)  # off-centre principal point, sizes that are no multiple of a tile
T_WORLD_CAMERA = look_at((0.9, 0.2, 0.6), (0.0, 0.0, 0.05))


def camera(T_world_camera: Float64 = T_WORLD_CAMERA) -> Float64:
    return pack_camera(*SIZE, invert_transform(T_world_camera))


def gaussians(count: int = 50, seed: int = 0) -> Float32:
    """Needles, discs and blobs with quaternions that are not normalised."""
    rng = np.random.default_rng(seed)
    out = rng.normal(0.0, 0.2, (count, 59))
    out[:, :3] = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.3], (count, 3))
    out[:, LOG_SCALE] = np.log(rng.uniform(0.004, 0.12, (count, 3)))
    out[:, QUAT] = rng.normal(size=(count, 4)) * rng.uniform(0.5, 3.0, (count, 1))
    out[:, LOGIT] = rng.uniform(-4, 4, count)
    return out.astype(np.float32)


def rendered(
    parameters: Float32, view: Float64, degree: int = 3, threads: int = 1
) -> tuple[GaussianRasteriser, Float32]:
    raster = GaussianRasteriser(threads)
    raster.prepare(view, parameters, degree)
    return raster, raster.forward()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_planes_equal_the_reference(degree: int) -> None:
    parameters, view = gaussians(seed=degree), camera()
    planes = rendered(parameters, view, degree)[1]
    expected = reference.render(torch.tensor(view), torch.tensor(parameters.astype(np.float64)), degree).numpy()
    # A pixel whose alpha lies within rounding of 1/255 may fall on either side of the cut.
    assert np.abs(planes - expected).max() < 1.5 / 255 and np.median(np.abs(planes - expected)) < 1e-6
    assert np.mean(np.abs(planes - expected) > 1e-5) < 2e-3


def test_an_isotropic_set_renders_as_the_isotropic_path_does() -> None:
    parameters = gaussians(80)
    parameters[:, LOG_SCALE] = parameters[:, LOG_SCALE][:, :1]
    parameters[:, HARMONICS] = 0.0
    shades = np.random.default_rng(3).uniform(0, 1, (80, 3)).astype(np.float32)
    parameters[:, HARMONICS].reshape(-1, 3, 16)[:, :, 0] = (shades - 0.5) / 0.28209479177387814
    raster = Rasteriser(1)
    centers = np.ascontiguousarray(parameters[:, :3])
    radii, opacities = np.exp(parameters[:, 3]), 1 / (1 + np.exp(-parameters[:, LOGIT]))
    raster.prepare(camera(), centers, radii, opacities, shades)
    difference = np.abs(rendered(parameters, camera())[1] - raster.forward())
    assert np.median(difference) < 1e-6 and np.mean(difference > 1e-5) < 1e-3


def test_turning_gaussians_and_camera_together_changes_nothing() -> None:
    parameters = gaussians()
    motion = look_at((0.1, -0.3, 0.2), (0.5, 0.4, 0.1))
    moved = parameters.copy()
    moved[:, :3] = parameters[:, :3] @ motion[:3, :3].T + motion[:3, 3]
    a = np.sqrt(1 + np.trace(motion[:3, :3])) / 2
    b, c, d = (motion[[2, 0, 1], [1, 2, 0]] - motion[[1, 2, 0], [2, 0, 1]]) / (4 * a)
    left = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
    moved[:, QUAT] = parameters[:, QUAT] @ left.T
    before = rendered(parameters, camera(), degree=0)[1]
    assert np.mean(np.abs(before - rendered(moved, camera(motion @ T_WORLD_CAMERA), degree=0)[1]) > 1e-4) < 3e-3


def test_the_length_of_a_quaternion_does_not_matter() -> None:
    parameters = gaussians()
    longer = parameters.copy()
    longer[:, QUAT] *= 4.0  # a power of two: the same bits
    assert np.array_equal(rendered(parameters, camera())[1], rendered(longer, camera())[1])


def test_degree_zero_does_not_look_at_higher_harmonics() -> None:
    parameters = gaussians()
    flat = parameters.copy()
    flat[:, HARMONICS].reshape(-1, 3, 16)[:, :, 1:] = 7.0
    assert np.array_equal(rendered(parameters, camera(), 0)[1], rendered(flat, camera(), 0)[1])
    assert not np.array_equal(rendered(parameters, camera(), 1)[1], rendered(flat, camera(), 1)[1])


def test_unseeable_gaussians_are_left_out() -> None:
    fine = np.zeros(59, np.float32)
    fine[[2, 6]] = 1.0
    fine[LOG_SCALE] = np.log(0.02)
    parameters = np.repeat(fine[None], 10, axis=0)
    parameters[0, 2], parameters[1, 2], parameters[2, 0] = -1.0, 0.01, 50.0
    for row, column in ((3, 0), (4, 3), (5, 6), (6, LOGIT)):
        parameters[row, column] = np.nan
    parameters[7, QUAT], parameters[8, LOGIT] = 0.0, -7.0
    raster, planes = rendered(parameters, pack_camera(100.0, 100.0, 20.0, 15.0, 41, 31, np.eye(4)))
    is_visible = np.empty(len(parameters), np.uint8)
    raster.native.visible(is_visible)
    assert is_visible.tolist() == [0] * 9 + [1]
    assert np.isfinite(planes).all()


def test_thread_count_does_not_change_a_bit() -> None:
    parameters = gaussians(3000)
    planes = [rendered(parameters, camera(), threads=threads)[1].tobytes() for threads in (1, 2, 4)]
    assert planes[0] == planes[1] == planes[2]


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(N, 59\)"):
        GaussianRasteriser(1).prepare(camera(), gaussians()[:, :58].copy())
    with pytest.raises(ValueError, match="degree 0 to 3"):
        GaussianRasteriser(1).prepare(camera(), gaussians(), 4)
