"""Gradients of anisotropic Gaussians against a float64 reference, and a step of Adam."""

import numpy as np
import pytest
import torch

from experiments.gaussian_step import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    QUAT,
    GaussianArrays,
    GaussianRates,
    TrainingRasteriser,
    gaussian_step,
)
from splatctrl_cli.kernels import Float32, Float64, native
from splatctrl_cli.kernels.raster import pack_camera
from tests.kernels.test_gaussians import SIZE, camera, gaussians
from tests.reference import gaussians as reference


def rendered(
    parameters: Float32, view: Float64, degree: int = 3, threads: int = 1
) -> tuple[TrainingRasteriser, Float32]:
    raster = TrainingRasteriser(threads)
    raster.prepare(view, parameters, degree)
    return raster, raster.forward()


def parameter_gradients(raster: TrainingRasteriser, parameters: Float32, gradients: Float32) -> Float32:
    """Gradients (N, 59) of the prepared parameters from those of their footprints (N, 10)."""
    out = np.empty_like(parameters)
    native.gaussian_gradients(raster.native, parameters, raster.degree, gradients, out, raster.num_threads)
    return out


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_gradient_equals_autograd_of_the_reference(degree: int) -> None:
    parameters, view = gaussians(40, seed=10 + degree), camera()
    raster, planes = rendered(parameters, view, degree)
    upstream = np.random.default_rng(1).normal(size=planes.shape).astype(np.float32)
    got = parameter_gradients(raster, parameters, raster.backward(planes, upstream))
    leaf = torch.tensor(parameters.astype(np.float64), requires_grad=True)
    reference.render(torch.tensor(view), leaf, degree).backward(torch.tensor(upstream.astype(np.float64)))
    want = leaf.grad.numpy()
    for part in (slice(0, 3), LOG_SCALE, QUAT, slice(LOGIT, LOGIT + 1), HARMONICS):
        assert np.abs(got[:, part] - want[:, part]).max() < 2e-3 * np.abs(want[:, part]).max(), part
        assert np.median(np.abs(got[:, part] - want[:, part])) < 1e-5 * np.abs(want[:, part]).max(), part


def test_the_reference_gradient_is_that_of_finite_differences() -> None:
    parameters, view = torch.tensor(gaussians(3, seed=5).astype(np.float64)), torch.tensor(camera())
    weight = torch.tensor(np.random.default_rng(2).normal(size=(3, 7)))

    def smooth(p: torch.Tensor) -> torch.Tensor:
        """The parts of the loss that come before pixels: pixels have cut-offs, which differences do not meet."""
        points = p[:, :3] @ view[6:15].reshape(3, 3).T + view[15:18]
        covariance = reference.covariances(view, points, torch.exp(p[:, 3:6]), p[:, 6:10])
        shades = reference.colors(view, p[:, :3], p[:, 11:].reshape(-1, 3, 16), 3)
        values = torch.cat([covariance.reshape(-1, 4)[:, [0, 1, 3]] / 100, shades, torch.sigmoid(p[:, 10:11])], 1)
        return (weight * values).sum()

    assert torch.autograd.gradcheck(smooth, parameters.requires_grad_(), eps=1e-6, atol=1e-6)


def test_unseeable_gaussians_have_no_gradient() -> None:
    view = pack_camera(100.0, 100.0, 20.0, 15.0, 41, 31, np.eye(4))
    fine = np.zeros(59, np.float32)
    fine[[2, 6]] = 1.0
    fine[LOG_SCALE] = np.log(0.02)
    parameters = np.repeat(fine[None], 4, axis=0)
    parameters[0, 2], parameters[1, 0], parameters[2, QUAT] = -1.0, np.nan, 0.0
    raster, planes = rendered(parameters, view)
    gradients = parameter_gradients(raster, parameters, raster.backward(planes, np.ones_like(planes)))
    assert not gradients[:3].any() and gradients[3].any() and np.isfinite(gradients).all()


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
    of_parameters = parameter_gradients(raster, arrays.parameters, gradients)
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
        arrays, gradient, _ = stepped(parameters, threads)
        results.append([a.tobytes() for a in (gradient, arrays.parameters, arrays.second, arrays.growth)])
    assert results[0] == results[1] == results[2]
