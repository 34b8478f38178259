"""Splats for rendering only: the backdrop and the shell.

The backdrop fills pixels without depth. The coarse shell lies beyond the workspace, with its own budget.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import OccupancyConfig, SceneConfig, fixed
from splatctrl_cli.geometry import back_project_pixels, invert_transform, project, transform_points
from splatctrl_cli.records import Bool, Box, Float32, Float64, Floats, RgbdFrame, SplatSet, Values
from splatctrl_cli.scene.buffer import COLOR, Seeds, SplatBuffer
from splatctrl_cli.scene.descent import Descent
from splatctrl_cli.scene.keyframes import View, Window, seen_through
from splatctrl_cli.scene.render import Color
from splatctrl_cli.scene.scale import scale_lengths
from splatctrl_cli.scene.seeding import (
    NO_SEEDS,
    SeedDensity,
    add_mask,
    candidates,
    density_for,
    seeds_at,
    thin_mask,
    thinning,
)

COLUMNS = (60, 48, 40, 32, 26, 22, 18, 15)  # cells across an image; the first number with few enough seeds is used
BLOCKS = (4, 2, 1)  # cells along the side of a seed's square, if its colours are alike
RADIUS = 0.6  # of a seed, in sides of its square
DEPTHS = (0.5, 10.0)  # nearest and farthest depth of seeds, by the median depth
NUM_DEPTHS = 40  # at equal steps of inverse depth
ASKED_VIEWS = 16  # views that compare their colour with a seed's
SAME_COLOR, OTHER_COLOR = 0.03, 0.1  # mean difference of channels in [0, 1]
NEAR_DEPTH = 0.03  # share of a measured depth; a seed further before or behind it is off that surface
LEAST_VOTES = 1.0  # one full vote, which a place must exceed: it needs two views
BLANK = 0.02  # share of a cell's pixels with depth


def backdrop_seeds(frames: Sequence[RgbdFrame], opacities: Sequence[Float32], background: Color, most: int) -> Seeds:
    """Place at most `most` seeds at pixels without depth, unexplained by map and background.

    opacities: rendered (H, W). Cells of pixels become larger until the seeds are few enough.
    """
    depth = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    if not len(depth):
        return NO_SEEDS
    nearest, farthest = np.multiply(DEPTHS, float(np.median(depth)))
    depths = 1 / np.linspace(1 / farthest, 1 / nearest, NUM_DEPTHS)
    for columns in COLUMNS:
        cells = [_Cells(frame, opacity, columns) for frame, opacity in zip(frames, opacities, strict=True)]
        seeds = NO_SEEDS
        for one in cells:
            if len(seeds) <= most:
                seeds = seeds.joined(_seeds_of(one, cells, seeds, np.array(background, np.float32), depths))
        if len(seeds) <= most:
            return seeds
    return seeds.select(np.arange(most))


def _seeds_of(
    one: "_Cells", cells: Sequence["_Cells"], earlier: Seeds, background: Float32, depths: Float64
) -> Seeds:
    is_missing = one.is_blank & ~one.find_covered(earlier)
    is_missing &= np.abs(one.color - background).mean(axis=2) > SAME_COLOR
    v, u, size, color = (np.concatenate(parts) for parts in zip(*one.missing_squares(is_missing), strict=True))
    if not len(v):
        return NO_SEEDS
    k = one.frame.intrinsics
    rays = back_project_pixels(k, u, v, np.ones(len(u)))
    points = transform_points(one.frame.T_world_camera, (rays[:, None] * depths[:, None]).reshape(-1, 3))
    colors = np.repeat(color, len(depths), axis=0)
    votes = np.zeros(len(points))
    for other in cells[:: max(len(cells) // ASKED_VIEWS, 1)]:
        if other is not one:
            difference, counts = other.compare(points, colors)
            votes += counts * (1 - difference / OTHER_COLOR)
    by_depth = votes.reshape(len(v), -1)
    is_agreed = by_depth.max(axis=1) > LEAST_VOTES
    best = np.where(is_agreed, np.argmax(by_depth, axis=1), 0)  # the farthest of equally good depths
    return Seeds(
        centers=points.reshape(*by_depth.shape, 3)[np.arange(len(v)), best].astype(np.float32),
        radii=(RADIUS * size * depths[best] / k.fx).astype(np.float32),
        colors=color,
    )


class _Cells:
    """A frame in square cells: mean colours (h, w, 3), and depth (h, w) [m], 0 = none."""

    def __init__(self, frame: RgbdFrame, opacity: Float32, columns: int) -> None:
        self.frame, self.side = frame, max(frame.intrinsics.width // columns, 1)
        has_depth, is_open = self._mean(frame.depth > 0), self._mean(opacity) < fixed.OPAQUE_ENOUGH
        self.color = self._mean(frame.color).astype(np.float32) / 255
        self.depth = self._mean(frame.depth) / np.maximum(has_depth, 1e-9)
        self.is_blank = (has_depth < BLANK) & is_open & (self._mean(frame.is_in_view) == 1)
        self.T_camera_world = invert_transform(frame.T_world_camera)

    def _mean(self, image: NDArray[np.generic]) -> Float64:
        h, w = (size // self.side for size in image.shape[:2])
        cut = image[: h * self.side, : w * self.side]
        return np.asarray(cut.reshape(h, self.side, w, self.side, *image.shape[2:]).mean(axis=(1, 3)), np.float64)

    def missing_squares(self, is_missing: Bool) -> Iterator[tuple[Float64, Float64, Float64, Float32]]:
        """Yield squares of missing cells with similar colours: middles v, u, sides [px] (K,), colours (K, 3)."""
        for block in BLOCKS:
            h, w = (size // block for size in is_missing.shape)
            part = np.s_[: h * block, : w * block]
            shape = (h, block, w, block)
            color = self.color[part].reshape(*shape, 3)
            is_alike = np.ptp(color, axis=(1, 3)).max(axis=2) < OTHER_COLOR
            chosen = is_missing[part].reshape(shape).all(axis=(1, 3)) & (is_alike | (block == 1))
            v, u = np.nonzero(chosen)
            is_missing[part] &= ~np.kron(chosen, np.ones((block, block), bool))
            middles = (np.stack([v, u]) + 0.5) * block * self.side - 0.5
            means = np.asarray(color.mean(axis=(1, 3))[v, u], np.float32)
            yield middles[0], middles[1], np.full(len(v), float(block * self.side)), means

    def _locate(self, points: Floats) -> tuple[Float64, Float64, Float64]:
        """Columns, rows (K,) in cells, and depths (K,) [m] of points (K, 3) [m], world."""
        local = transform_points(self.T_camera_world, points)
        pixels = project(self.frame.intrinsics, np.where(local[:, 2:] > 0, local, 1.0))
        cells = (pixels + 0.5) / self.side - 0.5
        return cells[:, 0], cells[:, 1], local[:, 2]

    def find_covered(self, seeds: Seeds) -> Bool:
        h, w = self.depth.shape
        is_covered = np.zeros((h, w), bool)
        u, v, z = self._locate(seeds.centers)
        half = seeds.radii * self.frame.intrinsics.fx / (2 * RADIUS * self.side) / np.maximum(z, 1e-6)
        reach = np.maximum(half, 0.5) + 0.01
        for n in np.flatnonzero((z > 0) & (u > -reach) & (u < w + reach) & (v > -reach) & (v < h + reach)):
            rows, columns = (
                slice(max(int(np.ceil(at[n] - reach[n])), 0), max(int(at[n] + reach[n]) + 1, 0)) for at in (v, u)
            )
            is_covered[rows, columns] |= (
                np.abs(self.color[rows, columns] - seeds.colors[n]).mean(axis=2) < OTHER_COLOR
            )
        return is_covered

    def compare(self, points: Float64, colors: Float32) -> tuple[Float64, Bool]:
        """Colour differences (K,) to points (K, 3), 1 before depth; False (K,) behind depth or out of view."""
        u, v, z = self._locate(points)
        h, w = self.depth.shape
        is_in = (z > 0) & (u > -0.5) & (v > -0.5) & (u < w - 0.5) & (v < h - 0.5)
        at = np.where(is_in, np.round(v) * w + np.round(u), 0).astype(np.intp)
        depth = self.depth.ravel()[at]
        is_before = (depth > 0) & (z < (1 - NEAR_DEPTH) * depth)
        is_behind = (depth > 0) & (z > (1 + NEAR_DEPTH) * depth)
        difference = np.abs(self.color.reshape(-1, 3)[at] - colors).mean(axis=1)
        return np.where(is_before, 1.0, difference), np.asarray(is_in & ~is_behind)


Masked = Sequence[tuple[View, Bool]]


def pixels_beyond(view: View, min_range: float, mounted: Bool | None = None) -> Bool:
    """Valid pixels (H, W) outside the workspace with depth of at least `min_range` [m], except `mounted` pixels."""
    depth = view.target.depth
    left_out = (depth > 0) & (depth >= min_range) & (view.target.counted == 0) & view.frame.is_in_view
    return np.asarray(left_out if mounted is None else left_out & ~mounted)


class Shell:
    """Extra splats, a share `scene.shell` of `scene.max_splats`, for what views show beyond the workspace.

    Lengths scale by the median depth beyond the workspace.
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
        """Seed unexplained pixels; restart with a new density if too many seeds are unmet."""
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
