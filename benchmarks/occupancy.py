"""One depth image into the occupancy grid."""

import numpy as np

from benchmarks.measure import Options, Result, medians
from benchmarks.scenes import VGA
from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.geometry import back_project, look_at, transform_points
from splatctrl_cli.records import Box, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.occupancy import OccupancyMap

SIDE = 2.9  # [m] of the workspace


def run(options: Options) -> Result:
    """640x480 pixels that see a floor, into 2 cm voxels; beside it the hits alone in numpy, without free space."""
    box = Box(lower=np.array([-SIDE / 2, -SIDE / 2, -0.5]), upper=np.array([SIDE / 2, SIDE / 2, SIDE - 0.5]))
    frame = _floor_frame(look_at((1.2, 0.0, 1.2), (0.0, 0.0, 0.0)))
    config = OccupancyConfig()
    grids = {threads: OccupancyMap(box, config, threads) for threads in (1, 2)}
    hits = np.zeros(grids[1].log_odds.shape, np.float32)
    times = medians(
        {
            "one": lambda: grids[1].integrate(frame),
            "two": lambda: grids[2].integrate(frame),
            "numpy": lambda: _numpy_hits(hits, frame, box.lower, config.voxel),
        },
        options.rounds(30),
    )
    cells = "x".join(map(str, hits.shape))
    return Result(
        title=f"occupancy: one 640x480 depth image into {cells} voxels of 2 cm",
        columns=("what", "threads", "ms"),
        rows=[
            ["hits and free space (ray stride 2)", "1", f"{1e3 * times['one']:.2f}"],
            ["hits and free space (ray stride 2)", "2", f"{1e3 * times['two']:.2f}"],
            ["hits alone, numpy", "1", f"{1e3 * times['numpy']:.2f}"],
        ],
        figures={
            "threads_1_ms": 1e3 * times["one"],
            "threads_2_ms": 1e3 * times["two"],
            "numpy_hits_ms": 1e3 * times["numpy"],
        },
        ratios={"over_numpy_hits": times["numpy"] / times["one"]},
    )


def _floor_frame(T_world_camera: Float64) -> RgbdFrame:
    """What a camera sees of the plane z = 0; no depth where it looks above the horizon."""
    rays = back_project(VGA, np.ones((VGA.height, VGA.width))) @ T_world_camera[:3, :3].T
    down = np.minimum(rays[..., 2], -1e-6)
    depth = -T_world_camera[2, 3] / down
    return RgbdFrame(
        stamp_ns=0,
        camera="cam",
        color=np.zeros((VGA.height, VGA.width, 3), np.uint8),
        depth=np.where(depth < 10.0, depth, 0.0).astype(np.float32),
        intrinsics=VGA,
        T_world_camera=T_world_camera,
    )


def _numpy_hits(hits: Float32, frame: RgbdFrame, lower: Float64, voxel: float) -> None:
    points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))
    cell = np.floor((points - lower) / voxel).astype(np.int64)[frame.depth > 0]
    inside = cell[np.all((cell >= 0) & (cell < hits.shape), axis=1)]
    np.add.at(hits, tuple(inside.T), np.float32(1.0))
