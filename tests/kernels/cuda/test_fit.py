"""The device's kernels against the package's own and the float64 references; see emulator.py for "processor"."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatctrl_cli.kernels.cuda.fit import LIST_CAPACITY, DeviceFit, bytes_needed
from splatctrl_cli.kernels.cuda.memory import DeviceError, Memory, OutOfMemory
from splatctrl_cli.kernels.raster import Float32, LossTerms, LossWeights, OptimiserSettings, TargetView
from tests.kernels.cuda.emulator import EmulatedDevice
from tests.kernels.cuda.scenes import SETTINGS, WEIGHTS, OnProcessor, camera, parameters
from tests.kernels.scenes import moments, target, visible
from tests.reference import loss as loss_reference
from tests.reference import raster as raster_reference
from tests.refused import expect_refusal

FORWARD, BACKWARD = 1e-5, 1e-4  # largest error allowed, relative to the whole


def error(got: Float32, want: Float32) -> float:
    """|got - want| / |want|, over everything; not a number where anything is not."""
    return float(np.linalg.norm(got.astype(np.float64) - want) / max(np.linalg.norm(want.astype(np.float64)), 1e-12))


def derivatives(fit: DeviceFit, weights: LossWeights, settings: OptimiserSettings) -> tuple[Float32, LossTerms]:
    """Gradient (N, 8) of the first view's loss by the parameters, which do not change, and the loss."""
    height, width = fit.views[0].target.depth.shape
    while True:
        fit.rewind([0], weights, settings, 0)
        fit._graph(height, width, "gradients").run()
        if fit._fits():
            return fit._read("gradients", (fit.num_splats, 8)), fit._terms([0])[0]


def opaque(count: int) -> Float32:
    """Large splats: the light is used up early, some opacities are above the clamp at 0.99."""
    p = parameters(count, radius=0.1, seed=7)
    p[:, 7] = np.random.default_rng(7).choice(np.float32([0.0, 2.2, 5.3, 6.9]), count)
    return p


