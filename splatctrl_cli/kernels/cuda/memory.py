"""What the engine needs of a device: memory, and lists of kernel launches that are replayed as one graph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

Array = NDArray[Any]
FIT, FIELD = "fit.cu", "field.cu"  # the sources of kernels


class DeviceError(RuntimeError):
    """The device is not there, cannot be used, or has failed; `remedy` says what to do about it."""

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(message)
        self.remedy = remedy


class OutOfMemory(DeviceError):  # noqa: N818  (as the driver names it)
    """The device has no room for what was asked."""


@dataclass(frozen=True, kw_only=True)
class Launch:
    """One kernel of a source: blocks in the grid (x, y, z), threads in a block; addresses are int, other arguments
    np.int32.
    """

    kernel: str
    grid: tuple[int, int, int]
    block: int
    arguments: tuple[Any, ...]
    source: str = FIT


class Graph(Protocol):
    """Launches that run one after the other."""

    def run(self, num_times: int = 1) -> None:
        """Queue them, so many times."""


class Memory(Protocol):
    """What the engine needs of a device; addresses are int."""

    def allocate(self, num_bytes: int) -> int:
        """Memory of zeros. Raises OutOfMemory."""

    def available(self) -> int:
        """Bytes that are free."""

    def free(self, address: int) -> None:
        """Give it back."""

    def write(self, address: int, values: Array) -> None:
        """Copy an array there."""

    def read(self, address: int, out: Array) -> None:
        """Wait for what is queued, and copy from there."""

    def copy(self, target: int, source: int, num_bytes: int) -> None:
        """Copy within the device, after what is queued."""

    def record(self, launches: Sequence[Launch]) -> Graph:
        """Launches to be replayed."""
