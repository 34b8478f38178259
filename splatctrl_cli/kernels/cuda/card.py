"""A CUDA card: memory over the driver, kernels and graphs over cuda-core."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from cuda.bindings import driver
from cuda.core import Device, LaunchConfig, launch

from splatctrl_cli.kernels.cuda.memory import Array, DeviceError, Graph, Launch
from splatctrl_cli.kernels.cuda.program import OLDEST, compiled

MANY = 20  # replays in a graph: to launch one costs the host as much as a small map's iteration takes


def _check(result: tuple[Any, ...]) -> Any:
    """The values of a driver call, or its error by name."""
    status, *values = result
    if status == driver.CUresult.CUDA_SUCCESS:
        return values[0] if values else None
    _, name = driver.cuGetErrorName(status)
    raise DeviceError(f"CUDA device: {name.decode() if name else status}")


class CudaDevice:
    """The card of that number as `Memory`; everything is queued on one stream."""

    def __init__(self, index: int = 0) -> None:
        try:
            _check(driver.cuInit(0))
        except RuntimeError as error:  # also where the driver's library is not there
            raise DeviceError(f"no CUDA device: {error}") from error
        count = _check(driver.cuDeviceGetCount())
        if index >= count:
            raise DeviceError(f"CUDA device {index}: expected one of {count}")
        self._device: Any = Device(index)
        self._device.set_current()
        self.capability = tuple(self._device.compute_capability)
        self.name: str = self._device.name
        if self.capability < OLDEST:
            raise DeviceError(f"{self.name}: compute capability {self.capability}, expected {OLDEST} or later")
        self._stream: Any = self._device.create_stream()
        self._code: Any = compiled(self.capability)
        self._handle = int(self._stream.handle)

    def allocate(self, num_bytes: int) -> int:
        """Memory of zeros."""
        address = int(_check(driver.cuMemAlloc(max(num_bytes, 1))))
        _check(driver.cuMemsetD8Async(address, 0, max(num_bytes, 1), self._handle))
        return address

    def free(self, address: int) -> None:
        """Give it back, after what is queued."""
        self.wait()
        _check(driver.cuMemFree(address))

    def write(self, address: int, values: Array) -> None:
        """Copy an array there, after what is queued."""
        values = np.ascontiguousarray(values)
        _check(driver.cuMemcpyHtoDAsync(address, values.ctypes.data, values.nbytes, self._handle))
        self.wait()  # the array may go

    def read(self, address: int, out: Array) -> None:
        """Wait for what is queued, and copy from there."""
        _check(driver.cuMemcpyDtoHAsync(out.ctypes.data, address, out.nbytes, self._handle))
        self.wait()

    def copy(self, target: int, source: int, num_bytes: int) -> None:
        """Copy within the device, after what is queued."""
        _check(driver.cuMemcpyDtoDAsync(target, source, num_bytes, self._handle))

    def wait(self) -> None:
        """Until what is queued is done."""
        _check(driver.cuStreamSynchronize(self._handle))

    def record(self, launches: Sequence[Launch]) -> "CudaGraph":
        """The launches as graphs: of one replay, and of MANY."""
        graphs = {}
        for count in (1, MANY):
            builder = self._device.create_graph_builder().begin_building()
            self._queue(builder, [*launches] * count)
            graphs[count] = builder.end_building().complete()
            graphs[count].upload(self._stream)
        return CudaGraph(graphs, self._stream)

    def queue(self, launches: Sequence[Launch]) -> None:
        """The launches one by one, for tools that look at each."""
        self._queue(self._stream, launches)

    def _queue(self, target: Any, launches: Sequence[Launch]) -> None:
        for one in launches:
            config = LaunchConfig(grid=one.grid, block=one.block)
            launch(target, config, self._code.get_kernel(one.kernel), *one.arguments)

    def seconds(self, graph: Graph, num_times: int) -> float:
        """Mean time of a replay, measured on the device."""
        before, after = (self._device.create_event({"timing_enabled": True}) for _ in range(2))
        self._stream.record(before)
        graph.run(num_times)
        self._stream.record(after)
        after.sync()
        return float(after - before) / 1000.0 / num_times


class CudaGraph:
    """Launches on the device's stream."""

    def __init__(self, graphs: dict[int, Any], stream: Any) -> None:
        self._graphs, self._stream = graphs, stream

    def run(self, num_times: int = 1) -> None:
        """Queue them, so many times."""
        for _ in range(num_times // MANY):
            self._graphs[MANY].launch(self._stream)
        for _ in range(num_times % MANY):
            self._graphs[1].launch(self._stream)