def distinct(count: int) -> Float32:
    """No two equal in depth: the reference may take those in either order."""
    p = parameters(count, seed=5)[count // 10 :]
    p[:, 7] = np.clip(p[:, 7], -4.0, None)
    return p


SCENES = {
    "small": parameters(150),
    "opaque": opaque(120),
    "huge": parameters(24, radius=1.0, seed=3),
    "unseen": parameters(20) + np.float32([9, 9, 9, 0, 0, 0, 0, 0]),
}


def fitted(device: Memory, p: Float32, view: np.ndarray | None = None, seen: TargetView | None = None) -> DeviceFit:
    fit = DeviceFit(device, len(p))
    fit.put(p, moments(len(p)))
    fit.add_view(camera() if view is None else view, target() if seen is None else seen)
    return fit


@pytest.mark.parametrize("scene", SCENES)
def test_planes_equal_those_of_the_processor(scene: str, device: Memory) -> None:
    p = SCENES[scene]
    planes, want = fitted(device, p).planes(0), OnProcessor(p, camera()).planes
    if scene == "unseen":
        assert not planes.any() and not want.any()
        return
    assert [error(planes[k], want[k]) < FORWARD for k in range(5)] == [True] * 5


def test_lists_longer_than_shared_memory_are_blended_in_order(device: Memory) -> None:
    """2,500 splats over four tiles: sorted in the device's own memory; more of them than the lists first hold."""
    p = parameters(2500, radius=0.03, seed=2)
    p[:, 7] = -4.0
    view = camera(24, 20)
    fit = fitted(device, p, view, target(24, 20))
    planes, want = fit.planes(0), OnProcessor(p, view).planes
    assert fit.list_capacity > 1024
    assert error(planes, want) < FORWARD


def losses() -> dict[str, tuple[LossWeights, TargetView]]:
    seen = target()
    return {
        "normalised": (WEIGHTS, seen),
        "as printed": (replace(WEIGHTS, normalised=False, background=(0.0, 0.0, 0.0)), seen),
        "without depth": (WEIGHTS, replace(seen, depth=np.zeros_like(seen.depth))),
        "nothing counted": (WEIGHTS, replace(seen, counted=np.zeros_like(seen.counted))),
    }


def values(terms: LossTerms) -> list[float]:
    return [terms.l1, terms.dssim, terms.depth, terms.transmittance, terms.squared]


@pytest.mark.parametrize("case", losses())
def test_loss_and_its_derivative_equal_those_of_the_processor(case: str, device: Memory) -> None:
    weights, seen = losses()[case]
    p = SCENES["small"]
    fit = fitted(device, p, seen=seen)
    _, terms = derivatives(fit, weights, SETTINGS)
    gradient = fit.read_image("plane_gradients", 0, 5)
    for c in range(3):  # the background's share is added where the derivative is read
        gradient[4] -= np.float32(weights.background[c]) * gradient[c]
    want, want_terms = OnProcessor(p, camera()).loss(seen, weights, fit.planes(0))
    assert values(terms) == pytest.approx(values(want_terms), rel=1e-5, abs=1e-9)
    assert error(gradient, want) < FORWARD


@pytest.mark.parametrize("scene", ["small", "opaque", "huge"])
def test_gradients_equal_those_of_the_processor(scene: str, device: Memory) -> None:
    p = SCENES[scene]
    gradients, _ = derivatives(fitted(device, p), WEIGHTS, SETTINGS)
    want_planes, _ = OnProcessor(p, camera()).loss(target(), WEIGHTS)
    want = OnProcessor(p, camera()).gradients(want_planes, SETTINGS.regulariser)
    assert [error(gradients[:, k], want[:, k]) < BACKWARD for k in range(8)] == [True] * 8
    assert np.array_equal(gradients.any(axis=1), want.any(axis=1))


def test_planes_and_gradients_equal_the_references_and_their_autograd(device: Memory) -> None:
    p = distinct(60)
    seen, weights = target(), replace(WEIGHTS, normalised=False)
    fit = fitted(device, p)
    gradients, _ = derivatives(fit, weights, replace(SETTINGS, regulariser=0.0))
    leaf = torch.tensor(p.astype(np.float64), requires_grad=True)
    planes = raster_reference.render(
        torch.tensor(camera()), leaf[:, :3], leaf[:, 3].exp(), leaf[:, 7].sigmoid(), leaf[:, 4:7]
    )
    assert error(fit.planes(0), planes.detach().numpy()) < FORWARD
    value = loss_reference.loss(
        planes,
        torch.tensor(seen.color.astype(np.float64) / 255.0),
        torch.tensor(seen.depth.astype(np.float64)),
        torch.tensor(seen.counted > 0),
        dssim=weights.dssim,
        color_weight=weights.color,
        depth_weight=weights.depth,
        opacity_weight=weights.opacity,
        normalised=weights.normalised,
        background=weights.background,
    )
    value.backward()
    want = leaf.grad.numpy()
    assert [error(gradients[:, k], want[:, k]) < BACKWARD for k in range(8)] == [True] * 8


def test_iterations_equal_those_of_the_processor(device: Memory) -> None:
    """Two views of different size in turn: parameters, moments and the terms of the loss, noise included."""
    p = SCENES["small"]
    views = [(camera(), target()), (camera(40, 52, (-0.3, 0.8, 0.7)), target(40, 52, seed=4))]
    schedule = [0, 1, 1, 0]
    state = moments(len(p))
    on_processor = p.copy()
    for k, which in enumerate(schedule):
        one = OnProcessor(on_processor, views[which][0])
        plane_gradients, want_terms = one.loss(views[which][1], WEIGHTS)
        one.step(plane_gradients, state, SETTINGS, (5 << 32) + 3 + k)
        on_processor = one.parameters
    fit = fitted(device, p, *views[0])
    fit.add_view(*views[1])
    terms = fit.run(schedule, WEIGHTS, SETTINGS, (5 << 32) + 3)
    got, got_state = np.empty_like(p), moments(len(p))
    fit.take(got, got_state)
    assert np.array_equal(got_state.num_steps, state.num_steps) and error(got_state.first, state.first) < BACKWARD
    assert error(got, on_processor) < BACKWARD
    assert error(got - p, on_processor - p) < 1e-2  # Adam divides by what is nearly zero
    assert (set(terms), values(terms[0])) == ({0, 1}, pytest.approx(values(want_terms), rel=1e-4))


def run_bytes(device: Memory, **sizes: int) -> bytes:
    p = SCENES["small"]
    fit = DeviceFit(device, len(p), **sizes)
    fit.put(p, moments(len(p)))
    for k in range(2):
        fit.add_view(camera(), target(seed=k))
    terms = fit.run([0, 1, 0], WEIGHTS, SETTINGS, 11)
    got, state = np.empty_like(p), moments(len(p))
    fit.take(got, state)
    planes = fit.planes(1)
    fit.close()
    return (
        b"".join([a.tobytes() for a in (got, state.first, state.second, state.num_steps, planes)])
        + repr(terms).encode()
    )


def test_bytes_are_the_same_in_every_run(new_device: Callable[[], Memory]) -> None:
    assert run_bytes(new_device()) == run_bytes(new_device())


def test_bytes_do_not_depend_on_the_order_of_threads_and_blocks() -> None:
    assert run_bytes(EmulatedDevice()) == run_bytes(EmulatedDevice(backwards=True))


def test_a_run_whose_lists_were_too_short_is_repeated(device: Memory) -> None:
    assert run_bytes(device, list_capacity=8, part_capacity=64) == run_bytes(device)


def test_splats_out_of_view_keep_their_bytes(device: Memory) -> None:
    p = SCENES["small"]
    unseen = ~visible(OnProcessor(p, camera()).raster)
    fit = fitted(device, p)
    fit.run([0], WEIGHTS, SETTINGS, 1)
    got, state = np.empty_like(p), moments(len(p))
    fit.take(got, state)
    assert unseen.sum() > 10 and np.array_equal(got[unseen], p[unseen])
    assert np.array_equal(state.num_steps == 0, unseen)


def test_more_splats_than_an_entry_can_number_are_refused() -> None:
    expect_refusal("num_splats: expected less than 16777216", DeviceFit, EmulatedDevice(), 1 << 24, error=DeviceError)


def test_memory_needed_is_what_a_run_holds() -> None:
    """Two views of one size, one of another; beside it are the sums of patches."""
    p, on = parameters(2000, radius=0.005), EmulatedDevice()
    sizes = [(61, 83), (61, 83), (104, 80)]
    fit = DeviceFit(on, len(p), sizes)
    fit.put(p, moments(len(p)))
    for height, width in sizes:
        fit.add_view(camera(width, height), target(width, height))
    fit.run([0, 1, 2], WEIGHTS, SETTINGS, 1)
    assert fit.list_capacity == LIST_CAPACITY
    assert abs(sum(on.sizes.values()) - bytes_needed(len(p), sizes)) < 5_000


def test_what_does_not_fit_is_refused_with_the_budget_that_does() -> None:
    sizes, limit = [(480, 640)] * 4, 60_000_000
    assert bytes_needed(1_000, sizes) < limit < bytes_needed(50_000, sizes)
    fit = DeviceFit(EmulatedDevice(limit=limit), 50_000)
    with pytest.raises(OutOfMemory, match=r"50000 splats and 4 views take .* MB, 60 MB are free") as caught:
        fit.expect(sizes)
    said = re.fullmatch(r"a budget of (\d+) splats would fit", caught.value.remedy)
    fit.close()
    small = DeviceFit(fit.device, int(said[1]))
    small.expect(sizes)
    small.close()
    with pytest.raises(OutOfMemory) as caught:
        DeviceFit(EmulatedDevice(limit=20_000_000), 1_000).expect(sizes)
    assert caught.value.remedy == "take smaller images"


def test_lists_that_outgrow_the_memory_are_an_error_that_leaves_nothing_behind() -> None:
    p, view = parameters(2500, radius=0.03, seed=2), camera(24, 20)
    p[:, 7] = -4.0
    free = DeviceFit(EmulatedDevice(), len(p))
    free.close()
    assert not free.device.sizes
    fit = fitted(EmulatedDevice(limit=bytes_needed(len(p), [(20, 24)]) + 10_000), p, view, target(24, 20))
    expect_refusal(r"out of memory: 2500 splats .*3 MB are free", fit.planes, 0, error=OutOfMemory)
    fit.close()
    assert not fit.device.sizes
