"""What ``sdf-bake`` bakes: the splats of a scene folder, of one of its snapshots, or of a bare file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.files.output import sha256
from splatctrl_cli.records import Balls, Box, OccupancyGrid, SplatSet
from splatctrl_cli.scene_files.scene_folder import open_scene
from splatctrl_cli.splat_files.splats import read_world_splats


@dataclass(frozen=True, kw_only=True)
class BakeSource:
    """Splats, and the occupancy of the same moment where there is one.

    unrepresented: the occupied voxels without a splat; stamp_ns: when the splats were so; workspace: the box outside
    which the scene keeps no splats; cameras: those that made it. Each None where it is not known (a bare splat file).
    """

    splats: SplatSet
    occupancy: OccupancyGrid | None
    unrepresented: Balls | None
    stamp_ns: int | None
    workspace: Box | None
    cameras: tuple[str, ...] | None
    digests: dict[str, str]


def read_bake_source(path: Path, at_seconds: float | None) -> BakeSource:
    """The splats at `path`, as known `at_seconds` after the scene's first snapshot (None: at its end).

    Raises InputError for what is not there or not a scene, UsageError for a time in a bare file, NotEvaluableError
    for a time before the first snapshot.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder", remedy="give what reconstruct wrote, or a splats.ply")
    if path.is_dir():
        return _read_folder(path, at_seconds)
    if at_seconds is not None:
        raise UsageError(f"--at {at_seconds:g}: {path} is one splat set", remedy="give the scene's folder")
    return BakeSource(
        splats=read_world_splats(path),
        occupancy=None,
        unrepresented=None,
        stamp_ns=None,
        workspace=None,
        cameras=None,
        digests={path.name: sha256(path)},
    )


def _read_folder(path: Path, at_seconds: float | None) -> BakeSource:
    scene = open_scene(path)
    final = scene.occupancy()
    occupancy: OccupancyGrid | None
    if at_seconds is None:
        splats, occupancy, stamp_ns = scene.splats(), final, scene.stamp_ns
        unrepresented = scene.unrepresented_at(None)
        files = [path / "splats.ply", path / "occupancy.npz"]
    else:
        if not scene.snapshots:
            raise NotEvaluableError(f"{path}: has no snapshots", remedy="bake without --at")
        wanted_ns = scene.snapshots[0].stamp_ns + round(at_seconds * 1e9)
        snapshot = scene.snapshot_at(wanted_ns)
        splats, occupancy, stamp_ns = snapshot.splats(), snapshot.occupancy(), snapshot.stamp_ns
        unrepresented = scene.unrepresented_at(wanted_ns)
        files = [snapshot.path] if occupancy is None else [snapshot.path, snapshot.occupancy_path]
    return BakeSource(
        splats=splats,
        occupancy=occupancy,
        unrepresented=unrepresented,
        stamp_ns=stamp_ns,
        workspace=_workspace(final),
        cameras=scene.cameras,
        digests={file.name: sha256(file) for file in files},
    )


def _workspace(occupancy: OccupancyGrid) -> Box:
    """The box of the occupancy grid, less a voxel at every border (a surface there may have splats beyond it)."""
    num_voxels = np.array(occupancy.log_odds.shape)
    lower = occupancy.origin + 0.5 * occupancy.voxel
    return Box(lower=lower, upper=lower + occupancy.voxel * (num_voxels - 2))
