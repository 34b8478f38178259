"""Exact RGB-D images by ray casting: depth at pixel centres, colour from four rays."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.kernels.surface_image import SurfaceMesh, SurfaceScene, render_surface
from splatctrl_cli.records import Bool, Float32, Float64, Index, Integers, Intrinsics, UInt8
from splatctrl_cli.simulate.primitives import Primitive, Texture, hit, normals

# Offsets of the rays of a pixel from its centre [px]: the centre (depth) first, then four for colour.
OFFSETS = ((0.0, 0.0), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])  # direction to the light, world
AMBIENT = 0.62
FACES_AT_ONCE = 32_000  # of meshes: their numbers are 16 bits wide


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A fixed camera: T_world_camera (4, 4), optical frame; is_training False for scoring only."""

    name: str
    intrinsics: Intrinsics
    T_world_camera: Float64
    is_training: bool


@dataclass(frozen=True, kw_only=True)
class Meshes:
    """Triangles (F, 3, 3) [m], counter-clockwise from outside, in link frames.

    owners (F,): index into `links`; textures: by link; T_world_link (L, 4, 4).
    """

    links: tuple[str, ...]
    triangles: Float64
    owners: Integers
    textures: tuple[Texture, ...]
    T_world_link: Float64

    def at(self, poses: Mapping[str, Float64]) -> "Meshes":
        """The meshes with links at poses (4, 4) by name."""
        return replace(self, T_world_link=np.array([poses[link] for link in self.links]).reshape(-1, 4, 4))


