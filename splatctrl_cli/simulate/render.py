"""Exact RGB-D images by ray casting: depth at pixel centres, colour from four rays.

Two models of an active-stereo camera make measured depth of exact depth.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, minimum_filter
from scipy.special import ndtr

from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.kernels.surface_image import SurfaceMesh, SurfaceScene, render_surface
from splatctrl_cli.records import Bool, Float32, Float64, Index, Integers, Intrinsics, UInt8
from splatctrl_cli.simulate.primitives import Primitive, Texture, hit, normals

WIDTH, FOCAL = 640, 386.0  # [px] of the two depth imagers of a RealSense D435
BASELINE = 0.05  # [m] between them; the second stands to the right
STEPS = 32  # of disparity in a pixel
EDGE = 0.5  # [px] of disparity between neighbours that are no longer one surface


@dataclass(frozen=True, kw_only=True)
class StereoDepth:
    """Depth measured by two imagers, in the image of a colour camera.

    - Disparity d = f b / z errs by `spread` [px], so depth errs by z^2 spread / (f b): with 0.07 px, 3.6 mm at 1 m.
      Errors r depth pixels apart correlate by exp(-(r / `window`)^2). Disparity steps are 1/32 px.
    - Next to an edge of 0.5 px or more, the background takes the foreground's depth over `fattening` depth pixels.
      The width is uniform between the two numbers, and constant within a window.
    - Background that the second imager does not see is lost: f b (1 / z_foreground - 1 / z_background) depth pixels
      left of the foreground, except those that took its depth.
    - A share `dropout` of all pixels is lost, in blobs twice as wide as the window; so are depths outside `least` to
      `most` [m].

    width [px]: of the imagers, scaling their focal length; None: as wide as the image.
    """

    spread: float = 0.07
    window: float = 2.5
    fattening: tuple[float, float] = (1.0, 3.0)
    dropout: float = 0.005
    least: float = 0.28
    most: float = 6.0
    width: int | None = None

    def applied(self, depth: Float32, rng: np.random.Generator, *, focal: float = 0.0) -> Float32:
        """Measured depth (H, W) [m] of exact `depth`, 0 = none.

        focal [px]: of the depth image; 0: of the imagers.
        """
        imager = FOCAL * (self.width or depth.shape[1]) / WIDTH
        scale = focal / imager if focal > 0 else 1.0  # pixels of the image per pixel of the imagers
        exact = np.where(depth > 0, imager * BASELINE / np.where(depth > 0, depth, 1.0), 0.0)
        sigma = 0.5 * scale * self.window  # blurred noise correlates by exp(-(r / 2 sigma)^2)
        error, wide, offset, lost = (_blur(rng, depth.shape, sigma * blob) for blob in (1, 2, 2, 2))
        low, high = self.fattening
        reach = np.floor(scale * (low + (high - low) * ndtr(wide)) + ndtr(offset)).astype(np.int64)
        seen = _fatten(exact, reach)
        is_lost = _is_hidden(depth, scale * imager * BASELINE) & (seen == exact)
        is_lost |= lost > np.quantile(lost, 1 - self.dropout)
        disparity = np.rint((seen + self.spread * error) * STEPS) / STEPS
        measured = imager * BASELINE / np.maximum(disparity, 1 / STEPS)
        is_lost |= (seen == 0) | (measured < self.least) | (measured > self.most)
        return np.where(is_lost, 0, measured).astype(np.float32)


def _blur(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Float64:
    impulse = np.zeros(min(shape))
    impulse[0] = 1.0
    kernel = gaussian_filter(impulse, sigma, mode="wrap")
    return np.asarray(gaussian_filter(rng.standard_normal(shape), sigma, mode="wrap") / (kernel @ kernel))


def _is_hidden(depth: Float32, focal_baseline: float) -> Bool:
    columns = np.arange(depth.shape[1])
    shifted = np.where(depth > 0, columns - focal_baseline / np.where(depth > 0, depth, 1.0), np.inf)
    least = np.minimum.accumulate(shifted[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(shifted > least + 0.5)  # [px]


def _fatten(disparity: Float64, reach: np.ndarray) -> Float64:
    out = disparity
    for radius in range(1, int(reach.max()) + 1):
        y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        largest = -minimum_filter(-disparity, footprint=np.hypot(x, y) <= radius + 0.5, mode="nearest")
        out = np.where((reach >= radius) & (largest - disparity > EDGE), largest, out)
    return out


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Errors of a depth camera like a D435, registered to colour.

    spread [m]: sigma at 1 m, growing with depth squared. step [m]: quantisation at 1 m. patch [px]: matching window,
    over which errors agree. dropout: share of pixels lost, in patch-sized blobs. edge [m]: depth step that loses both
    neighbours. max_range [m]: farther depth is lost. baseline [m]: of the imagers, to lose occluded depth (0: off).
    """

    spread: float = 0.0012
    step: float = 0.002
    patch: int = 6
    dropout: float = 0.005
    edge: float = 0.03
    max_range: float = 3.0
    baseline: float = 0.0

    def applied(self, depth: Float32, rng: np.random.Generator, *, focal: float = 0.0) -> Float32:
        """Noisy depth (H, W) [m] of exact `depth`, 0 = none.

        focal [px]: needed for a baseline.
        """
        coarse = (depth.shape[0] // self.patch + 3, depth.shape[1] // self.patch + 3)
        error = _enlarge(rng.standard_normal(coarse), self.patch, depth.shape)
        lost = _enlarge(rng.standard_normal(coarse), self.patch, depth.shape)
        exact = np.where(depth > 0, depth.astype(np.float64), 1.0)
        noisy = 1 / (self.step * np.rint((1 / exact + self.spread * error) / self.step))
        threshold = np.quantile(lost, 1 - self.dropout) if self.dropout > 0 else np.inf
        is_lost = (lost > threshold) | (depth <= 0) | (noisy > self.max_range) | _is_at_edge(depth, self.edge)
        if self.baseline > 0:
            is_lost |= _is_hidden(depth, focal * self.baseline)
        return np.where(is_lost, 0, noisy).astype(np.float32)


def _enlarge(coarse: np.ndarray, factor: int, shape: tuple[int, ...]) -> np.ndarray:
    v, u = np.arange(shape[0]) / factor, np.arange(shape[1]) / factor
    i, j = v.astype(int), u.astype(int)
    a, b = (v - i)[:, None], (u - j)[None]
    weights = ((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b)
    corners = ((0, 0), (0, 1), (1, 0), (1, 1))
    total = sum(w * coarse[np.ix_(i + di, j + dj)] for w, (di, dj) in zip(weights, corners, strict=True))
    return np.asarray(total / np.sqrt(sum(w**2 for w in weights)))


def _is_at_edge(depth: Float32, step: float) -> Bool:
    across, down = (np.abs(np.diff(depth, axis=axis)) > step for axis in (1, 0))
    sides = [np.pad(across, ((0, 0), pad)) for pad in ((1, 0), (0, 1))]
    sides += [np.pad(down, (pad, (0, 0))) for pad in ((1, 0), (0, 1))]
    return np.asarray(np.any(sides, axis=0))


# Offsets of the rays of a pixel from its centre [px]: the centre (depth) first, then four for colour.
OFFSETS = ((0.0, 0.0), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])  # direction to the light, world
AMBIENT = 0.62
FACES_AT_ONCE = 32_000  # of meshes: their numbers are 16 bits wide


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A fixed camera: T_world_camera (4, 4), optical frame; is_training: False for scoring."""

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

    Rays have unit length along the optical axis, so t is depth [m]. `color_rays` rays give a pixel's colour (0: the
    depth ray).
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
            if (mine := owner == index).any():
                color[mine] = shaded(primitive, origin + depth[mine][:, None] * self._directions[mine])

    def _nearest(self, primitives: Sequence[Primitive], depth: Float64) -> Index:
        """Lower `depth` (K, H, W) to primitives; return the nearest one's index, or -1."""
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
        """Lower `depth` (K, H, W) to triangles; yield, per ray, pixels of nearer triangles and their numbers."""
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
