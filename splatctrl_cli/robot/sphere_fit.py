"""Spheres that cover a robot's collision surface and protrude as little as their number allows.

A ball at c that may protrude by t has the radius t - d(c), d the signed distance to the body (negative inside). The
surface is cut into small triangles ("patches"); a ball covers a patch if it contains its corners. A ball at c that
covers patch p protrudes by

    K[c, p] = max_k |v_pk - c| + d(c).

The best n centres minimise the largest of the patches' least K, a k-centre problem. Greedy set cover at a bisected t
gives centres, which alternating assignment and recentring improve; then balls shrink.
"""

import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from splatctrl_cli import __version__
from splatctrl_cli.config.fixed import (
    DEFAULT_SPHERES,
    DEFICIT_GAP,
    FIT_BISECTIONS,
    FIT_MIN_PATCH,
    FIT_ROUNDS,
    FIT_STEPS,
    FIT_TIE,
)
from splatctrl_cli.errors import InputError, UsageError, refuse_if, require
from splatctrl_cli.files.output import write_durably
from splatctrl_cli.records import Bool, Float64, Index, SphereSet
from splatctrl_cli.robot.coverage import areas, largest_deficit, refine_triangles
from splatctrl_cli.robot.link_meshes import Solid, SolidDistance, mesh_path, read_solids
from splatctrl_cli.robot.sphere_files import own_spheres, read_spheres, spheres_yaml
from splatctrl_cli.robot.urdf import UrdfFile

