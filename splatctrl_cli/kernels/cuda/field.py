"""Distance fields on a device, in grid cells and at points.

N spheres as C clusters (kernels/field.py), Q points, (X, Y, Z) cells.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.kernels import Float32, Float64, Int32
from splatctrl_cli.kernels.cuda.memory import FIELD, Array, Launch, Memory
from splatctrl_cli.kernels.field import LANES, Clusters, GridSpan, LogSumExp, Offsets

# As field.h and field_query.cuh lay them out.
CLUSTERS = np.dtype([("counts", "i4", 2), ("centers", "u8", 3), ("boxes", "u8", 6)], align=True)
GRID = np.dtype(
    [("place", "f8", 4), ("size", "i4", 3), ("planes", "i4", 2), ("mask", "u8"), ("num_threads", "i4")], align=True
)
TASK = np.dtype(
    [("spheres", CLUSTERS), ("offsets", "u8", 2), ("exact", "u8"), ("radius", "u8"), ("sign", "u8"),
     ("numbers", "f4", 4), ("grid", GRID), ("anchor", "f8", 3), ("points", "u8"), ("num_points", "i4"),
     ("out", "u8", 3)],
    align=True,
)  # fmt: skip
CHOICE = np.dtype(
    [("hard", "u8", 2), ("kernel", "u8", 2), ("out", "u8", 3), ("counts", "u8"), ("num", "i8"), ("margin", "f8"),
     ("resolution", "f4"), ("takes_least", "i4")],
    align=True,
)  # fmt: skip
WARP, WARPS, CHOOSE = 32, 4, 256  # threads of a warp, warps of a block, threads of a block that chooses
SUB_BLOCK = 4  # cells along each axis that a warp bakes
FAR = 3e38
HARD = "hard"


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Choice of distance: exact, with a kernel the smaller, is_single: the kernel's.

    resolution [m]: a larger excess of a kernel is counted.
    """

    kernel: str | None
    is_single: bool = False
    resolution: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Results in (X, Y, Z) cells or (Q,) points [m].

    bound: exact distance minus margin; entry: nearest sphere's; kernels: exact where undefined; counts: by kernel,
    cells where it is undefined, or exceeds the exact distance by more than `resolution`.
    """

    distance: Float32
    hard: Float32 | None
    gradient: Float32 | None
    bound: Float32 | None
    entry: Int32 | None
    kernels: Mapping[str, Float32]
    counts: Mapping[str, tuple[int, int]]


class DeviceField:
    """Fields of N spheres, kept on a device."""

    def __init__(
        self, device: Memory, spheres: Clusters, radii: Offsets, kernels: Mapping[str, LogSumExp], choice: Choice
    ) -> None:
        """kernels: by name. Raises OutOfMemory."""
        self.device, self.choice, self._kernels = device, choice, kernels
        self._rooms: dict[str, tuple[int, int]] = {}  # address and bytes
        self.launches: list[Launch] = []  # of the last answer
        base = np.zeros((), TASK)
        base["spheres"]["counts"] = (spheres.centers.shape[1] // LANES, 0)
        base["numbers"] = (0.0, 0.0, FAR, np.log(spheres.centers.shape[1]))
        for name, values in {"centers": spheres.centers, "boxes": spheres.boxes}.items():
            rows = 4 * values.shape[1] * np.arange(len(values))
            base["spheres"][name] = self._put(name, values) + rows.astype(np.uint64)
        self._tasks = {HARD: self._fill_offsets(base, HARD, radii)}
        for name, kernel in kernels.items():
            task = self._fill_offsets(base, name, kernel.offsets)
            task["exact"] = self._put(f"{name}.exact", kernel.exact)
            task["radius"] = self._put(f"{name}.radii", kernel.radii)
            task["numbers"][:2] = (kernel.length, kernel.tolerance)
            if kernel.sign is not None:
                task["sign"] = self._put(f"{name}.sign", kernel.sign)
                task["numbers"][2] = kernel.radii.max()
            self._tasks[name] = task

    def close(self) -> None:
        for address, _ in self._rooms.values():
            self.device.free(address)
        self._rooms = {}

    def bake(self, span: GridSpan, wanted: Collection[str], *, margin: float = 0.0) -> Answers:
        """`wanted` (fields of `Answers`) in a span; margin [m]: of bound."""
        grid = np.zeros((), GRID)
        grid["place"], grid["size"], grid["planes"] = (*span.origin, span.voxel), span.shape, (span.first, span.last)
        shape = span.shape_of_channel
        num_warps = int(np.prod([-(-n // SUB_BLOCK) for n in shape]))
        return self._answered("bake", {"grid": grid}, shape, num_warps, wanted, margin)

    def query(self, points: Float64, anchor: Float64, wanted: Collection[str] = ("gradient",)) -> Answers:
        """`wanted` at points (Q, 3), Q > 0, in anchor's (3,) frame."""
        address = self._put("points", points)
        arguments: dict[str, Array | int] = {"points": address, "num_points": len(points), "anchor": anchor}
        return self._answered("query", arguments, (len(points),), len(points), wanted, 0.0)

    def _answered(
        self, what: str, query: Mapping[str, Array | int], shape: tuple[int, ...], num_warps: int,
        wanted: Collection[str], margin: float,
    ) -> Answers:  # fmt: skip
        num, launches = int(np.prod(shape)), []
        places = {name: (self._room(f"{name}.distance", 4 * num), 0) for name in self._tasks}
        if "gradient" in wanted:
            for name in {HARD, self.choice.kernel or HARD}:
                places[name] = (places[name][0], self._room(f"{name}.gradient", 12 * num))
        entry = self._room("entry", 4 * num) if "entry" in wanted else 0
        for name, base in self._tasks.items():
            task = base.copy()
            for key, value in query.items():
                task[key] = value
            task["out"] = (*places[name], entry if name == HARD else 0)
            kernel = HARD if name == HARD else "matern" if self._kernels[name].is_matern else "gaussian"
            launches.append(self._launch(f"{what}_{kernel}", f"{name}.task", task, num_warps, WARPS, WARP * WARPS))
        self.launches = [*launches, *self._choices(num, places, margin if "bound" in wanted else None)]
        self.device.record(self.launches).run()
        counts = {name: self._read(f"{name}.counts", (2,), np.int32).tolist() for name in self._kernels}

        def read(
            name: str, key: str, more: tuple[int, ...] = (), kind: type[np.generic] = np.float32
        ) -> Array | None:
            return self._read(name, (*shape, *more), kind) if key in wanted else None

        return Answers(
            distance=self._read("distance", shape, np.float32),
            hard=read(f"{HARD}.distance", HARD),
            gradient=read(f"{HARD}.gradient", "gradient", (3,)),
            bound=read("bound", "bound"),
            entry=read("entry", "entry", (), np.int32),
            kernels={
                name: self._read(f"{name}.distance", shape, np.float32) for name in self._kernels if name in wanted
            },
            counts={name: (first, second) for name, (first, second) in counts.items()},
        )

    def _choices(self, num: int, places: Mapping[str, tuple[int, int]], margin: float | None) -> list[Launch]:
        task = np.zeros((), CHOICE)
        task["hard"], task["num"], task["margin"] = places[HARD], num, margin or 0.0
        task["resolution"], task["takes_least"] = self.choice.resolution, not self.choice.is_single
        bound = 0 if margin is None else self._room("bound", 4 * num)
        task["out"] = (self._room("distance", 4 * num), places[HARD][1], bound)
        launches = []
        for name in self._kernels:
            of_kernel = task.copy()
            of_kernel["kernel"], of_kernel["counts"] = (
                places[name],
                self._put(f"{name}.counts", np.zeros(2, np.int32)),
            )
            launches.append(self._launch("settle", f"{name}.settled", of_kernel, num, CHOOSE, CHOOSE))
        if self.choice.kernel is not None:
            task["kernel"] = places[self.choice.kernel]
        return [self._launch("choose", "choice", task, num, CHOOSE, CHOOSE), *launches]

    def _launch(self, kernel: str, name: str, task: Array, num: int, per_block: int, threads: int) -> Launch:
        grid = (-(-num // per_block), 1, 1)
        return Launch(kernel=kernel, grid=grid, block=threads, arguments=(self._put(name, task),), source=FIELD)

    def _fill_offsets(self, base: Array, name: str, offsets: Offsets) -> Array:
        task = base.copy()
        task["offsets"] = (self._put(f"{name}.offsets", offsets.values), self._put(f"{name}.maxima", offsets.maxima))
        return task

    def _room(self, name: str, num_bytes: int) -> int:
        address, size = self._rooms.get(name, (0, 0))
        if size < num_bytes:
            if address:
                self.device.free(address)
                del self._rooms[name]
            address = self.device.allocate(num_bytes)
            self._rooms[name] = (address, num_bytes)
        return address

    def _put(self, name: str, values: Array) -> int:
        address = self._room(name, max(values.nbytes, 1))
        self.device.write(address, values)
        return address

    def _read(self, name: str, shape: tuple[int, ...], kind: type[np.generic]) -> Array:
        out = np.empty(shape, kind)
        self.device.read(self._rooms[name][0], out)
        return out
