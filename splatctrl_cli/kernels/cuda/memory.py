"""Interface of a device: memory, and launches replayed as one graph."""

from collections.abc import Sequence
from dataclasses import dataclass
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
