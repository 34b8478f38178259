"""The devices that a test runs on: the processor, in both orders of threads, and a card where there is one."""

from collections.abc import Callable

import pytest

from splatctrl_cli.kernels.cuda.memory import DeviceError, Memory
from tests.kernels.cuda.emulator import EmulatedDevice


def card() -> Memory:
    """The first card, or a skip that says why not."""
    try:
        from splatctrl_cli.kernels.cuda.card import CudaDevice

        return CudaDevice()
    except (ImportError, DeviceError) as error:
        pytest.skip(f"needs a CUDA device: {error}")


@pytest.fixture(params=["processor", pytest.param("card", marks=pytest.mark.gpu)])
def new_device(request: pytest.FixtureRequest) -> Callable[[], Memory]:
    """Makes a device."""
    return EmulatedDevice if request.param == "processor" else card


@pytest.fixture
def device(new_device: Callable[[], Memory]) -> Memory:
    """A device."""
    return new_device()
