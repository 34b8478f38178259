"""Interface of a device, its memory and its cards; launches are replayed as one graph."""

import ctypes
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

Array = NDArray[Any]
FIT, FIELD = "fit.cu", "field.cu"  # the sources of kernels


class DeviceError(RuntimeError):
    """The device is missing, unusable, or failed; `remedy`: the user's action."""

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(message)
        self.remedy = remedy


class OutOfMemory(DeviceError):  # noqa: N818  (as the driver names it)
    """Too little memory on the device."""


@dataclass(frozen=True, kw_only=True)
class Launch:
    """One kernel launch: grid (x, y, z), threads per block; addresses int, others np.int32."""

    kernel: str
    grid: tuple[int, int, int]
    block: int
    arguments: tuple[Any, ...]
    source: str = FIT


class Graph(Protocol):
    def run(self, num_times: int = 1) -> None:
        """Queue the launches `num_times`."""


class Memory(Protocol):
    """A device's memory; addresses are int. All but `allocate` and `available` follow queued work."""

    def allocate(self, num_bytes: int) -> int:
        """Address of zeroed memory. Raises OutOfMemory."""

    def available(self) -> int:
        """Number of free bytes."""

    def free(self, address: int) -> None:
        """Free memory."""

    def write(self, address: int, values: Array) -> None:
        """Copy an array there."""

    def read(self, address: int, out: Array) -> None:
        """Copy from there."""

    def copy(self, target: int, source: int, num_bytes: int) -> None:
        """Copy within the device."""

    def record(self, launches: Sequence[Launch]) -> Graph:
        """Record launches for replay."""


LIBRARY = "libcuda.so.1"
VERSION_FILE, CARDS = Path("/proc/driver/nvidia/version"), Path("/proc/driver/nvidia/gpus")
OLDEST = (7, 5)  # compute capability
OLDEST_CUDA = (13, 0)  # of the driver: older ones do not load code of NVRTC 13
OLDEST_DRIVER = 580  # the first for it
CAPABILITY = (75, 76)  # attributes of a device: major, minor


@dataclass(frozen=True, kw_only=True)
class Card:
    """A card by number, with its driver's version."""

    index: int
    name: str
    capability: tuple[int, int]
    driver: str


def num_cards() -> int:
    """Number of cards; none is woken, so that the process may still fork."""
    with suppress(OSError):
        return len([*CARDS.iterdir()])
    return 0


def usable_card(index: int = 0) -> Card:
    """Card of that number. Raises DeviceError if the driver or the card is unusable."""
    try:
        cuda: Any = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise DeviceError(f"no NVIDIA driver ({error})", remedy=f"install {OLDEST_DRIVER} or later") from None
    version, count = ctypes.c_int(), ctypes.c_int()
    if cuda.cuDriverGetVersion(ctypes.byref(version)) == 0 and _release(version.value) < OLDEST_CUDA:
        raise DeviceError(
            f"the driver is too old: for CUDA {_dotted(_release(version.value))}, expected {_dotted(OLDEST_CUDA)}",
            remedy=f"install {OLDEST_DRIVER} or later",
        )
    status = cuda.cuInit(0) or cuda.cuDeviceGetCount(ctypes.byref(count))
    if status or not count.value:
        reason = _error(cuda, status) if status else "it counts none"
        raise DeviceError(f"the driver finds no card ({reason})", remedy="see what nvidia-smi says of it")
    if index >= count.value:
        numbers = "cuda:0" if count.value == 1 else f"cuda:0 to cuda:{count.value - 1}"
        raise DeviceError(f"no such card: expected {numbers}", remedy="nvidia-smi -L lists them")
    name, parts = ctypes.create_string_buffer(256), [ctypes.c_int(), ctypes.c_int()]
    handle = ctypes.c_int()
    cuda.cuDeviceGet(ctypes.byref(handle), index)
    cuda.cuDeviceGetName(name, len(name), handle)
    for part, attribute in zip(parts, CAPABILITY, strict=True):
        cuda.cuDeviceGetAttribute(ctypes.byref(part), attribute, handle)
    card = Card(
        index=index,
        name=name.value.decode(errors="replace"),
        capability=(parts[0].value, parts[1].value),
        driver=_driver_version() or f"for CUDA {_dotted(_release(version.value))}",
    )
    if card.capability < OLDEST:
        raise DeviceError(
            f"{card.name} has compute capability {_dotted(card.capability)}, expected {_dotted(OLDEST)} or later",
            remedy="take a newer card",
        )
    return card


def _driver_version() -> str:
    with suppress(OSError):
        if match := re.search(r"\b\d{3,}\.\d+(\.\d+)?\b", VERSION_FILE.read_text()):
            return match[0]
    return ""


def _release(number: int) -> tuple[int, int]:
    return number // 1000, number % 1000 // 10


def _dotted(release: tuple[int, int]) -> str:
    return f"{release[0]}.{release[1]}"


def _error(cuda: Any, status: int) -> str:
    name = ctypes.c_char_p()
    cuda.cuGetErrorName(status, ctypes.byref(name))
    return name.value.decode() if name.value else str(status)
