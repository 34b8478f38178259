"""Distance grids of known content: random channels that no two cells share, and a ball."""

import numpy as np

from splatctrl_cli.formats.grid.grid_format import CHANNELS, FORMAT, VERSION
from splatctrl_cli.records import DistanceGrid, Float64

SHAPE = (5, 4, 11)  # no two alike, none a multiple of eight
HEADER: dict[str, object] = {
    "format": FORMAT,
    "version": VERSION,
    "frame": "world",
    "sign": "positive outside",
    "unknown": "free",
    "distance": "safe",
    "length_scale": 0.02,
    "labels": ["human", "object"],
    "splats_used": {"object": 3},
    "note": 'a < "b" & ü:= c\nd',
}


def random_grid(*channels: str, shape: tuple[int, int, int] = SHAPE, seed: int = 0) -> DistanceGrid:
    """A grid with these channels (all where none is named) of noise."""
    rng = np.random.default_rng(seed)
    made = {}
    for name in channels or CHANNELS:
        kind = CHANNELS[name]
        size = kind.shape(shape)
        made[name] = rng.integers(0, 5, size, np.uint8) if kind.dtype == "|u1" else rng.normal(size=size)
        made[name] = made[name].astype(kind.dtype)
    return DistanceGrid(origin=np.array([-0.1, 0.2, 0.3]), voxel=0.02, channels=made, header=dict(HEADER))


def with_unknown(grid: DistanceGrid) -> DistanceGrid:
    """`grid` with a block of cells without a value in sdf and gradient, by its policy."""
    channels = {name: values.copy() for name, values in grid.channels.items()}
    for name in {"sdf", "gradient"} & channels.keys():
        channels[name][1:3, 2:3, 3:9] = np.nan
    header = {**grid.header, "unknown": "nan"}
    return DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=channels, header=header)


def centers(grid: DistanceGrid) -> Float64:
    """(X, Y, Z, 3) cell centres, world [m]."""
    axes = [grid.origin[i] + grid.voxel * np.arange(n) for i, n in enumerate(grid.channels["sdf"].shape)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def ball_grid(radius: float = 0.3, voxel: float = 0.04, shape: tuple[int, int, int] = (21, 22, 23)) -> DistanceGrid:
    """The distance to a ball around (0.1, 0, 0): channels sdf, hard, bound."""
    origin = np.array([0.1, 0.0, 0.0]) - 0.5 * voxel * (np.array(shape) - 1.2)
    grid = DistanceGrid(origin=origin, voxel=voxel, channels={"sdf": np.zeros(shape, "<f4")}, header=dict(HEADER))
    distance = np.linalg.norm(centers(grid) - (0.1, 0.0, 0.0), axis=-1) - radius
    grid.channels["sdf"] = distance.astype("<f4")
    grid.channels["hard"] = distance.astype("<f4")
    grid.channels["bound"] = (distance - np.sqrt(0.75) * voxel - 1e-6).astype("<f4")
    return grid
