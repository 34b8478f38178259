"""The bend of a depth camera's image: an offset of disparity, the same in all its views, smooth over the image.

A camera that triangulates errs in disparity, by what its lenses were not calibrated for; surfaces come out bent,
more so the farther they are. What the offset has in common with a plane of the image, (1, u, v), is no bend but a
projective map of space, which poses would take up: it is left as recorded. After Zhou and Koltun, Simultaneous
localization and calibration (2014), whose lattice stands in space instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.sparse import csr_array

from splatctrl_cli.calibration.gray_views import GrayView, Rows
from splatctrl_cli.calibration.unknowns import HELD
from splatctrl_cli.calibration.views import surface_normals
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import project
from splatctrl_cli.records import Float64, Index, RgbdFrame


def stretch(depth: Float64, offset: Float64) -> tuple[Float64, Float64]:
    """By what factor depths (...) [m] change with an offset (...) of disparity [1/m], ``1 / z' = 1 / z - offset``,
    the offset at most `BEND_MOST` of the disparity; and how the factor's logarithm changes with it [m].
    """
    share = offset * depth
    factor = 1 / (1 - np.clip(share, -fixed.BEND_MOST, fixed.BEND_MOST))
    return factor, np.where(np.abs(share) < fixed.BEND_MOST, factor * depth, 0.0)


def unbent(frame: RgbdFrame, grid: Float64) -> RgbdFrame:
    """The frame with its depth freed of a bend: offsets of disparity (rows, columns) [1/m], bilinear between them."""
    offset = (_weights(frame.depth.shape) @ grid.ravel()).reshape(frame.depth.shape)
    factor, _ = stretch(frame.depth.astype(np.float64), offset)
    return replace(frame, depth=(frame.depth * factor).astype(np.float32))


def largest_share(grid: Float64, depth: float) -> float:
    """The largest correction by a grid, as a share of a depth [m]."""
    return float(np.abs(stretch(np.full_like(grid, depth), grid)[0] - 1).max())


def _weights(shape: tuple[int, ...]) -> csr_array:
    """(H W, G): of the grid's G nodes at each pixel; the first and the last stand at the image's edges."""
    rows, columns = fixed.BEND_GRID
    at = [np.arange(size) * (nodes - 1) / size for size, nodes in zip(shape, (rows, columns), strict=True)]
    low = [x.astype(np.int64) for x in at]
    part = [x - i for x, i in zip(at, low, strict=True)]
    values, nodes = [], []
    for down in (0, 1):
        for right in (0, 1):
            along_v, along_u = (part[k] if step else 1 - part[k] for k, step in enumerate((down, right)))
            values.append(np.outer(along_v, along_u).ravel())
            nodes.append(((low[0] + down)[:, None] * columns + low[1] + right).ravel())
    pixels = np.arange(shape[0] * shape[1])
    return csr_array(
        (np.stack(values, axis=1).ravel(), np.stack(nodes, axis=1).ravel(), 4 * np.arange(len(pixels) + 1)),
        shape=(len(pixels), rows * columns),
    )


def _roughness() -> Float64:
    """(G, G): the sum of squares of the second differences of a grid is ``c^T S c``."""
    rows, columns = fixed.BEND_GRID
    nodes = np.eye(rows * columns).reshape(rows, columns, -1)
    twist = nodes[1:, 1:] - nodes[1:, :-1] - nodes[:-1, 1:] + nodes[:-1, :-1]
    parts = (np.diff(nodes, 2, axis=0), np.diff(nodes, 2, axis=1), np.sqrt(2) * twist)
    D = np.concatenate([part.reshape(-1, rows * columns) for part in parts])
    return np.asarray(D.T @ D)


def bends_alone() -> Float64:
    """(G, G - 3): an orthonormal basis of grids without a part in (1, u, v)."""
    v, u = np.indices(fixed.BEND_GRID).reshape(2, -1)
    return np.asarray(null_space(np.stack([np.ones(len(u)), u, v])))


@dataclass(kw_only=True)
class BentViews:
    """Views, and the bends of their cameras (C, G), solved for: `cameras` (N,) numbers them, `HELD` for one whose
    depth is taken as it is. now: the views freed of the bends as they are known.
    """

    recorded: Sequence[GrayView]
    cameras: Sequence[int]

    def __post_init__(self) -> None:
        self.now = list(self.recorded)
        shapes = {view.gray.shape for view in self.recorded}
        self._weights = {shape: _weights(shape) for shape in shapes}
        self._pixels = [_pixels(view) for view in self.recorded]
        self._basis, self._num = bends_alone(), max(self.cameras) + 1
        prior = (_roughness() + np.eye(len(self._basis))) / fixed.BEND_PRIOR**2
        self._prior = self._basis.T @ prior @ self._basis
        self._free = np.zeros((self._num, self._basis.shape[1]))
        self._bend()

    @property
    def grids(self) -> Float64:
        """Offsets of disparity (C, rows, columns), of the views' lengths."""
        return (self._free @ self._basis.T).reshape(self._num, *fixed.BEND_GRID)

    def equations(self, size: int, num_pairs: int) -> "BendEquations":
        """Those of one round, beside `size` unknowns of poses, that are to be filled by so many pairs of views."""
        num = self._num * len(self._basis)
        cross, own, slope = np.zeros((size, num)), np.zeros((num, num)), np.zeros(num)
        return BendEquations(views=self, num_pairs=num_pairs, cross=cross, own=own, slope=slope)

    def by_offsets(self, i: int, j: int, rows: Rows) -> csr_array:
        """(R, C G): how the residuals of view i on view j change with the offsets at the nodes."""
        size, parts = len(self._basis), []
        own = self._pixels[i][rows.own]
        for k, pixels, by_stretch in ((i, own, rows.by_own), (j, rows.other, rows.by_other)):
            if self.cameras[k] == HELD:
                parts.append(csr_array((len(pixels), self._num * size)))
                continue
            weights = self._weights[self.recorded[k].gray.shape][pixels]
            values = weights.data * np.repeat(by_stretch * self._reach[k][pixels], 4)
            nodes = weights.indices + self.cameras[k] * size
            parts.append(csr_array((values, nodes, weights.indptr), shape=(len(pixels), self._num * size)))
        return parts[0] + parts[1]

    def joined(self, H: Float64, g: Float64, bent: "BendEquations") -> tuple[Float64, Float64]:
        """The normal equations of poses, H (P, P) and g (P,), with those of the bends in what is free of them."""
        Q = np.kron(np.eye(self._num), self._basis)
        R = bent.num_pairs * np.kron(np.eye(self._num), self._prior)
        cross = bent.cross @ Q
        whole = np.block([[H, cross], [cross.T, Q.T @ bent.own @ Q + R]])
        return whole, np.concatenate([g, Q.T @ bent.slope + R @ self._free.ravel()])

    def move(self, step: Float64) -> None:
        """Take a step in the coordinates that are free."""
        self._free += step.reshape(self._free.shape)
        self._bend()

    def _bend(self) -> None:
        grids, self._reach = self.grids, []
        for k, view in enumerate(self.recorded):
            if self.cameras[k] == HELD:
                self._reach.append(np.zeros(0))
                continue
            offset = self._weights[view.gray.shape] @ grids[self.cameras[k]].ravel()
            depth, pixels = view.depth, self._pixels[k]
            factor, reach = stretch(depth.surface[..., 2].ravel(), offset)
            self._reach.append(reach)
            surface = depth.surface * factor.reshape(*view.gray.shape, 1)
            normals = surface_normals(surface, 2)
            normals[~np.any(depth.normals != 0, axis=-1)] = 0.0
            self.now[k] = replace(view, depth=replace(
                depth, surface=surface, normals=normals, points=surface.reshape(-1, 3)[pixels],
                point_normals=normals.reshape(-1, 3)[pixels],
            ))  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BendEquations:
    """The normal equations of one round: of poses and offsets together, cross (P, C G), and of offsets alone, own
    (C G, C G) and slope (C G,).
    """

    views: BentViews
    num_pairs: int
    cross: Float64
    own: Float64
    slope: Float64

    def add(self, i: int, j: int, rows: Rows, columns: Index, J: Float64) -> None:
        """Those of view i on view j, whose derivatives J (R, F) by poses stand in `columns` (F,)."""
        by_offsets = self.views.by_offsets(i, j, rows)
        self.cross[columns] += (by_offsets.T @ J).T
        square = (by_offsets.T @ by_offsets).tocoo()
        self.own[square.row, square.col] += square.data
        self.slope[:] += by_offsets.T @ rows.residuals

    def joined(self, H: Float64, g: Float64) -> tuple[Float64, Float64]:
        """The equations of poses H (P, P), g (P,), and these."""
        return self.views.joined(H, g, self)


def _pixels(view: GrayView) -> Index:
    """By number (K,), those that the view's points are at."""
    u, v = np.round(project(view.depth.lens, view.depth.points)).astype(np.int64).T
    return np.asarray(v * view.gray.shape[1] + u)
