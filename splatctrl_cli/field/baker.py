"""Baking of a distance field by planes, and the blocks that edited splats change."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import FieldConfig, OccupancyConfig
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import KERNEL_OF, KERNELS, PROBABILITIES, SphereField, device_field
from splatctrl_cli.field.grid_cells import HALF_DIAGONAL, RESOLUTION, GridLayout, observed_planes
from splatctrl_cli.formats.grid.grid_format import CHANNELS
from splatctrl_cli.kernels import native, num_threads
from splatctrl_cli.kernels.cuda.memory import Memory
from splatctrl_cli.kernels.field import BLOCK, GridSpan, bake_hard
from splatctrl_cli.records import Bool, Float32, Float64, Index, SplatSet, UInt8
from splatctrl_cli.voxels import OccupancyGrid

DEFAULT_CHANNELS = ("sdf", "gradient", "bound", "observed")

Planes = dict[str, NDArray[np.generic]]
_Baked = tuple[Planes, NDArray[np.int32] | None]
T = TypeVar("T", bound=np.generic)


class Baker:
    """Channels of a field over splats at the cells of `layout`.

    Planes and threads do not change the bytes. counts: ``se_without_value``, cells with exact distance instead;
    ``se_over_estimates``, cells above the exact distance by over `RESOLUTION`; likewise gpdf.
    """

    def __init__(
        self,
        splats: SplatSet,
        layout: GridLayout,
        config: FieldConfig,
        *,
        channels: Collection[str] = DEFAULT_CHANNELS,
        occupancy: OccupancyGrid | None = None,
        thresholds: OccupancyConfig | None = None,
        threads: int = 0,
        device: Memory | None = None,
    ) -> None:
        """device: a card that computes instead of the processor; it supports no masks.

        Raises UsageError for unknown channels or without sdf, NotEvaluableError without splats, InputError for
        invalid ones.
        """
        unknown = [name for name in channels if name not in CHANNELS]
        refuse_if(
            unknown or "sdf" not in channels,
            f"channels: expected sdf and some of {', '.join(CHANNELS)}, got {', '.join(channels)}",
            error=UsageError,
        )
        self.layout, self.config, self.threads = layout, config, threads
        self.channels = tuple(name for name in CHANNELS if name in channels)
        self.labels = splats.labels
        self.spheres = Spheres.of(splats.centers, splats.radii, layout.box)
        self.exact = SphereField(self.spheres, threads=threads)
        self.kernel_name = KERNEL_OF[config.distance]
        names = {self.kernel_name, *channels}
        kinds = {name: kind for name, kind in KERNELS.items() if name in names}
        self.kernels = {name: kind(self.spheres, config, threads=threads) for name, kind in kinds.items()}
        has_probability = "probability" in channels
        self.probability = (
            PROBABILITIES[config.probability](self.spheres, config, threads) if has_probability else None
        )
        self.counts = {f"{name}_{what}": 0 for name in self.kernels for what in ("without_value", "over_estimates")}
        self._occupancy, self._thresholds = occupancy, thresholds or OccupancyConfig()
        self.on_device = None if device is None else device_field(self.spheres, self.kernels, config, device)

    def close(self) -> None:
        if self.on_device is not None:
            self.on_device.close()

    @property
    def bound_margin(self) -> float:
        """Exact distance at a cell's centre minus `bound` [m].

        Half a cell's diagonal (hard is 1-Lipschitz), plus float32 rounding.
        """
        box = self.layout.box
        reach = np.abs(self.spheres.clusters.centers[:, self.spheres.is_point.view(np.bool_)]).max()
        size = float(np.abs(box.upper - box.lower).max()) + float(reach)
        return HALF_DIAGONAL * self.layout.voxel + 1e-6 + 1e-6 * size

    def allocate(self, num_planes: int) -> Planes:
        """Arrays for the channels of `num_planes` x-planes."""
        cells = (num_planes, *self.layout.shape[1:])
        return {name: np.empty(CHANNELS[name].shape(cells), CHANNELS[name].dtype) for name in self.channels}

    def bake(self, first: int, last: int, out: Planes, mask: UInt8 | None = None) -> None:
        """Fill `out` with x-planes [first, last), whole blocks of 8 cells.

        mask (blocks of the grid): zero where `out` keeps its values.
        """
        per_plane = 40 * self.layout.shape[1] * self.layout.shape[2]
        step = BLOCK * max(1, (64 << 20) // (BLOCK * per_plane))  # bytes besides the channels
        for begin in range(first, last, step):
            end = min(begin + step, last)
            part = {name: values[begin - first : end - first] for name, values in out.items()}
            self._bake_planes(begin, end, part, mask)

    def span(self, first: int, last: int, mask: UInt8 | None = None) -> GridSpan:
        """Cells of x-planes [first, last), in the spheres' frame."""
        return GridSpan(
            origin=self.layout.origin - self.spheres.anchor,
            voxel=self.layout.voxel,
            shape=self.layout.shape,
            first=first,
            last=last,
            mask=mask,
        )

    def _bake_planes(self, first: int, last: int, out: Planes, mask: UInt8 | None) -> None:
        span = self.span(first, last, mask)
        where = None if mask is None else _cells(mask, span)
        if where is not None and not where.any():
            return
        channels = self._make_channels(span, where)
        for name in self.channels:
            out[name][... if where is None else where] = channels[name]

    def _make_channels(self, span: GridSpan, where: Bool | None) -> dict[str, NDArray[np.generic]]:
        cells = None if where is None else np.flatnonzero(where)
        channels, entry = (
            self._bake_on_processor(span, cells) if self.on_device is None else self._bake_on_device(span)
        )
        if self.probability is not None:
            whole = np.zeros(span.shape_of_channel, np.float32)
            whole[... if where is None else where] = channels["sdf"]
            channels["probability"] = _pick(self.probability.baked(span, whole, threads=self.threads), cells)
        if entry is not None:
            channels["label"] = self.labels[self.spheres.source[entry]]
        if "observed" in self.channels:
            observed = observed_planes(self._occupancy, self.layout, self._thresholds, span.first, span.last)
            channels["observed"] = _pick(observed, cells)
        return channels

    def _bake_on_processor(self, span: GridSpan, cells: Index | None) -> _Baked:
        hard, gradient, entry = self._hard(span, cells)
        kernels = {name: self._kernel(name, span, cells) for name in self.kernels}
        for name, (distance, _) in kernels.items():
            self.counts[f"{name}_without_value"] += int(np.count_nonzero(np.isnan(distance)))
            self.counts[f"{name}_over_estimates"] += int(np.count_nonzero(distance > hard + RESOLUTION))
        sdf, gradient = self._choose(hard, gradient, kernels)
        channels: Planes = {"sdf": sdf, "hard": hard}
        if gradient is not None:
            channels["gradient"] = gradient
        if "bound" in self.channels:
            channels["bound"] = (hard.astype(np.float64) - self.bound_margin).astype(np.float32)
        for name, (distance, _) in kernels.items():
            channels[name] = np.where(np.isnan(distance), hard, distance)
        return channels, entry

    def _bake_on_device(self, span: GridSpan) -> _Baked:
        assert self.on_device is not None
        names = {*self.channels, "entry"} if "label" in self.channels else set(self.channels)
        answers = self.on_device.bake(span, names, margin=self.bound_margin)
        for name, (without_value, over_estimates) in answers.counts.items():
            self.counts[f"{name}_without_value"] += without_value
            self.counts[f"{name}_over_estimates"] += over_estimates
        channels = {
            "sdf": answers.distance,
            "hard": answers.hard,
            "gradient": answers.gradient,
            "bound": answers.bound,
        }
        planes: Planes = {name: values for name, values in channels.items() if values is not None}
        return {**planes, **answers.kernels}, answers.entry

    def _hard(self, span: GridSpan, cells: Index | None) -> tuple[Float32, Float32 | None, NDArray[np.int32] | None]:
        hard = np.zeros(span.shape_of_channel, np.float32)
        gradient = np.zeros((*hard.shape, 3), np.float32) if "gradient" in self.channels else None
        entry = np.zeros(hard.shape, np.int32) if "label" in self.channels else None
        bake_hard(self.spheres.clusters, self.exact.radii, span, hard, gradient, entry, threads=self.threads)
        return (
            _pick(hard, cells),
            None if gradient is None else _pick(gradient, cells),
            None if entry is None else _pick(entry, cells),
        )

    def _kernel(self, name: str, span: GridSpan, cells: Index | None) -> tuple[Float32, Float32 | None]:
        distance = np.zeros(span.shape_of_channel, np.float32)
        has_gradient = "gradient" in self.channels and name == self.kernel_name
        gradient = np.zeros((*distance.shape, 3), np.float32) if has_gradient else None
        self.kernels[name].bake_raw(span, distance, gradient, threads=self.threads)
        return _pick(distance, cells), None if gradient is None else _pick(gradient, cells)

    def _choose(
        self, hard: Float32, gradient: Float32 | None, kernels: Mapping[str, tuple[Float32, Float32 | None]]
    ) -> tuple[Float32, Float32 | None]:
        if self.kernel_name is None:
            return hard, gradient
        smooth, smooth_gradient = kernels[self.kernel_name]
        is_smooth: Bool = ~np.isnan(smooth) if self.config.distance == self.kernel_name else smooth < hard
        sdf = np.where(is_smooth, smooth, hard)
        if gradient is None or smooth_gradient is None:
            return sdf, None
        return sdf, np.where(is_smooth[..., None], smooth_gradient, gradient)


