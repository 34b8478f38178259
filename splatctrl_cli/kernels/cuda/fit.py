"""Iterations of the fit on a device, which keeps splats, Adam's state and views.

N splats, (H, W) pixels, K tiles of 16 x 16 pixels. Lists that are too short grow.
"""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from splatctrl_cli.kernels import Float32, Float64
from splatctrl_cli.kernels.cuda.memory import Array, DeviceError, Graph, Launch, Memory, OutOfMemory
from splatctrl_cli.kernels.raster import LossTerms, LossWeights, Moments, OptimiserSettings, TargetView

# As fit.h lays them out.
CAMERA = np.dtype([("floats", "f4", 4), ("size", "i4", 2), ("T_camera_world", "f4", 12)])
VIEW = np.dtype([("camera", CAMERA), ("per", "f4", 2), ("images", "u8", 3)])
RUN = np.dtype(
    [("settings", "f4", 10), ("seed", "u8"), ("weights", "f4", 4), ("normalised", "i4"), ("background", "f4", 3)]
)
COUNTERS = np.dtype([(n, "i4") for n in ("next", "now", "num_parts", "most_parts", "longest_list")])
TILE, NUM_SUMS, PATCH, NUM_TERMS = 16, 10, 32, 5
PROJECT_LANES = 4  # threads of a splat
PROJECT, BLEND, LOSS, BACKWARD, STEP = 128, 128, 128, 64, 128  # threads in a block
MOST_SPLATS = 1 << 24
LIST_CAPACITY, SPLAT_TILES = 512, 16  # entries per tile's list and tiles per splat, at first
LEAST_TABLE = 1 << 16  # bytes, so that graphs outlive a longer schedule
NUM_TABLES = 5  # of the run, the views, the schedule, the counters and the terms
STATE = {"parameters": 32, "first": 32, "second": 32, "num_steps": 4}  # bytes of a splat
WORK = {"gradients": 32, "splats": 64, "first_parts": 4, "num_parts": 4}
PIXEL = {"planes": 20, "plane_gradients": 20, "maps": 36}  # bytes of a pixel, for all views of a size
LIST_ENTRY = {"keys": 8, "list_parts": 4, "entries": 8}
IMAGE_BYTES = 8  # of a pixel of a view: colour, depth, counted


@dataclass(frozen=True, kw_only=True)
class _DeviceView:
    target: TargetView
    row: Array  # one VIEW
    num_values: float
    num_depths: float


def camera_row(camera: Float64) -> Array:
    """`pack_camera` camera as the kernels read it."""
    row = np.zeros((), CAMERA)
    row["floats"], row["size"], row["T_camera_world"] = camera[:4], camera[4:6], camera[6:18]
    return row


