"""One depth image into the occupancy grid."""

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.measure import Limit, Options, Result, medians
from benchmarks.scenes import VGA, sample_robot
from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.geometry import back_project, look_at, transform_points
from splatctrl_cli.records import Box, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import posture_of
from splatctrl_cli.scene.self_mask import self_mask
from splatctrl_cli.simulate.recording import Recording, RecordingOptions
from splatctrl_cli.simulate.tabletop import WAYPOINTS
from tests.plain import plain_frame

SIDES = {"typical": 1.7, "reach": 2.9, "empty": 8.0}  # [m] of the workspace: a table's, a long arm's, a hall's


def run(options: Options) -> Result:
    """Integrate 640x480 pixels of a floor into 2 cm voxels; compare with numpy that marks only hits."""
    frame = _floor_frame(look_at((1.2, 0.0, 1.2), (0.0, 0.0, 0.0)))
    grids = {(name, threads): _grid(side, threads) for name, side in SIDES.items() for threads in (1, 2)}
    reach = grids["reach", 1]
    hits, lower = np.zeros(reach.log_odds.shape, np.float32), reach.origin - reach.config.voxel / 2
    tasks: dict[str, Callable[[], object]] = {
        f"{name}_threads_{threads}": partial(grid.integrate, frame) for (name, threads), grid in grids.items()
    }
    tasks["numpy"] = lambda: _numpy_hits(hits, frame, lower, reach.config.voxel)
    tasks["self_mask"] = _self_mask_task()
    times = medians(tasks, options.rounds(30))
    rows = [
        ["hits and free space", "x".join(map(str, grid.log_odds.shape)), str(threads),
         f"{1e3 * times[f'{name}_threads_{threads}']:.2f}"]
        for (name, threads), grid in grids.items()
    ]  # fmt: skip
    rows.append(["hits alone, numpy", "x".join(map(str, hits.shape)), "1", f"{1e3 * times['numpy']:.2f}"])
    rows.append(["pixels of the sample arm", "", "1", f"{1e3 * times['self_mask']:.2f}"])
    return Result(
        title="occupancy: one 640x480 depth image into voxels of 2 cm, and its pixels of the robot",
        columns=("what", "voxels", "threads", "ms"),
        rows=rows,
        figures={f"{name}_ms": 1e3 * seconds for name, seconds in times.items()},
        ratios={"over_numpy_hits": times["numpy"] / times["reach_threads_1"]},
        limits=[
            Limit(figure="typical_threads_2_ms", bound=10.0),
            Limit(figure="reach_threads_2_ms", bound=10.0),
            Limit(figure="self_mask_ms", bound=3.0),
        ],
    )


def _self_mask_task() -> Callable[[], object]:
    """The sample arm at its first waypoint, as camera 0 of the sample scene sees it."""
    model, q = sample_robot(), np.array(WAYPOINTS[0])
    (frame,) = Recording(RecordingOptions(width=640, height=480, color_rays=0), model).frames_at(0, q, ["cam0"])
    return partial(self_mask, frame, posture_of(model, q, {frame.stamp_ns: q}), OccupancyConfig())


def _grid(side: float, threads: int) -> OccupancyMap:
    box = Box(lower=np.array([-side / 2, -side / 2, -0.5]), upper=np.array([side / 2, side / 2, side - 0.5]))
    return OccupancyMap(box, OccupancyConfig(), threads)


def _floor_frame(T_world_camera: Float64) -> RgbdFrame:
    """A camera's frame of the plane z = 0, without depth above the horizon."""
    rays = back_project(VGA, np.ones((VGA.height, VGA.width))) @ T_world_camera[:3, :3].T
    down = np.minimum(rays[..., 2], -1e-6)
    depth = -T_world_camera[2, 3] / down
    return plain_frame(np.where(depth < 10.0, depth, 0.0), VGA, T_world_camera)


def _numpy_hits(hits: Float32, frame: RgbdFrame, lower: Float64, voxel: float) -> None:
    points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))
    cell = np.floor((points - lower) / voxel).astype(np.int64)[frame.depth > 0]
    inside = cell[np.all((cell >= 0) & (cell < hits.shape), axis=1)]
    np.add.at(hits, tuple(inside.T), np.float32(1.0))