DIGITS = 6  # decimals of a written sphere: micrometres


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Requirements on the spheres.

    max_spheres: over all links; or max_protrusion [m], met by few spheres. max_deficit [m]: largest distance of
    surface points outside. restarts: number of greedy covers per link and protrusion; num_patches, num_candidates:
    approximate, per link.
    """

    max_spheres: int | None = None
    max_protrusion: float | None = None
    max_deficit: float = 0.0
    restarts: int = 3
    num_patches: int = 2000
    num_candidates: int = 2500
    seed: int = 0


def default_spheres(urdf: UrdfFile, packages: Sequence[Path] = ()) -> SphereSet:
    """Spheres of a URDF, else a fit of `DEFAULT_SPHERES`, stored in the user's cache.

    packages: folders for ``package://``. Raises InputError without collision geometry.
    """
    own = own_spheres(urdf)
    if len(own.radii):
        return own
    path = _cached_fit(urdf, packages)
    with suppress(InputError):
        return read_spheres(path)
    solids = read_solids(urdf, packages)
    fitted = fit_spheres(solids, FitOptions(max_spheres=max(DEFAULT_SPHERES, len(solids))))
    text = spheres_yaml(fitted, [f"Fitted to {urdf.path.name} by splatctrl {__version__}."])
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, lambda partial: partial.write_text(text, encoding="utf-8"))
    return fitted


def _cached_fit(urdf: UrdfFile, packages: Sequence[Path]) -> Path:
    meshes = (mesh_path(urdf.path, mesh, packages).read_bytes() for mesh in urdf.meshes)
    digest = hashlib.sha256(b"\0".join([__version__.encode(), urdf.text.encode(), *meshes])).hexdigest()
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME", ""), ".cache"))
    stored = folder if folder.is_absolute() else Path(os.devnull)  # nowhere
    return stored / "splatctrl" / f"spheres-{digest}.yaml"


def fit_spheres(solids: Mapping[str, Sequence[Solid]], options: FitOptions) -> SphereSet:
    """Fit spheres to each link's solids, rounded outward to micrometres; deterministic by seed.

    Raises UsageError for contradictory options or too few spheres, InputError for a link without area.
    """
    _check(options, len(solids))
    links = [_Link(name, parts, options, index) for index, (name, parts) in enumerate(solids.items())]
    fitted = (
        _share_out(links, options.max_spheres or 0)
        if options.max_protrusion is None
        else [link.within(options.max_protrusion) for link in links]
    )
    return SphereSet(
        links=tuple(link.name for link, (centers, _) in zip(links, fitted, strict=True) for _ in centers),
        centers=np.concatenate([centers for centers, _ in fitted]),
        radii=np.concatenate([radii for _, radii in fitted]),
    )


def _check(options: FitOptions, num_links: int) -> None:
    refuse_if(
        (options.max_spheres is None) == (options.max_protrusion is None),
        "sphere fit: expected a number of spheres or a protrusion, not both",
        error=UsageError,
    )
    refuse_if(
        options.max_spheres is not None and options.max_spheres < num_links,
        f"sphere fit: {options.max_spheres} spheres for {num_links} links with collision geometry",
        remedy=f"allow at least {num_links}, one for each",
        error=UsageError,
    )
    for name, value in {"protrusion": options.max_protrusion, "deficit": options.max_deficit}.items():
        if value is not None and not (np.isfinite(value) and value >= 0):
            raise UsageError(f"sphere fit: largest {name}: expected 0 m or more, got {value:g}")


def _share_out(links: Sequence["_Link"], budget: int) -> list[tuple[Float64, Float64]]:
    """Distribute `budget` spheres: by one t for all links, then to the most protruding links."""
    low, high = 0.0, max(link.single for link in links)
    chosen = [np.array([link.middle]) for link in links]
    for _ in range(FIT_BISECTIONS):
        t = 0.5 * (low + high)
        covers = _covers(links, t, budget)
        if covers is None:
            low = t
        else:
            high, chosen = t, covers
    counts = [len(cover) for cover in chosen]
    states = [link.improve(cover) for link, cover in zip(links, chosen, strict=True)]
    for _ in range(budget - sum(counts)):
        worst = int(np.argmax([protrusion for _, protrusion in states]))
        counts[worst] += 1
        states[worst] = links[worst].refine(counts[worst], states[worst])
    return [link.round_outward(*state) for link, state in zip(links, states, strict=True)]


def _covers(links: Sequence["_Link"], t: float, budget: int) -> list[Index] | None:
    covers: list[Index] = []
    for index, link in enumerate(links):
        cover = link.cover(t, at_most=budget - sum(len(cover) for cover in covers) - (len(links) - index - 1))
        if cover is None:
            return None
        covers.append(cover)
    return covers


class _Link:
    """Patches, candidate centres and matrix K of one link."""

    def __init__(self, name: str, parts: Sequence[Solid], options: FitOptions, index: int) -> None:
        self.name = name
        self._options = options
        self._seed = (options.seed, index)
        self._parts = parts
        self._distance = SolidDistance(parts)
        area = float(areas(np.concatenate([part.surface.corners for part in parts])).sum())
        refuse_if(not area > 0, f"link '{name}': expected a collision surface, got none of any area")
        longest = max(FIT_MIN_PATCH, 2 * float(np.sqrt(area / options.num_patches)))
        cut = [refine_triangles(part.surface.corners, longest) for part in parts]
        self._slack = np.concatenate([np.full(len(t), p.slack) for t, p in zip(cut, parts, strict=True)])
        patches = np.concatenate(cut)
        self._vertices, faces = np.unique(patches.reshape(-1, 3), axis=0, return_inverse=True)
        self._faces = faces.reshape(-1, 3)
        self._candidates, self._spacing = self._lattice(patches)
        self._depth = self._distance(self._candidates)
        self._cost = self._reach(self._candidates) + self._depth[:, None]
        alone = self._cost.max(axis=1)
        self.middle = int(np.argmin(alone))  # the candidate that alone covers the link, at the least protrusion
        self.single = float(alone[self.middle])

    def cover(self, t: float, *, at_most: int) -> Index | None:
        """Candidates (n,) whose balls of protrusion t cover every patch, by greedy passes.

        None if that takes more than `at_most`, or t is too small for a patch.
        """
        holds = self._cost <= t
        if not holds.any(axis=0).all():
            return None
        by_patch = np.ascontiguousarray(holds.T)
        rng = np.random.default_rng(self._seed)
        best: list[int] | None = None
        for attempt in range(self._options.restarts):
            limit = at_most if best is None else len(best) - 1
            best = _greedy(by_patch, rng if attempt else None, limit) or best
        return None if best is None else np.array(best, dtype=np.int64)

    def within(self, max_protrusion: float) -> tuple[Float64, Float64]:
        """Few spheres within a protrusion [m]. Raises UsageError if too small for a patch."""
        least = float(self._cost.min(axis=0).max()) - self._options.max_deficit
        cover = require(
            self.cover(max_protrusion + self._options.max_deficit, at_most=self._cost.shape[1]),
            f"sphere fit: link '{self.name}': largest protrusion: expected at least {1e3 * least:.1f} mm, "
            f"got {1e3 * max_protrusion:g} mm",
            remedy="allow more",
            error=UsageError,
        )
        return self.round_outward(*self.improve(cover))

    def refine(self, count: int, state: tuple[Float64, float]) -> tuple[Float64, float]:
        """Best centres (n, 3), n <= count, and their protrusion, not worse than `state`."""
        low, high = 0.0, state[1]
        for _ in range(FIT_BISECTIONS // 2):
            t = 0.5 * (low + high)
            cover = self.cover(t, at_most=count)
            if cover is None:
                low = t
                continue
            improved = self.improve(cover)
            high = min(t, improved[1])
            if improved[1] < state[1]:
                state = improved
        return state

    def improve(self, chosen: Index) -> tuple[Float64, float]:
        """Centres (n, 3) and protrusion [m] after alternating assignment and recentring."""
        centers = self._candidates[chosen]
        for _ in range(FIT_ROUNDS):
            owner, worst = self._assign(centers)
            moved = _recentre(centers, owner, [self._candidates] * len(centers), [self._cost] * len(centers))
            if self._assign(moved)[1] >= worst:
                break
            centers = moved
        return self._polish(centers)

    def round_outward(self, centers: Float64, _protrusion: float) -> tuple[Float64, Float64]:
        """Spheres at rounded centres, as small as the whole surface allows."""
        owner, _ = self._assign(centers)
        centers = centers[np.unique(owner)].round(DIGITS)
        owner, _ = self._assign(centers)
        reach = self._reach(centers)
        radii = np.array(
            [reach[k, owner == k].max(initial=0.0) for k in range(len(centers))]
        )  # 0: of no use after rounding
        spare = -max(
            largest_deficit(part.surface.corners, centers, radii - part.slack, floor=-np.inf).proven
            for part in self._parts
        )
        allowed = max(self._options.max_deficit - DEFICIT_GAP, 0.0)  # so that the proven bound is at most max_deficit
        radii = np.maximum(radii - max(spare, 0.0) - allowed, 10**-DIGITS)
        return centers, np.ceil(radii * 10**DIGITS + 1e-3) / 10**DIGITS

    def _polish(self, centers: Float64) -> tuple[Float64, float]:
        offsets = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], dtype=np.float64)
        for step in FIT_STEPS:
            owner, worst = self._assign(centers)
            tried = (centers[:, None] + step * self._spacing * offsets).reshape(-1, 3)
            cost = (self._reach(tried) + self._distance(tried)[:, None]).reshape(len(centers), len(offsets), -1)
            moved = _recentre(centers, owner, tried.reshape(len(centers), -1, 3), cost)
            if self._assign(moved)[1] < worst:
                centers = moved
        return centers, self._assign(centers)[1]

    def _assign(self, centers: Float64) -> tuple[Index, float]:
        cost = self._reach(centers) + self._distance(centers)[:, None]
        owner = cost.argmin(axis=0)
        return owner.astype(np.int64), float(cost[owner, np.arange(cost.shape[1])].max())

    def _reach(self, centers: Float64) -> Float64:
        away = cdist(self._vertices, centers)
        first, second, third = self._faces.T  # rows (patches, n) are read in one piece each
        return np.asarray(np.maximum(np.maximum(away[first], away[second]), away[third]) + self._slack[:, None]).T

    def _lattice(self, patches: Float64) -> tuple[Float64, float]:
        lower, upper = self._vertices.min(axis=0), self._vertices.max(axis=0)
        size, num_candidates = np.maximum(upper - lower, 1e-3), self._options.num_candidates
        spacing = float(np.cbrt(np.prod(size) / num_candidates))
        for _ in range(3):  # the body fills only a part of its box
            counts = np.maximum(np.ceil(size / spacing).astype(int), 1)
            axes = [lower[k] + size[k] * (np.arange(counts[k]) + 0.5) / counts[k] for k in range(3)]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            inside = points[self._distance(points) < 0]
            if len(inside) > num_candidates // 2:
                break
            spacing *= float(np.cbrt(max(len(inside), 100) / num_candidates))
        if len(inside) < num_candidates // 20:
            inside = np.concatenate([inside, patches.mean(axis=1)])
        return inside, spacing


def _recentre(
    centers: Float64, owner: Index, places: Sequence[Float64] | Float64, costs: Sequence[Float64] | Float64
) -> Float64:
    """Centres (n, 3), each moved to the best of its places (K, 3) by costs (K, patches)."""
    moved = centers.copy()
    for ball in np.unique(owner):
        moved[ball] = places[ball][np.argmin(costs[ball][:, owner == ball].max(axis=1))]
    return moved


def _greedy(by_patch: Bool, rng: np.random.Generator | None, at_most: int) -> list[int] | None:
    """Pick candidates that cover most pending patches; with `rng`, at random among nearly the best."""
    pending = np.ones(len(by_patch), dtype=np.bool_)
    gain = by_patch.sum(axis=0, dtype=np.int32)
    picked: list[int] = []
    while pending.any():
        if len(picked) >= at_most:
            return None
        best = np.argmax(gain) if rng is None else rng.choice(np.flatnonzero(gain >= (1 - FIT_TIE) * gain.max()))
        choice = int(best)
        picked.append(choice)
        newly = pending & by_patch[:, choice]
        gain = gain - by_patch[newly].sum(axis=0, dtype=np.int32)
        pending &= ~newly
    return picked
