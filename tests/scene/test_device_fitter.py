"""The fitter whose iterations are done on a device, beside the one on the processor.

Adam divides by what is nearly zero: after nine iterations the processor's own two instruction sets differ by up to
6e-5 in the loss and 5e-6 in the median of the parameters.
"""

from collections.abc import Callable, Sequence

import numpy as np

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.kernels.cuda.fit import DeviceFit
from splatctrl_cli.kernels.cuda.memory import Array, Launch, Memory
from splatctrl_cli.scene.checkpoint import fitter_state, restore_fitter
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.time_steps import AuditRow
from tests.kernels.cuda.conftest import new_device  # noqa: F401
from tests.kernels.cuda.emulator import EmulatedDevice, EmulatedGraph
from tests.scene.wall import WORKSPACE, frame

CONFIG = SceneConfig(max_splats=400, first_iterations=6, iterations_per_step=3)


def fitter(device: Memory | None) -> SceneFitter:
    return SceneFitter(
        CONFIG,
        OccupancyConfig(),
        WORKSPACE,
        threads=1,
        device=None if device is None else DeviceFit(device, CONFIG.max_splats),
    )


def run(target: SceneFitter, first: int, last: int) -> list[AuditRow]:
    return [
        target.step([frame(k * 100_000_000, x=x, camera=f"cam{x}") for x in (0.1, -0.1)]) for k in range(first, last)
    ]


def test_time_steps_on_a_device_equal_those_on_the_processor(new_device: Callable[[], Memory]) -> None:  # noqa: F811
    on_device, on_processor, heard = fitter(new_device()), fitter(None), []
    on_device.descent.heard = lambda: heard.append(on_device.descent.num_iterations)
    for mine, other in zip(run(on_device, 0, 2), run(on_processor, 0, 2), strict=True):
        assert (mine.alive, mine.added, mine.removed) == (other.alive, other.added, other.removed)
        assert abs(mine.loss - other.loss) < 5e-4
    assert heard == list(range(1, on_processor.descent.num_iterations + 1))
    assert np.median(np.abs(on_device.buffer.parameters - on_processor.buffer.parameters)) < 5e-5


def test_a_run_goes_on_on_the_other_device(new_device: Callable[[], Memory]) -> None:  # noqa: F811
    whole, begun, resumed = fitter(None), fitter(new_device()), fitter(None)
    run(whole, 0, 2)
    run(begun, 0, 1)
    restore_fitter(resumed, fitter_state(begun))
    run(resumed, 1, 2)
    assert resumed.descent.num_iterations == whole.descent.num_iterations
    assert np.median(np.abs(resumed.buffer.parameters - whole.buffer.parameters)) < 5e-5


class Listens(EmulatedDevice):
    """Counts the bytes of images that are sent, and the kernels that are started."""

    def __init__(self) -> None:
        super().__init__()
        self.image_bytes = 0
        self.graphs: list[list[str]] = []

    def write(self, address: int, values: Array) -> None:
        self.image_bytes += values.nbytes if values.ndim >= 2 and values.shape[-2:] == (60, 80) else 0
        super().write(address, values)

    def record(self, launches: Sequence[Launch]) -> EmulatedGraph:
        self.graphs.append([one.kernel for one in launches])
        return super().record(launches)


def test_images_are_sent_once_and_those_no_longer_in_the_window_are_given_back() -> None:
    device, image = Listens(), 8 * 60 * 80
    target = fitter(device)
    sent = []
    for k in range(6):
        device.image_bytes = 0
        target.step([frame(k * 100_000_000, x=0.1 * k, camera="cam0")])
        sent.append(device.image_bytes)
    assert sent == [image] * 6
    assert len(target.window.keyframes) == 5
    target.window.keyframes = target.window.keyframes[-1:]
    before = sum(device.sizes.values())
    target.descent.keep([*target.window.newest, *target.window.keyframes])
    assert sum(device.sizes.values()) == before - 4 * image


def test_what_is_seeded_is_chosen_by_a_rendering_of_the_device() -> None:
    on_device, on_processor = fitter(device := Listens()), fitter(None)
    run(on_device, 0, 1), run(on_processor, 0, 1)
    assert ["project", "blend"] in device.graphs
    view = on_device.window.newest[0]
    on_device.buffer.parameters[...] = on_processor.buffer.parameters
    got, want = on_device.descent.rendering(view), on_processor.descent.rendering(view)
    for mine, other in ((got.color, want.color), (got.depth, want.depth), (got.opacity, want.opacity)):
        assert np.abs(mine - other).max() < 1e-4
