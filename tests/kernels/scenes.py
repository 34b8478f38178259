"""A camera and splats, and bytes of what is asked of points: without torch, which takes seconds to import."""

import numpy as np

from splatctrl_cli.geometry import invert_transform, look_at
from splatctrl_cli.kernels import points as kernels
from splatctrl_cli.kernels.raster import Float32, Float64, Moments, Rasteriser, TargetView, pack_camera
from splatctrl_cli.records import Bool

STILL = np.eye(4)
Arrays = tuple[Float32, Float32, Float32, Float32]


def camera(width: int = 45, height: int = 37, motion: Float64 = STILL) -> Float64:
    """Off-centre principal point, sizes that are no multiple of a tile."""
    return pack_camera(
        50.0, 48.0, 24.3, 16.1, width, height, invert_transform(motion @ look_at((0.9, 0.2, 0.6), (0.0, 0.0, 0.05)))
    )


def splats(count: int = 60, seed: int = 0) -> Arrays:
    rng = np.random.default_rng(seed)
    centers = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.3], (count, 3)).astype(np.float32)
    radii = rng.uniform(0.01, 0.08, count).astype(np.float32)
    opacities = rng.uniform(0.02, 0.98, count).astype(np.float32)
    return centers, radii, opacities, rng.uniform(0, 1, (count, 3)).astype(np.float32)


def moments(count: int) -> Moments:
    """Of splats that have not moved."""
    return Moments(
        first=np.zeros((count, 8), np.float32),
        second=np.zeros((count, 8), np.float32),
        num_steps=np.zeros(count, np.uint32),
    )


def target(width: int = 83, height: int = 61, seed: int = 0) -> TargetView:
    """A noisy image, depth with holes, and a tenth of the pixels that do not count."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.4, 1.5, (height, width)).astype(np.float32)
    depth[rng.uniform(size=depth.shape) < 0.3] = 0.0
    counted = (rng.uniform(size=depth.shape) < 0.9).astype(np.uint8)
    return TargetView(color=rng.integers(0, 256, (3, height, width), np.uint8), depth=depth, counted=counted)


def visible(raster: Rasteriser) -> Bool:
    """Splats (N,) with a part in the view that `raster` has prepared."""
    out = np.empty(len(raster._inputs[1]), np.uint8)
    raster.native.visible(out)
    return out.astype(bool)


def points_bytes() -> bytes:
    """For another instruction set: all of the above on one crowd."""
    rng = np.random.default_rng(3)
    points, colors = rng.normal(size=(9000, 3)).astype(np.float32), rng.random((9000, 3)).astype(np.float32)
    T, cubes = look_at([2.0, 0.1, 0.3], [0.0, 0.0, 0.0]), kernels.Cubes(points, 0.2, 2)
    camera, depth = pack_camera(50.3, 51.7, 31.5, 24.1, 64, 48, T), rng.uniform(0.5, 4.0, (48, 64)).astype(np.float32)
    means, solid = cubes.means(colors), np.array([[1.0, *T[:3, :3].ravel(), *T[:3, 3], 0.3, 0.4, 0.5]])
    arrays = [
        kernels.back_projected(camera, depth),
        kernels.seen_through(points, [camera], [depth], 0.01),
        kernels.are_inside(camera, depth, np.full(3, -1.0), np.ones(3), 0.7),
        *kernels.pixels_at(points, camera),
        *(means.count, means.center, means.color, means.square, means.covariance, means.nearest),
        kernels.SplatTree(points, colors[:, 0] * np.float32(0.1), 2).are_further(colors.astype(float), 0.05),
        kernels.solid_distance(points, solid),
    ]
    return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
