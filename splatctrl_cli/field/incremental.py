"""Blocks of a grid that an edit of the splats can change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.field.baker import Baker, Planes
from splatctrl_cli.kernels import native, num_threads
from splatctrl_cli.kernels.field import BLOCK
from splatctrl_cli.records import Float64, SplatSet, UInt8


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Mask (blocks of the grid): 1 where a bake is needed; None: everywhere, for `reason`."""

    mask: UInt8 | None
    num_blocks: int
    reason: str = ""

    @property
    def num_baked(self) -> int:
        return self.num_blocks if self.mask is None else int(np.count_nonzero(self.mask))


def changed_blocks(before: SplatSet, old: Baker, after: SplatSet, new: Baker) -> Changes:
    """Blocks where bakes of `before` and `after` can differ by a bit.

    A block can differ if a splat of only one set reaches it, by the bake's culling bounds, or if weights differ.
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
            se = baker.kernels["se"] if with_weights else None  # ``2 l^2 log |w_i|``; else the radii, and no length
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
    """Entries (16 C,) of each set missing in the other, to the bit."""
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

    A rank separates splats of one centre.
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
