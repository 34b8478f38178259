"""Use of idle slots: clones (3DGS-MCMC), or detail where colours are wrong."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from splatctrl_cli.config import SceneConfig, fixed
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.buffer import Filled, Seeds, SplatBuffer
from splatctrl_cli.scene.seeding import NO_SEEDS, candidates, thinned, thinning


def clone_shape(opacity: Float64, radius: Float64, count: NDArray[np.intp]) -> tuple[Float64, Float64]:
    """Opacity (N,) and radius (N,) [m] of each of `count` (N,) coinciding copies.

    The peak is conserved, `a = 1 - (1 - alpha)^(1/N)`, and the blended opacity over the screen, `r' = r sqrt(alpha
    / sum_{i=1..N} (1 - (1 - a)^i) / i)`: the 2-D rule. The 1-D rule of 3DGS-MCMC (Kheradmand et al. 2024, eq. 9)
    loses a few percent.
    """
    a = 1.0 - (1.0 - opacity) ** (1.0 / count)
    mass = np.zeros_like(opacity)
    for i in range(1, int(count.max(initial=1)) + 1):
        mass += np.where(i <= count, (1.0 - (1.0 - a) ** i) / i, 0.0)
    return a, radius * np.sqrt(np.divide(opacity, mass, out=np.ones_like(mass), where=mass > 0))


def clone_sources(opacities: Float64, num_clones: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw indices (num_clones,) in proportion to opacity, with replacement."""
    total = float(opacities.sum())
    if num_clones < 1 or total <= 0.0:
        return np.zeros(0, np.intp)
    return np.asarray(rng.choice(len(opacities), size=num_clones, p=opacities / total), np.intp)


def clone(buffer: SplatBuffer, num_clones: int, rng: np.random.Generator) -> Filled:
    """Copy splats drawn by their opacity, as 3DGS-MCMC does."""
    opacities = np.where(buffer.is_alive, buffer.opacities, 0.0).astype(np.float64)
    sources = clone_sources(opacities, num_clones, rng)
    count = 1 + np.bincount(sources, minlength=len(opacities))
    return Filled(relocated=buffer.copy(sources, *clone_shape(opacities, buffer.radii.astype(np.float64), count)))


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """A view's mean absolute colour error (H, W), 0 where the pixel is not mappable."""

    frame: RgbdFrame
    error: Float32


def use_idle(
    buffer: SplatBuffer,
    misfits: Callable[[], tuple[list[Misfit], Float64]],
    config: SceneConfig,
    rng: np.random.Generator,
) -> tuple[Filled, int]:
    """Use dead slots beyond the reserve as `when_idle` says; return also the number of weak splats removed.

    misfits: returns those of the views, and how much each slot (M,) shows.
    """
    is_alive, reserve = buffer.is_alive, int(config.gap_reserve * config.max_splats)
    if config.when_idle == "leave" or not is_alive.any():
        return Filled(), 0
    found, shown = ([], None) if config.when_idle == "clone" else misfits()
    if shown is None or not any(misfit.error.any() for misfit in found):  # no depth shows where detail would be
        return clone(buffer, int((~is_alive).sum()) - reserve, rng), 0
    weakest = np.argsort(np.where(is_alive, shown, np.inf), kind="stable")
    is_weak = np.zeros(len(is_alive), bool)
    is_weak[weakest[: int(config.weak_share * is_alive.sum())]] = True
    buffer.kill(is_weak)
    seeds = detail_seeds(found, int((~is_alive).sum()) - reserve, config, rng)
    return buffer.fill(seeds, config.initial_opacity), int(is_weak.sum())


def detail_seeds(misfits: Sequence[Misfit], num_seeds: int, config: SceneConfig, rng: np.random.Generator) -> Seeds:
    """At most `num_seeds` pixel-sized seeds on measured surfaces, drawn by squared colour error.

    The error is a 3 x 3 mean, weighted by a pixel's area of surface. No two seeds are closer than their
    diameters, as several views show one spot.
    """
    every = thinning(misfit.error > 0 for misfit in misfits)
    masks = [thinned(misfit.error > 0, every) for misfit in misfits]
    weight = np.concatenate(
        [
            np.square(uniform_filter(misfit.error, 3)[mask] * misfit.frame.depth[mask], dtype=np.float64)
            for misfit, mask in zip(misfits, masks, strict=True)
        ]
    )
    count = min(fixed.SEED_OVERSAMPLING * num_seeds, int(np.count_nonzero(weight)))
    if count == 0:
        return NO_SEEDS
    found = _pixels([misfit.frame for misfit in misfits], masks, drawn(weight, count, rng))
    kept = _apart(found.centers, 2.0 * found.radii)[:num_seeds]
    return replace(found.select(kept), radii=np.clip(found.radii[kept], config.min_radius, config.max_radius))


def drawn(weight: Float64, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw `count` different indices in proportion to weight (K,), at least `count` of them positive.

    As ``rng.choice(K, count, replace=False, p=weight / weight.sum())``, without its slow checks.
    """
    left = weight / weight.sum()
    found = np.zeros(0, np.intp)
    while len(found) < count:
        left[found] = 0.0
        reached = np.cumsum(left)
        reached /= reached[-1]
        more = reached.searchsorted(rng.random(count - len(found)), side="right")
        _, first = np.unique(more, return_index=True)
        found = np.concatenate([found, more[np.sort(first)]])
    return found


def _pixels(frames: Sequence[RgbdFrame], masks: Sequence[Bool], chosen: NDArray[np.intp]) -> Seeds:
    order = np.argsort(chosen, kind="stable")
    parts, first = [], 0
    for frame, mask in zip(frames, masks, strict=True):
        pixels = np.flatnonzero(mask)
        begin, end = np.searchsorted(chosen[order], [first, first + len(pixels)])
        only = np.zeros(mask.shape, bool)
        only.reshape(-1)[pixels[chosen[order[begin:end]] - first]] = True
        parts.append(candidates(frame, only))
        first += len(pixels)
    found = Seeds(
        centers=np.concatenate([part.points for part in parts]),
        radii=np.concatenate([part.pixels for part in parts]),
        colors=np.concatenate([part.colors for part in parts]),
    )
    return found.select(np.argsort(order))


def _apart(points: Float32, distances: Float32) -> NDArray[np.intp]:
    """Indices of points (K, 3) not within the distance (K,) of earlier kept ones."""
    is_taken = np.zeros(len(points), bool)
    neighbours = cKDTree(points).query_ball_point(points, distances)
    kept = []
    for index, near in enumerate(neighbours):
        if not is_taken[index]:
            kept.append(index)
            is_taken[near] = True
    return np.array(kept, np.intp)
