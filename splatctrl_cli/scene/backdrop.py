"""The backdrop: splats at pixels without depth, where views agree on a colour.

They are trained and rendered, but show neither surface nor free space.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import back_project_pixels, invert_transform, project, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.buffer import Seeds
from splatctrl_cli.scene.render import Color
from splatctrl_cli.scene.seeding import NO_SEEDS

RADIUS = 0.6  # of a seed, in cells
BLOCKS = (4, 2, 1)  # cells along the side of a seed's square, while its colours are alike


def backdrop_seeds(frames: Sequence[RgbdFrame], opacities: Sequence[Float32], background: Color, most: int) -> Seeds:
    """At most `most` seeds at pixels without depth that neither the map nor its background explains.

    opacities: rendered (H, W). Cells of pixels become larger until the seeds are few enough.
    """
    depth = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    if not len(depth):
        return NO_SEEDS
    nearest, farthest = np.multiply(fixed.BACKDROP_DEPTHS, float(np.median(depth)))
    depths = 1 / np.linspace(1 / farthest, 1 / nearest, fixed.BACKDROP_PLANES)
    found = NO_SEEDS
    for columns in fixed.BACKDROP_COLUMNS:
        cells = [_Cells(frame, opacity, columns) for frame, opacity in zip(frames, opacities, strict=True)]
        found = NO_SEEDS
        for one in cells:
            found = found.joined(_seeds_of(one, cells, found, np.array(background, np.float32), depths))
            if len(found) > most:
                break
        if len(found) <= most:
            break
    return found.select(np.arange(min(len(found), most)))


def _seeds_of(one: "_Cells", cells: Sequence["_Cells"], found: Seeds, background: Float32, depths: Float64) -> Seeds:
    """Seeds of cells that `found` does not cover, each at the depth (D,) [m] where most views agree."""
    is_missing = one.is_blank & ~one.covered(found)
    is_missing &= np.abs(one.color - background).mean(axis=2) > fixed.BACKDROP_ALIKE
    v, u, size, color = (np.concatenate(parts) for parts in zip(*one.squares(is_missing), strict=True))
    if not len(v):
        return NO_SEEDS
    k = one.frame.intrinsics
    rays = back_project_pixels(k, u, v, np.ones(len(u)))
    points = transform_points(one.frame.T_world_camera, (rays[:, None] * depths[:, None]).reshape(-1, 3))
    colors = np.repeat(color, len(depths), axis=0)
    votes = np.zeros(len(points))
    for other in cells[:: max(len(cells) // fixed.BACKDROP_ASKED, 1)]:
        if other is not one:
            difference, counts = other.compare(points, colors)
            votes += counts * (1 - difference / fixed.BACKDROP_CONTRAST)
    votes = votes.reshape(len(v), -1)
    best = np.argmax(votes, axis=1)  # the farthest of the best
    return Seeds(
        centers=points.reshape(*votes.shape, 3)[np.arange(len(v)), best].astype(np.float32),
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
        self.is_blank = (has_depth < fixed.BACKDROP_BLANK) & is_open & (self._mean(frame.in_view) == 1)
        self.T_camera_world = invert_transform(frame.T_world_camera)

    def _mean(self, image: NDArray[np.generic]) -> Float64:
        h, w = (size // self.side for size in image.shape[:2])
        cut = image[: h * self.side, : w * self.side]
        return np.asarray(cut.reshape(h, self.side, w, self.side, *image.shape[2:]).mean(axis=(1, 3)), np.float64)

    def squares(self, is_missing: Bool) -> Iterator[tuple[Float64, Float64, Float64, Float32]]:
        """Middles v, u [px] (K,), sides [px] (K,) and colours (K, 3) of squares of missing cells alike in colour."""
        for block in BLOCKS:
            h, w = (size // block for size in is_missing.shape)
            part = np.s_[: h * block, : w * block]
            shape = (h, block, w, block)
            color = self.color[part].reshape(*shape, 3)
            is_alike = np.ptp(color, axis=(1, 3)).max(axis=2) < 3 * fixed.BACKDROP_ALIKE
            chosen = is_missing[part].reshape(shape).all(axis=(1, 3)) & (is_alike | (block == 1))
            v, u = np.nonzero(chosen)
            is_missing[part] &= ~np.kron(chosen, np.ones((block, block), bool))
            size = float(block * self.side)
            yield (v + 0.5) * size - 0.5, (u + 0.5) * size - 0.5, np.full(len(v), size), color.mean(axis=(1, 3))[v, u]

    def _locate(self, points: Float64) -> tuple[Float64, Float64, Float64]:
        """Columns, rows (K,) in cells, and depths (K,) [m] of points (K, 3) [m], world."""
        local = transform_points(self.T_camera_world, points)
        u, v = project(self.frame.intrinsics, np.where(local[:, 2:] > 0, local, 1.0)).T
        return (u + 0.5) / self.side - 0.5, (v + 0.5) / self.side - 0.5, local[:, 2]

    def covered(self, seeds: Seeds) -> Bool:
        """Cells (h, w) behind a seed of their colour."""
        found = np.zeros(self.depth.shape, bool)
        u, v, z = self._locate(seeds.centers)
        reach = np.maximum(seeds.radii * self.frame.intrinsics.fx / (2 * RADIUS * self.side) / z, 0.5) + 0.01
        h, w = found.shape
        for n in np.flatnonzero((z > 0) & (u > -reach) & (u < w + reach) & (v > -reach) & (v < h + reach)):
            rows, columns = (
                slice(max(int(np.ceil(at[n] - reach[n])), 0), max(int(at[n] + reach[n]) + 1, 0)) for at in (v, u)
            )
            found[rows, columns] |= np.abs(self.color[rows, columns] - seeds.colors[n]).mean(axis=2) < 0.1
        return found

    def compare(self, points: Float64, colors: Float32) -> tuple[Float64, Bool]:
        """Colour differences (K,) to points (K, 3), 1 before measured depth, and False behind it or out of view."""
        u, v, z = self._locate(points)
        h, w = self.depth.shape
        is_in = (z > 0) & (u > -0.5) & (v > -0.5) & (u < w - 0.5) & (v < h - 0.5)
        at = np.where(is_in, np.round(v) * w + np.round(u), 0).astype(np.intp)
        depth = self.depth.ravel()[at]
        is_before = (depth > 0) & (z < (1 - fixed.BACKDROP_ALIKE) * depth)
        is_behind = (depth > 0) & (z > (1 + fixed.BACKDROP_ALIKE) * depth)
        difference = np.abs(self.color.reshape(-1, 3)[at] - colors).mean(axis=1)
        return np.where(is_before, 1.0, difference), np.asarray(is_in & ~is_behind)