class Renderer:
    """Renderer of one camera; static solids are cast once.

    Rays have unit length along the optical axis: t is depth [m]. `color_rays` rays give a pixel's colour (0: depth's
    ray).
    """

    def __init__(self, camera: Camera, static: Sequence[Primitive], *, color_rays: int = 4) -> None:
        self.camera = camera
        k = camera.intrinsics
        v, u = np.mgrid[: k.height, : k.width].astype(np.float64)
        rays = [
            np.stack([(u + du - k.cx) / k.fx, (v + dv - k.cy) / k.fy, np.ones_like(u)], -1)
            for du, dv in OFFSETS[: 1 + color_rays]
        ]
        self._directions = np.stack(rays) @ camera.T_world_camera[:3, :3].T  # (5, H, W, 3), world
        shape = self._directions.shape[:3]
        self._depth = np.full(shape, np.inf)
        self._color = np.zeros((*shape, 3))
        self._cast(static, self._depth, self._color)

    def image(self, moving: Sequence[Primitive], meshes: Meshes | None = None) -> tuple[UInt8, Float32]:
        """Colour (H, W, 3) uint8 and depth (H, W) float32 [m], 0 = none."""
        depth, color = self._depth.copy(), self._color.copy()
        self._cast(moving, depth, color)
        for ray, mine, faces in self._nearest_faces(meshes, depth):
            color[ray][mine] = self._shaded_faces(meshes, depth[ray][mine], self._directions[ray][mine], faces)
        mean = np.mean(color[1:] if len(color) > 1 else color, axis=0)
        at_center = np.where(np.isfinite(depth[0]), depth[0], 0)
        return np.rint(mean * 255).astype(np.uint8), at_center.astype(np.float32)

    def depth(self, moving: Sequence[Primitive], meshes: Meshes | None = None) -> Float32:
        depth = self._depth[:1].copy()
        self._nearest(moving, depth)
        for _ in self._nearest_faces(meshes, depth):
            pass
        return np.where(np.isfinite(depth[0]), depth[0], 0).astype(np.float32)

    def _cast(self, primitives: Sequence[Primitive], depth: Float64, color: Float64) -> None:
        origin = self.camera.T_world_camera[:3, 3]
        owner = self._nearest(primitives, depth)
        for index, primitive in enumerate(primitives):
            mine = owner == index
            if mine.any():
                color[mine] = shaded(primitive, origin + depth[mine][:, None] * self._directions[mine])

    def _nearest(self, primitives: Sequence[Primitive], depth: Float64) -> Index:
        """Lower `depth` (K, H, W); index of the nearest primitive, or -1."""
        origin = self.camera.T_world_camera[:3, 3]
        owner = np.full(depth.shape, -1)
        for index, primitive in enumerate(primitives):
            window = self._window(primitive)
            directions = self._directions[: len(depth)][window]
            t = hit(primitive, origin, directions.reshape(-1, 3)).reshape(directions.shape[:3])
            is_nearer = t < depth[window]
            depth[window][is_nearer] = t[is_nearer]
            owner[window][is_nearer] = index
        return owner

    def _nearest_faces(self, meshes: Meshes | None, depth: Float64) -> Iterator[tuple[int, Bool, Integers]]:
        """Lower `depth` (K, H, W); per ray, pixels of nearer triangles, and their numbers."""
        if meshes is None:
            return
        k = self.camera.intrinsics
        T_camera = invert_transform(self.camera.T_world_camera) @ meshes.T_world_link
        nothing = np.zeros((k.height, k.width), np.float32)
        for ray, (du, dv) in enumerate(OFFSETS[: len(depth)]):
            at_ray = np.array([k.fx, k.fy, k.cx - du, k.cy - dv, k.width, k.height], np.float64)
            for first in range(0, len(meshes.owners), FACES_AT_ONCE):
                part = slice(first, first + FACES_AT_ONCE)
                owners = meshes.owners[part]
                scene = SurfaceScene(
                    solids=np.zeros((0, 16)),
                    solid_links=np.zeros(0, np.int16),
                    mesh=SurfaceMesh(meshes.triangles[part], np.arange(len(owners), dtype=np.int16)),
                    link_poses=np.ascontiguousarray(T_camera[owners, :3]),
                )
                seen = render_surface(scene, at_ray, nothing, tolerance=0.0, quadratic=0.0)
                mine = (seen.link >= 0) & (seen.depth < depth[ray])
                depth[ray][mine] = seen.depth[mine]
                yield ray, mine, first + seen.link[mine].astype(np.int64)

    def _shaded_faces(self, meshes: Meshes | None, depth: Float64, directions: Float64, faces: Integers) -> Float64:
        """RGB (R, 3) at depths (R,) along directions (R, 3), on triangles (R,)."""
        assert meshes is not None
        points_world = self.camera.T_world_camera[:3, 3] + depth[:, None] * directions
        a, b, c = np.moveaxis(meshes.triangles[faces], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        color, owners = np.zeros((len(faces), 3)), meshes.owners[faces]
        for link in np.unique(owners):
            mine = owners == link
            T_link_world = invert_transform(meshes.T_world_link[link])
            points_link = points_world[mine] @ T_link_world[:3, :3].T + T_link_world[:3, 3]
            color[mine] = lit(meshes.textures[link], points_link, normal[mine], T_link_world)
        return color

    def _window(self, primitive: Primitive) -> tuple[slice, slice, slice]:
        k = self.camera.intrinsics
        middle = (invert_transform(self.camera.T_world_camera) @ primitive.T_world_shape[:, 3])[:3]
        radius = primitive.bounding_radius
        everything = slice(None)
        if middle[2] - radius < 0.05:
            return everything, everything, everything
        slices = []
        for axis, focal, center, size in ((1, k.fy, k.cy, k.height), (0, k.fx, k.cx, k.width)):
            ends = [
                (middle[axis] + side * radius) / (middle[2] + end * radius) for side in (-1, 1) for end in (-1, 1)
            ]
            low, high = focal * min(ends) + center - 1, focal * max(ends) + center + 2
            slices.append(slice(int(np.clip(low, 0, size)), int(np.clip(high + 1, 0, size))))
        return everything, slices[0], slices[1]


def shaded(primitive: Primitive, points_world: Float64) -> Float64:
    """RGB (R, 3) in [0, 1] of surface points (R, 3)."""
    T_shape_world = invert_transform(primitive.T_world_shape)
    points_shape = points_world @ T_shape_world[:3, :3].T + T_shape_world[:3, 3]
    return lit(primitive.texture, points_shape, normals(primitive, points_shape), T_shape_world)


def lit(texture: Texture, points_shape: Float64, normals_shape: Float64, T_shape_world: Float64) -> Float64:
    """RGB (R, 3) in [0, 1]: a texture under a distant light, for any viewer."""
    facing = normals_shape @ (T_shape_world[:3, :3] @ LIGHT)
    light = AMBIENT + (1 - AMBIENT) * np.maximum(facing, 0)
    return np.asarray(texture.color(points_shape) * light[:, None])
