"""Anisotropic Gaussians against a float64 reference, forward and backward, and against the isotropic path."""

import numpy as np
import pytest
import torch

from splatctrl_cli.geometry import invert_transform, look_at
from splatctrl_cli.kernels.gaussians import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    QUAT,
    Float32,
    Float64,
    GaussianArrays,
    GaussianRasteriser,
    GaussianRates,
    gaussian_step,
)
from splatctrl_cli.kernels.raster import Rasteriser, pack_camera
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
    assert np.abs(planes - expected).max() < 1.5 / 255
    assert np.median(np.abs(planes - expected)) < 1e-6
    assert np.mean(np.abs(planes - expected) > 1e-5) < 2e-3


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_gradient_equals_autograd_of_the_reference(degree: int) -> None:
    parameters, view = gaussians(40, seed=10 + degree), camera()
    raster, planes = rendered(parameters, view, degree)
    upstream = np.random.default_rng(1).normal(size=planes.shape).astype(np.float32)
    got = raster.parameter_gradients(parameters, raster.backward(planes, upstream))
    leaf = torch.tensor(parameters.astype(np.float64), requires_grad=True)
    reference.render(torch.tensor(view), leaf, degree).backward(torch.tensor(upstream.astype(np.float64)))
    assert leaf.grad is not None
    want = leaf.grad.numpy()
    for part in (slice(0, 3), LOG_SCALE, QUAT, slice(LOGIT, LOGIT + 1), HARMONICS):
        assert np.abs(got[:, part] - want[:, part]).max() < 2e-3 * np.abs(want[:, part]).max(), part
        assert np.median(np.abs(got[:, part] - want[:, part])) < 1e-5 * np.abs(want[:, part]).max(), part


def test_the_reference_gradient_is_that_of_finite_differences() -> None:
    parameters, view = torch.tensor(gaussians(3, seed=5).astype(np.float64)), torch.tensor(camera())
    weight = torch.tensor(np.random.default_rng(2).normal(size=(3, 7)))

    def smooth(p: torch.Tensor) -> torch.Tensor:
        """Everything that depends on the parameters before pixels, which have cut-offs."""
        points = p[:, :3] @ view[6:15].reshape(3, 3).T + view[15:18]
        covariance = reference.covariances(view, points, torch.exp(p[:, 3:6]), p[:, 6:10])
        shades = reference.colors(view, p[:, :3], p[:, 11:].reshape(-1, 3, 16), 3)
        values = torch.cat([covariance.reshape(-1, 4)[:, [0, 1, 3]] / 100, shades, torch.sigmoid(p[:, 10:11])], 1)
        return (weight * values).sum()

    assert torch.autograd.gradcheck(smooth, parameters.requires_grad_(), eps=1e-6, atol=1e-6)


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
    assert np.median(difference) < 1e-6
    assert np.mean(difference > 1e-5) < 1e-3


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
    after = rendered(moved, camera(motion @ T_WORLD_CAMERA), degree=0)[1]
    assert np.mean(np.abs(before - after) > 1e-4) < 3e-3


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
    view = pack_camera(100.0, 100.0, 20.0, 15.0, 41, 31, np.eye(4))
    fine = np.zeros(59, np.float32)
    fine[[2, 6]] = 1.0
    fine[LOG_SCALE] = np.log(0.02)
    parameters = np.repeat(fine[None], 10, axis=0)
    parameters[0, 2], parameters[1, 2], parameters[2, 0] = -1.0, 0.01, 50.0
    for row, column in ((3, 0), (4, 3), (5, 6), (6, LOGIT)):
        parameters[row, column] = np.nan
    parameters[7, QUAT], parameters[8, LOGIT] = 0.0, -7.0
    raster, planes = rendered(parameters, view)
    assert raster.visible().tolist() == [False] * 9 + [True]
    gradients = raster.parameter_gradients(parameters, raster.backward(planes, np.ones_like(planes)))
    assert not gradients[:9].any()
    assert gradients[9].any()
    assert np.isfinite(gradients).all()


def arrays_of(parameters: Float32) -> GaussianArrays:
    return GaussianArrays(
        parameters=parameters.copy(),
        first=np.zeros_like(parameters),
        second=np.zeros_like(parameters),
        num_steps=np.zeros(len(parameters), np.uint32),
        growth=np.zeros((len(parameters), 3), np.float32),
    )


RATES = GaussianRates(
    center=1e-3, log_scale=2e-3, quat=3e-3, logit_opacity=4e-3, color=5e-3, harmonics=6e-3, regulariser=0.0
)


def stepped(parameters: Float32, threads: int = 1) -> tuple[GaussianArrays, Float32, Float32]:
    """After one step, with the gradients of the parameters (N, 59) and of the footprints (N, 10)."""
    arrays = arrays_of(parameters)
    raster, planes = rendered(arrays.parameters, camera(), threads=threads)
    gradients = raster.backward(planes, np.random.default_rng(1).normal(size=planes.shape).astype(np.float32))
    of_parameters = raster.parameter_gradients(arrays.parameters, gradients)
    gaussian_step(raster, gradients, arrays, RATES)
    return arrays, of_parameters, gradients


def test_the_first_step_moves_each_group_by_its_rate_against_the_gradient() -> None:
    parameters = gaussians()
    arrays, gradient, _ = stepped(parameters)
    rates = np.full(59, RATES.harmonics)
    rates[:3], rates[LOG_SCALE], rates[QUAT], rates[LOGIT] = 1e-3, 2e-3, 3e-3, 4e-3
    rates[[11, 27, 43]] = RATES.color
    moved = arrays.parameters - parameters
    expected = -rates * np.sign(gradient)  # m / sqrt(v) of a first Adam step
    assert np.abs(moved - expected)[np.abs(gradient) > 1e-6].max() < 1e-6
    assert arrays.num_steps.tolist() == gradient.any(axis=1).astype(int).tolist()


def test_growth_sums_screen_gradients_in_half_images() -> None:
    arrays, _, g = stepped(gaussians())
    expected = np.hypot(g[:, 0] * SIZE[4] / 2, g[:, 1] * SIZE[5] / 2)
    assert arrays.growth[:, 0] == pytest.approx(expected, rel=1e-5)
    assert np.array_equal(arrays.growth[:, 1], arrays.num_steps.astype(np.float32))
    assert (arrays.growth[arrays.num_steps > 0, 2] >= 3 * np.sqrt(0.3)).all()


def test_thread_count_does_not_change_a_bit() -> None:
    parameters = gaussians(3000)
    results = []
    for threads in (1, 2, 4):
        planes = rendered(parameters, camera(), threads=threads)[1]
        arrays, gradient, _ = stepped(parameters, threads)
        results.append([a.tobytes() for a in (planes, gradient, arrays.parameters, arrays.second, arrays.growth)])
    assert results[0] == results[1] == results[2]


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(N, 59\)"):
        GaussianRasteriser(1).prepare(camera(), gaussians()[:, :58].copy())
    with pytest.raises(ValueError, match="degree 0 to 3"):
        GaussianRasteriser(1).prepare(camera(), gaussians(), 4)
