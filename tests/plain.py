"""Records and voxels of which a test says what matters; the rest is plain."""

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame, SplatSet
from splatctrl_cli.voxels import Balls, KnownVoxels, OccupancyGrid


def plain_frame(
    depth: ArrayLike,
    intrinsics: Intrinsics,
    T_world_camera: Float64 | None = None,
    *,
    stamp_ns: int = 0,
    camera: str = "cam0",
    color: ArrayLike = 0,
) -> RgbdFrame:
    """One depth [m] and colour for all pixels, or those of each; the camera at the world's origin."""
    shape = (intrinsics.height, intrinsics.width)
    return RgbdFrame(
        stamp_ns=stamp_ns,
        camera=camera,
        color=np.broadcast_to(np.asarray(color, np.uint8), (*shape, 3)).copy(),
        depth=np.broadcast_to(np.asarray(depth, np.float32), shape).copy(),
        intrinsics=intrinsics,
        T_world_camera=np.eye(4) if T_world_camera is None else T_world_camera,
    )


def plain_splats(
    centers: ArrayLike,
    radii: ArrayLike,
    *,
    colors: ArrayLike = 0.0,
    opacities: ArrayLike = 0.9,
    labels: ArrayLike = 0,
) -> SplatSet:
    """Splats around these points (N, 3) [m], each value for all of them or one for each; black objects."""
    points = np.asarray(centers, np.float32).reshape(-1, 3)
    num = len(points)
    return SplatSet(
        centers=points,
        radii=np.broadcast_to(np.asarray(radii, np.float32), num).copy(),
        colors=np.broadcast_to(np.asarray(colors, np.float32), (num, 3)).copy(),
        opacities=np.broadcast_to(np.asarray(opacities, np.float32), num).copy(),
        labels=np.broadcast_to(np.asarray(labels, np.uint8), num).copy(),
        density=np.zeros(num, np.float32),
    )


def plain_grid(
    shape: tuple[int, int, int],
    voxel: float,
    origin: ArrayLike,
    *,
    log_odds: ArrayLike = -2.0,
    num_updates: ArrayLike = 1,
    entity: ArrayLike = 0,
) -> OccupancyGrid:
    """Voxels of a size [m] from a first centre on, seen once and free."""
    return OccupancyGrid(
        origin=np.broadcast_to(np.asarray(origin, np.float64), 3).copy(),
        voxel=voxel,
        log_odds=np.broadcast_to(np.asarray(log_odds, np.float32), shape).copy(),
        num_updates=np.broadcast_to(np.asarray(num_updates, np.uint16), shape).copy(),
        entity=np.broadcast_to(np.asarray(entity, np.uint8), shape).copy(),
    )


def known(grid: OccupancyGrid, stamp_ns: int = 0, unrepresented: ArrayLike = (), label: int = 0) -> KnownVoxels:
    """`grid`, what of it was seen at `stamp_ns`, with balls of one label around voxel centres (K, 3) [m]."""
    centers = np.asarray(unrepresented, np.float32).reshape(-1, 3)
    return KnownVoxels(
        grid=grid,
        last_seen=(grid.num_updates > 0).astype(np.uint16),
        step_stamps_ns=np.array([stamp_ns], np.int64),
        unrepresented=Balls.from_voxels(centers, grid.voxel, np.full(len(centers), label, np.uint8)),
    )
