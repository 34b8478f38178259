"""A CUDA card, over its driver and cuda-core; NVRTC compiles its kernels, cached on disk."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from cuda.bindings import driver
from cuda.core import Device, LaunchConfig, ObjectCode, Program, ProgramOptions, launch
from cuda.core.utils import FileStreamProgramCache, make_program_cache_key

from splatctrl_cli.kernels.cuda.memory import FIT, Array, Card, DeviceError, Graph, Launch, OutOfMemory, usable_card

HERE = Path(__file__).parent
FOLDERS = (HERE / "src", HERE / "include", HERE.parent / "src")  # as #include looks through them


@cache
def source_digest() -> bytes:
    digest = hashlib.sha256()
    for folder in FOLDERS:
        for path in sorted(p for p in folder.iterdir() if p.suffix in {"", ".h", ".cu", ".cuh"} and p.is_file()):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.digest()


def compiled(capability: tuple[int, int], cache_folder: Path | None = None, *, source: str = FIT) -> Any:
    """Machine code of a source for a compute capability, cached if writable."""
    options = ProgramOptions(
        name=source, arch=f"sm_{capability[0]}{capability[1]}", std="c++17", include_path=[str(f) for f in FOLDERS]
    )
    code = (HERE / "src" / source).read_text()
    key = make_program_cache_key(
        code=code, code_type="c++", options=options, target_type="cubin", extra_digest=source_digest()
    )
    try:
        store = FileStreamProgramCache(cache_folder)
        known = store.get(key)
    except OSError:
        return Program(code, "c++", options).compile("cubin")
    if known is not None:
        return ObjectCode.from_cubin(known)
    cubin = Program(code, "c++", options).compile("cubin")
    with suppress(OSError):
        store[key] = cubin
    return cubin


MANY = 20  # replays in a graph: a launch costs the host as much as a small map's iteration


def _check(result: tuple[Any, ...]) -> Any:
    status, *values = result
    if status == driver.CUresult.CUDA_SUCCESS:
        return values if len(values) > 1 else values[0] if values else None
    _, name = driver.cuGetErrorName(status)
    raise _fault(name.decode() if name else str(status))


def _fault(what: str) -> DeviceError:
    return (OutOfMemory if "OUT_OF_MEMORY" in what else DeviceError)(what)


@contextmanager
def _named_faults() -> Iterator[None]:
    try:
        yield
    except DeviceError:
        raise
    except Exception as error:
        raise _fault(str(error)) from error


class CudaDevice:
    """A card as `Memory`, with one stream. Raises DeviceError if unusable."""

    def __init__(self, card: Card | None = None, *, source: str = FIT) -> None:
        """source: kernels to compile now; others compile at first launch."""
        card = card or usable_card()
        self.name, self.capability = card.name, card.capability
        with _named_faults():
            self._device: Any = Device(card.index)
            self._device.set_current()
            self._stream: Any = self._device.create_stream()
            self._codes: dict[str, Any] = {source: compiled(self.capability, source=source)}
        self._handle = int(self._stream.handle)

    def available(self) -> int:
        free, _ = _check(driver.cuMemGetInfo())
        return int(free)

    def allocate(self, num_bytes: int) -> int:
        address = int(_check(driver.cuMemAlloc(max(num_bytes, 1))))
        _check(driver.cuMemsetD8Async(address, 0, max(num_bytes, 1), self._handle))
        return address

    def free(self, address: int) -> None:
        self.wait()
        _check(driver.cuMemFree(address))

    def write(self, address: int, values: Array) -> None:
        values = np.ascontiguousarray(values)
        _check(driver.cuMemcpyHtoDAsync(address, values.ctypes.data, values.nbytes, self._handle))
        self.wait()  # the array may be freed

    def read(self, address: int, out: Array) -> None:
        _check(driver.cuMemcpyDtoHAsync(out.ctypes.data, address, out.nbytes, self._handle))
        self.wait()

    def copy(self, target: int, source: int, num_bytes: int) -> None:
        _check(driver.cuMemcpyDtoDAsync(target, source, num_bytes, self._handle))

    def wait(self) -> None:
        """Wait for queued work."""
        _check(driver.cuStreamSynchronize(self._handle))

    def record(self, launches: Sequence[Launch]) -> "CudaGraph":
        """Record the launches as two graphs: of one replay, and of MANY."""
        graphs = {}
        with _named_faults():
            for count in (1, MANY):
                builder = self._device.create_graph_builder().begin_building()
                self.queue([*launches] * count, builder)
                graphs[count] = builder.end_building().complete()
                graphs[count].upload(self._stream)
        return CudaGraph(graphs, self._stream)

    def queue(self, launches: Sequence[Launch], target: Any = None) -> None:
        """Queue launches singly, for inspection, or in the `target` of a graph."""
        for one in launches:
            config = LaunchConfig(grid=one.grid, block=one.block)
            if one.source not in self._codes:
                self._codes[one.source] = compiled(self.capability, source=one.source)
            launch(target or self._stream, config, self._codes[one.source].get_kernel(one.kernel), *one.arguments)

    def seconds(self, graph: Graph, num_times: int) -> float:
        """Mean time of a replay on the device."""
        before, after = (self._device.create_event({"timing_enabled": True}) for _ in range(2))
        self._stream.record(before)
        graph.run(num_times)
        self._stream.record(after)
        after.sync()
        return float(after - before) / 1000.0 / num_times


class CudaGraph:
    def __init__(self, graphs: dict[int, Any], stream: Any) -> None:
        self._graphs, self._stream = graphs, stream

    def run(self, num_times: int = 1) -> None:
        with _named_faults():
            for _ in range(num_times // MANY):
                self._graphs[MANY].launch(self._stream)
            for _ in range(num_times % MANY):
                self._graphs[1].launch(self._stream)
