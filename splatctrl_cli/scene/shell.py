"""The shell: coarse splats beyond the workspace, for rendering only, with their own budget."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from splatctrl_cli.config import OccupancyConfig, SceneConfig, fixed
from splatctrl_cli.records import Bool, Box, SplatSet, Values
from splatctrl_cli.scene.buffer import COLOR, Seeds, SplatBuffer
from splatctrl_cli.scene.descent import Descent
from splatctrl_cli.scene.keyframes import View, Window, seen_through
from splatctrl_cli.scene.render import Color
from splatctrl_cli.scene.scale import scale_lengths
from splatctrl_cli.scene.seeding import (
    SeedDensity,
    add_mask,
    candidates,
    density_for,
    seeds_at,
    thin_mask,
    thinning,
)

Masked = Sequence[tuple[View, Bool]]


def pixels_beyond(view: View, min_range: float, mounted: Bool | None = None) -> Bool:
    """Valid pixels (H, W) with depth of at least `min_range` [m] outside the workspace, except `mounted` ones."""
    depth = view.target.depth
    left_out = (depth > 0) & (depth >= min_range) & (view.target.counted == 0) & view.frame.is_in_view
    return np.asarray(left_out if mounted is None else left_out & ~mounted)


class Shell:
    """Extra splats, a share `scene.shell` of `scene.max_splats`, for what views show beyond the workspace.

    Lengths scale by the median depth of the first such pixels.
    """

    def __init__(
        self, config: SceneConfig, occupancy: OccupancyConfig, workspace: Box, seed: int, num_threads: int
    ) -> None:
        self.config = config.derived(max_splats=max(round(config.shell * config.max_splats), 1))
        self.occupancy, self.workspace = occupancy, workspace
        self.buffer = SplatBuffer(self.config.max_splats)
        self.num_steps = 0
        self._seed, self._num_threads, self._see_through = seed, num_threads, occupancy.see_through
        self._begin(0.0, None)

    def _begin(self, depth: float, density: SeedDensity | None, num_iterations: int = 0) -> None:
        self._depth, self._density, config = depth, density, self.config
        if density is not None:
            config = scale_lengths(config, depth / fixed.SCALE_DEPTH).derived(radius_depth=depth)
            least, most = config.min_radius, config.max_radius  # the user may have set either
            widest = max(least, most, config.radius_per_edge * density.edge)  # else far walls have holes
            config = config.derived(max_radius=widest)
            self._see_through = scale_lengths(self.occupancy, depth / fixed.SCALE_DEPTH).see_through
        self._scaled = config
        self._descent = Descent(config, self.buffer, self._seed, self._num_threads)
        self._descent.num_iterations = num_iterations

    def step(self, views: Window, mounted: Mapping[str, Bool], background: Color | None) -> None:
        """Take in a time step's views: remove, seed, optimise."""
        rng = np.random.default_rng([self._seed, self.num_steps])
        self.num_steps += 1
        self._remove(views.newest)
        every = [*views.newest, *views.keyframes]
        masks = [pixels_beyond(view, self.occupancy.min_range, mounted.get(view.frame.camera)) for view in every]
        shown = [(view, mask) for view, mask in zip(every, masks, strict=True) if mask.any()]
        if not shown:
            return
        config, is_first = self.config, self._density is None
        self._add(shown)
        iterations = round(
            fixed.SHELL_ITERATIONS * (config.first_iterations if is_first else config.iterations_per_step)
        )
        far = Window(config)
        far.newest = [replace(v, target=replace(v.target, counted=m.astype(np.uint8))) for v, m in shown]
        self._descent.background = background
        self._descent.run(far.schedule(iterations, rng), self._descent.settings())
        self._remove(views.newest)

    def splats(self) -> SplatSet:
        """Live splats, none centred in the workspace."""
        return self.buffer.splats(self._num_threads)

    def _add(self, shown: Masked) -> None:
        """Seed what the shell does not explain; restart coarser if too many are unmet."""
        unexplained = [
            (view, add_mask(view.frame, self._descent.rendering(view), m, self._scaled)) for view, m in shown
        ]
        most = fixed.SHELL_UNMET * self.config.max_splats
        if self._density is not None and self._fill(_sources(unexplained), self._density) <= most:
            return
        stands = self.buffer.is_alive.copy()
        own_seeds = Seeds(
            centers=self.buffer.centers[stands],
            radii=self.buffer.radii[stands],
            colors=self.buffer.parameters[stands, COLOR],
        )
        self.buffer.kill(stands)
        depth = float(np.median(np.concatenate([view.target.depth[mask] for view, mask in shown])))
        sources, config = [*_sources(shown), own_seeds], scale_lengths(self.config, depth / fixed.SCALE_DEPTH)
        density = density_for(sources, max(int(config.fill * config.max_splats), 1), config, self._num_threads)
        self._begin(depth, density, self._descent.num_iterations)
        self._fill(sources, density)

    def _fill(self, sources: Sequence[Seeds], density: SeedDensity) -> int:
        if not any(len(source) for source in sources):
            return 0
        seeds = seeds_at(sources, self.buffer.centers[self.buffer.is_alive], density, self._scaled, self._num_threads)
        return self.buffer.fill(seeds, self.config.initial_opacity).unmet

    def _remove(self, views: Sequence[View]) -> None:
        gone = self.workspace.contains(self.buffer.centers) | (self.buffer.opacities < self.config.min_opacity)
        gone |= seen_through(self.buffer.centers, views, self._see_through, self._num_threads)
        self.buffer.kill(self.buffer.is_alive & gone)

    def arrays(self) -> dict[str, Values]:
        d = self._density
        density = (0.0, 0.0, 0) if d is None else (d.edge, d.tolerance, d.num_candidates)
        counters = (self.num_steps, self._descent.num_iterations)
        return self.buffer.arrays() | {"begun": np.array([*counters, self._depth, *density])}

    def restore(self, arrays: Mapping[str, Values]) -> None:
        """Restore a state of the same configuration, seed and workspace."""
        for name, array in self.buffer.arrays().items():
            array[...] = arrays[name]
        num_steps, num_iterations, depth, edge, tolerance, num_candidates = (float(x) for x in arrays["begun"])
        self.num_steps = int(num_steps)
        density = SeedDensity(edge=edge, tolerance=tolerance, num_candidates=int(num_candidates))
        self._begin(depth, density if edge else None, int(num_iterations))


def _sources(masked: Masked) -> list[Seeds]:
    every = thinning(mask for _, mask in masked)
    return [candidates(view.frame, thin_mask(mask, every)) for view, mask in masked]