def _pick(values: NDArray[T], cells: Index | None) -> NDArray[T]:
    return values if cells is None else values.reshape(-1, *values.shape[3:])[cells]


def _cells(mask: UInt8, span: GridSpan) -> Bool:
    blocks = mask[span.first // BLOCK : -(-span.last // BLOCK)].view(np.bool_)
    for axis in range(3):
        blocks = np.repeat(blocks, BLOCK, axis=axis)
    x, y, z = span.shape_of_channel
    return np.ascontiguousarray(blocks[:x, :y, :z])


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Blocks of the grid to bake: mask, 1 where needed; None: all, for `reason`."""

    mask: UInt8 | None
    num_blocks: int
    reason: str = ""

    @property
    def num_baked(self) -> int:
        return self.num_blocks if self.mask is None else int(np.count_nonzero(self.mask))


def changed_blocks(before: SplatSet, old: Baker, after: SplatSet, new: Baker) -> Changes:
    """Blocks whose baked bytes can differ between `before` and `after`.

    A block can differ if a splat of only one set, or of changed weight, reaches it by the bake's culling bounds.
    """
    shape = tuple(-(-cells // BLOCK) for cells in new.layout.shape)
    num_blocks = int(np.prod(shape))
    reason = _reason_for_all(old, new)
    if reason:
        return Changes(mask=None, num_blocks=num_blocks, reason=reason)
    mask = np.zeros(shape, np.uint8)
    span = new.span(0, new.layout.shape[0])
    for with_weights in (False, True) if "se" in new.kernels else (False,):
        both = _changed((before, after), (old, new), with_weights=with_weights)
        for changed, baker in zip(both, (old, new), strict=True):
            se = baker.kernels["se"] if with_weights else None  # offsets: ``2 l^2 log |w_i|``, else radii
            offsets, length = (baker.exact.radii, 0.0) if se is None else (se.terms().offsets, se.kernel.length)
            if changed.any():
                native.field_touched(
                    *baker.spheres.clusters, *offsets, changed, length, *span.arrays[:3],
                    num_threads(baker.threads), mask,
                )  # fmt: skip
    return Changes(mask=mask, num_blocks=num_blocks)


def counts_after(
    counts: Mapping[str, int], old: Baker, new: Baker, mask: UInt8, slabs: Sequence[tuple[int, int]]
) -> dict[str, int]:
    """Counts of kernel values in the whole grid after baking `mask`.

    `old` bakes the same blocks again, so that their earlier counts can be subtracted from `counts`.
    """
    if not old.counts:
        return {}
    old.counts = dict.fromkeys(old.counts, 0)
    for first, last in slabs:
        if mask[first // BLOCK : -(-last // BLOCK)].any():
            scratch: Planes = old.allocate(last - first)
            old.bake(first, last, scratch, mask)
    then, now = old.counts, new.counts
    return {name: counts[name] - then[name] + now[name] for name in now}


def _reason_for_all(old: Baker, new: Baker) -> str:
    if "gpdf" in new.kernels:
        return "every splat reaches every cell of gpdf"
    if new.probability is not None and new.config.probability == "paper":
        return "every splat reaches every cell of the paper's probability"
    if new.config.unknown != "free":
        return f"field.unknown = {new.config.unknown} changes the field where no splat does"
    if "bound" in new.channels and old.bound_margin != new.bound_margin:
        return "the farthest splat moved, and bound's margin with it"
    return ""


def _changed(
    splats: tuple[SplatSet, SplatSet], bakers: tuple[Baker, Baker], *, with_weights: bool
) -> tuple[UInt8, UInt8]:
    """Entries (16 C,) of each set without an equal in the other."""
    rows = [_rows(s, b, with_weights=with_weights) for s, b in zip(splats, bakers, strict=True)]
    _, kinds = np.unique(np.concatenate(rows), return_inverse=True)
    old_kinds, new_kinds = np.split(kinds, [len(rows[0])])
    laid_out = []
    for own, other, baker in ((old_kinds, new_kinds, bakers[0]), (new_kinds, old_kinds, bakers[1])):
        changed = np.zeros(len(baker.spheres.source), np.uint8)
        changed[np.flatnonzero(baker.spheres.is_point)] = ~np.isin(own, other)
        laid_out.append(changed)
    return laid_out[0], laid_out[1]


def _rows(splats: SplatSet, baker: Baker, *, with_weights: bool) -> NDArray[np.void]:
    """Splats as bytes (N,), in cluster order.

    A rank separates splats with the same centre.
    """
    order = baker.spheres.source[baker.spheres.is_point.view(np.bool_)]
    centers = splats.centers.astype(np.float64)[order] + 0.0  # no -0, which is equal to 0
    values: list[NDArray[np.floating | np.integer]] = [*centers.T, splats.radii[order], splats.labels[order]]
    if with_weights:
        weights = baker.kernels["se"].weights
        values.append(weights.log_size[order])
        if weights.sign is not None:
            values.append(weights.sign[order])
    table = np.stack([*values, _ranks(centers)], axis=1, dtype=np.float64)
    return table.view(np.dtype((np.void, table.strides[0]))).ravel()


def _ranks(centers: Float64) -> NDArray[np.int64]:
    order = np.lexsort(centers.T)  # stable
    is_first = np.ones(len(centers), np.bool_)
    is_first[1:] = (np.diff(centers[order], axis=0) != 0).any(axis=1)
    places = np.arange(len(centers))
    ranks = np.empty_like(places)
    ranks[order] = places - np.maximum.accumulate(np.where(is_first, places, 0))
    return ranks
