"""A scene in three dimensions as a page shows it: splats by time, an arm that moves among them, what decided."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels.surface_image import BALL, BOX, CAPSULE
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import Float32, Float64, SplatSet
from splatctrl_cli.robot.surface import RobotSurface

SIDES = 24  # of a cylinder or capsule as it is drawn


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Triangles: vertices (V, 3) float32 [m], faces (F, 3) uint32."""

    vertices: Float32
    faces: NDArray[np.uint32]


@dataclass(frozen=True, kw_only=True)
class SplatsAt:
    """The splats that were known from `time_s` [s] of the motion on."""

    time_s: float
    splats: SplatSet


@dataclass(frozen=True, kw_only=True)
class Motion:
    """An arm over T states: seconds (T,) since the first; the bodies (L) of its links by name, each in its link's
    frame; poses (T, L, 4, 4), world; path (T, 3) [m], world, of the end effector; clearance (T,) [m], NaN where it
    is not known; margin [m].
    """

    seconds: Float64
    bodies: dict[str, Surface]
    poses: Float64
    path: Float64
    clearance: Float64
    margin: float


@dataclass(frozen=True, kw_only=True)
class Deciding:
    """What decided a verdict: in words, when [s], where (3,) [m], world, and the sphere of the arm that came there,
    its centre (3,) and radius [m], None where the robot is not known.
    """

    sentence: str
    time_s: float
    place: Float64
    sphere: tuple[Float64, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Space:
    """What a three-dimensional page shows, in the world frame [m].

    splats: by time, the first from the start on. unknown: centres (K, 3) of cubes of edge `voxel` never seen.
    surface: where a baked distance is 0.
    """

    splats: Sequence[SplatsAt] = ()
    unknown: Float32 | None = None
    voxel: float = 0.0
    surface: Surface | None = None
    motion: Motion | None = None
    deciding: Deciding | None = None

    def box(self) -> tuple[Float64, Float64]:
        """The lower and upper corner (3,) of what there is to see: nine tenths of the splats, path and surface."""
        parts = [np.asarray(at.splats.centers, np.float64) for at in self.splats]
        if self.motion is not None:
            parts += [self.motion.path, self.motion.poses[:, :, :3, 3].reshape(-1, 3)]
        if self.surface is not None:
            parts.append(np.asarray(self.surface.vertices, np.float64))
        points = np.concatenate([np.zeros((0, 3)), *parts])
        if not len(points):
            return np.full(3, -0.5), np.full(3, 0.5)
        lower, upper = np.percentile(points, [5, 95], axis=0)
        return lower, upper


def bodies_of(surface: RobotSurface) -> dict[str, Surface]:
    """The collision geometry of each link of a robot as triangles, in its frame."""
    parts: dict[str, list[trimesh.Trimesh]] = {}
    for kind, size, T, link in zip(
        surface.kinds, surface.sizes, surface.T_link_solid, surface.solid_links, strict=True
    ):
        parts.setdefault(surface.links[link], []).append(_primitive(kind, size).apply_transform(T))
    for number in np.unique(surface.triangle_links):
        corners = surface.triangles[surface.triangle_links == number]
        mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners), process=True)
        parts.setdefault(surface.links[number], []).append(mesh)
    return {link: _as_surface(trimesh.util.concatenate(meshes)) for link, meshes in parts.items()}


def _primitive(kind: float, size: Float64) -> "trimesh.Trimesh":
    """size (3,): half edges of a box; radius and half length of a cylinder or capsule; radius of a ball."""
    if kind == BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == BALL:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == CAPSULE:
        made = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[SIDES, SIDES // 2])
        return made.apply_translation([0.0, 0.0, -made.bounds.mean(axis=0)[2]])
    return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=SIDES)


def _as_surface(mesh: "trimesh.Trimesh") -> Surface:
    return Surface(vertices=np.asarray(mesh.vertices, np.float32), faces=np.asarray(mesh.faces, np.uint32))


def coarsened(is_unknown: NDArray[np.bool_], origin: Float64, voxel: float, most: int) -> tuple[Float32, float]:
    """Centres (K, 3) [m] and edge [m] of at most `most` cubes for the voxels (X, Y, Z) that are unknown and border on
    one that is not: the rest lies behind them. Cubes of 2, 3, ... voxels a side, unknown by half or more.
    """
    factor = 1
    while True:
        shape = np.array(is_unknown.shape) // factor
        blocks = is_unknown[tuple(slice(0, n * factor) for n in shape)]
        cells = blocks.reshape(shape[0], factor, shape[1], factor, shape[2], factor)
        full = 2 * cells.sum(axis=(1, 3, 5), dtype=np.int32) >= factor**3
        borders = np.argwhere(full & ~_inner(full))
        if len(borders) <= most:
            centers = origin + voxel * (factor * borders + (factor - 1) / 2)
            return np.asarray(centers, np.float32), factor * voxel
        factor += 1


def _inner(full: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells whose six neighbours are full; what lies outside the grid counts as full."""
    padded = np.pad(full, 1, constant_values=True)
    inner = np.ones_like(full)
    for axis in range(3):
        for shift in (0, 2):
            where = [slice(1, -1)] * 3
            where[axis] = slice(shift, shift + full.shape[axis])
            inner &= padded[tuple(where)]
    return inner
