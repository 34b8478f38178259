"""The kernels on the processor: `device.h`, built with the compiler that builds the package."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
import pytest

import splatctrl_cli.kernels
from splatctrl_cli.kernels.cuda.memory import Array, Launch, OutOfMemory

HERE = Path(__file__).parent
KERNELS = Path(splatctrl_cli.kernels.__file__).parent


@cache
def library() -> ctypes.CDLL:
    """Built once for its sources, whatever the process; a test is skipped where there is no compiler."""
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        pytest.skip("no C++ compiler to build the kernels for the processor with")
    folders = [HERE, KERNELS / "cuda" / "src", KERNELS / "src"]
    words = [compiler, "-std=c++17", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-Wl,-Bsymbolic", "-w"]
    sources = (path.read_bytes() for folder in folders for path in sorted(folder.glob("*.[ch]*")))
    recipe = sha256(b"".join([*map(str.encode, words), *sources])).hexdigest()[:16]
    target = Path(gettempdir()) / f"splatctrl_emulator_{os.getuid()}_{recipe}.so"
    if not target.exists():
        made = target.with_suffix(f".{os.getpid()}")
        includes = [f"-I{folder}" for folder in folders]
        subprocess.run([*words, *includes, "-o", str(made), str(HERE / "emulator.cpp")], check=True)
        made.replace(target)
    return ctypes.CDLL(str(target))


class EmulatedDevice:
    """`Memory` of the processor, of at most `limit` bytes; nothing is queued, launches run at once."""

    def __init__(self, *, backwards: bool = False, limit: int = 1 << 40) -> None:
        self.backwards, self.limit = backwards, limit
        self.held: dict[int, Array] = {}
        self.sizes: dict[int, int] = {}

    def available(self) -> int:
        return self.limit - sum(self.sizes.values())

    def allocate(self, num_bytes: int) -> int:
        if num_bytes > self.available():
            raise OutOfMemory("CUDA_ERROR_OUT_OF_MEMORY")
        memory = np.zeros(max(num_bytes, 1) // 64 * 8 + 16, np.uint64)  # aligned by numpy to 16; the rest by hand
        address = -(-memory.ctypes.data // 64) * 64
        self.held[address], self.sizes[address] = memory, num_bytes
        return address

    def free(self, address: int) -> None:
        del self.held[address], self.sizes[address]

    def write(self, address: int, values: Array) -> None:
        values = np.ascontiguousarray(values)
        ctypes.memmove(address, values.ctypes.data, values.nbytes)

    def read(self, address: int, out: Array) -> None:
        ctypes.memmove(out.ctypes.data, address, out.nbytes)

    def copy(self, target: int, source: int, num_bytes: int) -> None:
        ctypes.memmove(target, source, num_bytes)

    def record(self, launches: Sequence[Launch]) -> "EmulatedGraph":
        return EmulatedGraph(launches, self.backwards)


class EmulatedGraph:
    def __init__(self, launches: Sequence[Launch], backwards: bool) -> None:
        self.launches, self.backwards = launches, backwards

    def run(self, num_times: int = 1) -> None:
        library().set_backwards(int(self.backwards))
        for _ in range(num_times):
            for one in self.launches:
                self._launch(one)

    def _launch(self, one: Launch) -> None:
        values: list[Any] = [
            ctypes.c_int32(int(a)) if isinstance(a, np.int32) else ctypes.c_void_p(a) for a in one.arguments
        ]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(v) for v in values))
        grid = (ctypes.c_int * 3)(*one.grid)
        assert library().launch(one.kernel.encode(), grid, one.block, pointers), one.kernel