def bytes_needed(
    num_splats: int,
    sizes: Sequence[tuple[int, int]],
    list_capacity: int = LIST_CAPACITY,
    splat_tiles: float = SPLAT_TILES,
) -> int:
    """Bytes of a fit of N splats to views of `sizes` (H, W)."""
    splats = (sum(STATE.values()) * 2 + sum(WORK.values()) + 4 * NUM_SUMS * splat_tiles) * num_splats
    tiles = [-(-height // TILE) * -(-width // TILE) for height, width in set(sizes)]
    pixels = sum(sum(PIXEL.values()) * height * width for height, width in set(sizes))
    images = sum(IMAGE_BYTES * height * width for height, width in sizes)
    return round(
        NUM_TABLES * LEAST_TABLE
        + splats
        + pixels
        + images
        + sum(tiles) * (8 + sum(LIST_ENTRY.values()) * list_capacity)
    )


class DeviceFit:
    """Optimiser of N splats on a device, for views of `sizes` (H, W) at first.

    Raises OutOfMemory, which names what would fit.
    """

    def __init__(
        self,
        device: Memory,
        num_splats: int,
        sizes: Sequence[tuple[int, int]] = (),
        *,
        list_capacity: int = LIST_CAPACITY,
        part_capacity: int = 0,
    ) -> None:
        if num_splats >= MOST_SPLATS:
            raise DeviceError(f"num_splats: expected less than {MOST_SPLATS}, got {num_splats}")
        self.device, self.num_splats = device, num_splats
        self.views: list[_DeviceView] = []
        self.list_capacity, self.part_capacity = list_capacity, part_capacity or SPLAT_TILES * max(num_splats, 256)
        self._addresses: dict[str, int] = {}
        self._sizes: dict[str, int] = {}
        self._images: dict[int, int] = {}  # bytes by address
        self._graphs: dict[tuple[int, int, str], Graph] = {}
        self.expect(sizes)
        for name, size in {**STATE, **{f"{name}_before": size for name, size in STATE.items()}, **WORK}.items():
            self._room(name, size * num_splats)
        self._room("counters", COUNTERS.itemsize)
        self._room("run", RUN.itemsize)
        self._room("parts", 4 * NUM_SUMS * self.part_capacity)

    def close(self) -> None:
        for address in [*self._addresses.values(), *self._images]:
            self.device.free(address)
        self._addresses, self._images, self._sizes = {}, {}, {}

    def expect(self, sizes: Sequence[tuple[int, int]]) -> None:
        """Expect views of sizes (H, W). Raises OutOfMemory if they do not fit."""
        self._expected = list(sizes)
        if self._needed(self.num_splats) > self._usable():
            raise self._too_large()

    def put(self, parameters: Float32, moments: Moments | None = None) -> None:
        """Write splats (N, 8), and Adam's state if given."""
        state = {"parameters": parameters} if moments is None else self._state(parameters, moments)
        for name, values in state.items():
            self.device.write(self._addresses[name], values)

    def take(self, parameters: Float32, moments: Moments) -> None:
        """Read splats (N, 8) and Adam's state into these arrays."""
        for name, values in self._state(parameters, moments).items():
            self.device.read(self._addresses[name], values)

    def add_view(self, camera: Float64, target: TargetView) -> int:
        """Copy a view to the device; return its number for `run`."""
        num_values = 3.0 * max(int(np.count_nonzero(target.counted)), 1)
        num_depths = int(np.count_nonzero((target.depth > 0) & (target.counted != 0)))
        images = [self._image(values) for values in (target.color, target.depth.astype(np.float32), target.counted)]
        row = np.zeros((), VIEW)
        row["camera"] = camera_row(camera)
        row["per"] = 1.0 / num_values, 1.0 / num_depths if num_depths else 0.0
        row["images"] = images
        self.views.append(
            _DeviceView(target=target, row=row, num_values=num_values, num_depths=float(max(num_depths, 1)))
        )
        return len(self.views) - 1

    def number_of(self, camera: Float64, target: TargetView) -> int:
        """Number of a view, added if its target is new."""
        number = next((k for k, view in enumerate(self.views) if view.target is target), None)
        return self.add_view(camera, target) if number is None else number

    def keep(self, targets: Sequence[TargetView]) -> None:
        """Free other views' images; view numbers change."""
        ids = {id(target) for target in targets}
        gone = [view for view in self.views if id(view.target) not in ids]
        self.views = [view for view in self.views if id(view.target) in ids]
        for address in [int(address) for view in gone for address in view.row["images"]]:
            self.device.free(address)
            del self._images[address]

    def run(
        self, schedule: Sequence[int], weights: LossWeights, settings: OptimiserSettings, seed: int
    ) -> dict[int, LossTerms]:
        """Run an iteration on each scheduled view; return their last losses.

        Iteration k draws noise with `seed` + k.
        """
        if not schedule:
            return {}
        for name in STATE:
            self.device.copy(self._addresses[f"{name}_before"], self._addresses[name], self._sizes[name])
        while True:
            self.rewind(schedule, weights, settings, seed)
            for (height, width), group in groupby(schedule, lambda k: self.views[k].target.depth.shape):
                self._graph(height, width, "step").run(len(list(group)))
            if self._fits():
                return self._terms(schedule)
            for name in STATE:
                self.device.copy(self._addresses[name], self._addresses[f"{name}_before"], self._sizes[name])

    def planes(self, view: int) -> Float32:
        """Planes (5, H, W) of a view, as in `kernels.raster`."""
        height, width = self.views[view].target.depth.shape
        while True:
            self.rewind([view], None, None, 0)
            self._graph(height, width, "render").run()
            if self._fits():
                return self.read_image("planes", view, 5)

    def read_image(self, name: str, view: int, channels: int) -> Float32:
        """Read `planes`, `plane_gradients` or `maps` (channels, H, W), after the last launch."""
        height, width = self.views[view].target.depth.shape
        return self._read(f"{name} {height} {width}", (channels, height, width))

    def _state(self, parameters: Float32, moments: Moments) -> dict[str, Array]:
        return {
            "parameters": parameters, "first": moments.first, "second": moments.second,
            "num_steps": moments.num_steps,
        }  # fmt: skip

    def _room(self, name: str, num_bytes: int) -> int:
        if self._sizes.get(name, -1) < num_bytes:
            if name in self._addresses:
                self.device.free(self._addresses.pop(name))
            self._sizes.pop(name, None)
            self._addresses[name] = self._allocate(num_bytes)
            self._sizes[name] = num_bytes
            self._graphs = {}
        return self._addresses[name]

    def _read(self, name: str, shape: tuple[int, ...], kind: Any = np.float32) -> Array:
        out = np.empty(shape, kind)
        self.device.read(self._addresses[name], out)
        return out

    def _image(self, values: Array) -> int:
        address = self._allocate(values.nbytes)
        self._images[address] = values.nbytes
        self.device.write(address, values)
        return address

    def _allocate(self, num_bytes: int) -> int:
        try:
            return self.device.allocate(num_bytes)
        except OutOfMemory:
            raise self._too_large() from None

    def _needed(self, num_splats: int) -> int:
        tiles = self.part_capacity / max(self.num_splats, 1)
        return bytes_needed(num_splats, self._expected, self.list_capacity, tiles)

    def _usable(self) -> int:
        return self.device.available() + sum(self._sizes.values()) + sum(self._images.values())

    def _too_large(self) -> OutOfMemory:
        usable, fixed = self._usable(), self._needed(0)
        each = (self._needed(self.num_splats) - fixed) / max(self.num_splats, 1)
        most = min(int((usable - fixed) / each), self.num_splats // 2)
        views = f" and {len(self._expected)} views" if self._expected else ""
        return OutOfMemory(
            f"out of memory: {self.num_splats} splats{views} take {self._needed(self.num_splats) / 1e6:.0f} MB,"
            f" {usable / 1e6:.0f} MB are free",
            remedy=f"a budget of {_rounded_down(most)} splats would fit" if most > 0 else "take smaller images",
        )

    def rewind(
        self, schedule: Sequence[int], weights: LossWeights | None, settings: OptimiserSettings | None, seed: int = 0
    ) -> None:
        """Set a schedule before launches; weights and settings None: for rendering only."""
        run = np.zeros((), RUN)
        if settings is not None and weights is not None:
            w = weights
            run["settings"] = astuple(settings)
            run["seed"] = seed
            run["weights"] = w.dssim, w.color, w.depth, w.opacity
            run["normalised"], run["background"] = w.normalised, w.background
        views = np.array([view.row for view in self.views], VIEW)
        for name, values in {
            "run": run, "views": views, "schedule": np.asarray(schedule, np.int32),
            "counters": np.zeros((), COUNTERS),
        }.items():  # fmt: skip
            self.device.write(self._room(name, max(values.nbytes, LEAST_TABLE)), values)
        self._room("terms", max(8 * NUM_TERMS * len(self.views), LEAST_TABLE))

    def _fits(self) -> bool:
        counters = self._read("counters", (), COUNTERS)
        longest, most = int(counters["longest_list"]), int(counters["most_parts"])
        if longest:
            self.list_capacity = 1 << longest.bit_length()
        if most:
            self.part_capacity = most + most // 2
            self._room("parts", 4 * NUM_SUMS * self.part_capacity)
        if longest or most:
            self._graphs = {}
        return not longest and not most

    def _terms(self, schedule: Sequence[int]) -> dict[int, LossTerms]:
        sums = self._read("terms", (len(self.views), NUM_TERMS), np.float64)
        terms = {}
        for k in dict.fromkeys(schedule):
            view, (l1, ssim, depth, transmittance, squared) = self.views[k], sums[k].tolist()
            terms[k] = LossTerms(
                l1=l1 / view.num_values,
                dssim=(3.0 * view.target.depth.size - ssim) / view.num_values,
                depth=depth / view.num_depths,
                transmittance=transmittance / view.num_depths,
                squared=squared / view.num_values,
            )
        return terms

    def _graph(self, height: int, width: int, what: str) -> Graph:
        gradients = self._addresses["gradients"] if what == "gradients" else 0
        launches = self.launches(height, width, gradients)
        known = self._graphs.get((height, width, what))
        if known is None:
            known = self.device.record(launches[:2] if what == "render" else launches)
            self._graphs[height, width, what] = known
        return known

    def launches(self, height: int, width: int, gradients: int = 0) -> list[Launch]:
        """Launches of one iteration on a view; gradients: their address, or 0 to step."""
        at: Callable[[str], int] = self._addresses.__getitem__
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        patches_x, patches_y = -(-width // PATCH), -(-height // PATCH)
        tiles, patches, pixels = tiles_x * tiles_y, patches_x * patches_y, height * width

        def image(name: str, num_bytes: int) -> int:
            return self._room(f"{name} {height} {width}", num_bytes)

        lengths, num_entries = image("list_lengths", 4 * tiles), image("num_entries", 4 * tiles)
        slots = tiles * self.list_capacity
        keys, list_parts, entries = (image(name, size * slots) for name, size in LIST_ENTRY.items())
        planes, plane_gradients, maps = (image(name, size * pixels) for name, size in PIXEL.items())
        ssim, errors = image("patch_ssim", 12 * patches), image("patch_errors", 24 * patches)
        depths = image("patch_depths", 8 * patches)
        n, h, w = np.int32(self.num_splats), np.int32(height), np.int32(width)
        capacity, most_parts = np.int32(self.list_capacity), np.int32(self.part_capacity)
        per_patch = (patches_x, patches_y, 3)
        now = (at("counters"), at("schedule"), at("views"))
        run = at("run")
        return [
            Launch(
                kernel="project", grid=(-(-self.num_splats * PROJECT_LANES // PROJECT), 1, 1), block=PROJECT,
                arguments=(
                    *now, at("parameters"), n, at("splats"), at("first_parts"), at("num_parts"), lengths, keys,
                    list_parts, capacity, most_parts,
                ),
            ),
            Launch(
                kernel="blend", grid=(tiles, 1, 1), block=BLEND,
                arguments=(
                    at("counters"), at("splats"), lengths, keys, list_parts, capacity, most_parts, entries,
                    num_entries, w, h, planes,
                ),
            ),
            Launch(
                kernel="ssim_derivatives", grid=per_patch, block=LOSS,
                arguments=(*now, run, planes, w, h, maps, ssim),
            ),
            Launch(
                kernel="loss_gradient", grid=per_patch, block=LOSS,
                arguments=(*now, run, planes, maps, w, h, plane_gradients, errors, depths),
            ),
            Launch(
                kernel="blend_backward", grid=(tiles, 1, 1), block=BACKWARD,
                arguments=(
                    run, at("splats"), entries, num_entries, capacity, planes, plane_gradients, w, h, at("parts"),
                ),
            ),
            Launch(
                kernel="step", grid=(-(-self.num_splats * 8 // STEP) + 1, 1, 1), block=STEP,
                arguments=(
                    *now, run, at("splats"), at("first_parts"), at("num_parts"), at("parts"), at("parameters"),
                    at("first"), at("second"), at("num_steps"), n, ssim, errors, depths, np.int32(patches),
                    at("terms"), gradients,
                ),
            ),
        ]  # fmt: skip


def _rounded_down(number: int) -> int:
    digits: int = 10 ** (len(str(number)) - 1)
    return number // digits * digits
