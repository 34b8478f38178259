"""Small valid folders for `benchmarks.fuzz`: dataset layouts, scans, scenes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.files.output import write_json
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.geometry import look_at
from splatctrl_cli.recording.folder.dtu import DtuView, write_dtu
from splatctrl_cli.recording.folder.idr import write_idr
from splatctrl_cli.records import Intrinsics, SplatSet
from splatctrl_cli.voxels import OccupancyGrid
from tests.plain import known, plain_grid, plain_splats
from tests.recording.folder.make_layout import (
    make_bop,
    make_frames,
    make_nerfstudio,
    make_redwood,
    make_scannet,
    make_tum,
)

Commands = tuple[tuple[str, ...], ...]

LAYOUTS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "tum": ("rgbd_dataset_freiburg3_x", make_tum),  # whose camera is known by the folder's name
    "open3d": ("scene", make_redwood),
    "7-scenes": ("scene", make_frames),
    "scannet": ("scene", make_scannet),
    "bop": ("scene", make_bop),
    "nerfstudio": ("scene", make_nerfstudio),
}
INFO, CHECK, INGEST = ("info", "IN"), ("check", "IN"), ("ingest", "IN", "-o", "OUT.capture")
LENS = ("--intrinsics", "camera=10,11,3.5,2.5")  # for layouts that have none of their own


@dataclass(frozen=True)
class Row:
    """Of an audit."""

    stamp_ns: int


def layout_folders(folder: Path) -> dict[str, tuple[Path, Commands]]:
    """A folder of each dataset layout, and what reads it."""
    made: dict[str, tuple[Path, Commands]] = {}
    for name, (leaf, make) in LAYOUTS.items():
        path = folder / name / leaf
        path.mkdir(parents=True)
        lens = LENS if name == "7-scenes" else ()
        made[name] = (make(path), (INFO, (*CHECK, *lens), (*INGEST, *lens)))
    return made


def scans(folder: Path, scene: Path) -> dict[str, tuple[Path, Commands]]:
    """A scan of three views in MVSNet's and in IDR's layout, scored against the scene."""
    views = [_view(number) for number in range(3)]
    write_dtu(folder / "mvsnet", "scan7", views)
    write_idr(folder / "idr", "scan7", views)
    score = ("score", str(scene), "--dtu", "IN", "--holdout", "2", "--allow-other-recording", "--threads", "1")
    with_out = (*score, "-o", "OUT")
    return {
        "mvsnet": (folder / "mvsnet", ((*score, "--allow-training"), with_out)),
        "idr": (folder / "idr", ((*score, "--allow-training"), with_out)),
    }


def scene_folder(folder: Path) -> tuple[Path, Commands]:
    """A scene as `reconstruct` leaves it, and what reads it."""
    folder.mkdir()
    writer = SceneWriter(folder, {"frame": "world"})
    grid, splats = _occupancy(), _splats()
    for stamp in (100, 200):
        writer.audit(Row(stamp))
        writer.snapshot(stamp, splats, known(grid, stamp), grid.states(0.3, 0.7))
    writer.finish(200, splats, known(grid, 200))
    writer.checkpoint({}, {"a": np.arange(4)}, is_last=True)
    metrics = {"cameras": ["camera"], "has_clock": False, "stamp_ns": 200}
    config = {"occupancy": {"free_below": 0.3}}
    write_json(folder / "run.json", {"command": "reconstruct", "metrics": metrics, "inputs": {}, "config": config})
    coarse = ("--voxel", "0.2", "--set", "field.max_loss=1")
    bake = ("sdf-bake", "IN", "-o", "OUT", *coarse, "--no-report", "--threads", "1")
    return folder, (INFO, ("export", "IN", "-o", "OUT.ply"), bake, bake, (*bake, "--at", "0"))


def _view(number: int) -> DtuView:
    depth = np.full((48, 64), 0.6, np.float32)
    depth[:5] = 0
    mask = np.zeros((48, 64), np.bool_)
    mask[10:-10, 10:-10] = True
    return DtuView(
        name=f"view{number}",
        color=np.full((48, 64, 3), 90 + number, np.uint8),
        depth=depth,
        intrinsics=Intrinsics(fx=90.0, fy=92.0, cx=33.0, cy=23.0, width=64, height=48),
        T_world_camera=look_at([0.1 * number, -0.3, 0.1], [0.0, 0.0, 0.6]),
        mask=mask,
    )


def _splats() -> SplatSet:
    y, x = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.2, 0.2, 6), np.linspace(-0.2, 0.2, 6)))
    return plain_splats(np.column_stack([x, y, np.full(len(x), 0.6)]), 0.03, colors=0.4)


def _occupancy() -> OccupancyGrid:
    return plain_grid((4, 4, 8), 0.2, -0.4, log_odds=-1.0, num_updates=3)
