"""Time steps that leave a map: due, or with a new obstacle."""

from pathlib import Path

import numpy as np

from splatctrl_cli.config import Config, fixed
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.field.clusters import Spheres, obstacle_spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.formats.scene.voxel_file import read_states, read_unrepresented
from splatctrl_cli.formats.splat.splats import read_ply
from splatctrl_cli.records import SplatSet
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.voxels import Balls, OccupancyGrid


class KeptMaps:
    """Decisions on snapshots from written files only, so a resumed run decides the same."""

    def __init__(self, writer: SceneWriter, config: Config) -> None:
        self._writer, self._config = writer, config
        self._last: tuple[Path, SphereField | None, OccupancyGrid] | None = None  # the last kept map

    def is_due(self, index: int, stamp_ns: int) -> bool:
        """True every `snapshot_every` steps, at most once per `snapshot_period` from the first snapshot."""
        scene, taken = self._config.scene, self._writer.snapshots
        if index % scene.snapshot_every:
            return False
        period_ns = round(scene.snapshot_period * 1e9)
        if not taken or period_ns == 0:
            return True
        first, last = taken[0].stamp_ns - fixed.SAME_MOMENT_NS, taken[-1].stamp_ns
        return (stamp_ns - first) // period_ns > (last - first) // period_ns

    def shows_news(self, fitter: SceneFitter) -> bool:
        """True if at least `NEWS_LEAST` spheres may be a new obstacle.

        They reach more than half a voxel beyond the last map's spheres, from a free voxel of that map.
        """
        if not self._writer.snapshots:
            return False
        path = self._writer.snapshots[-1].path
        if self._last is None or self._last[0] != path:
            self._writer.settle()
            states = path.with_suffix(".npz")
            before = _spheres(read_ply(path)[0], read_unrepresented(states))
            field = None if before is None else SphereField(Spheres.of(before.centers, before.radii))
            self._last = path, field, read_states(states)
        now = _spheres(fitter.splats(), fitter.unrepresented)
        return now is not None and _num_new(now, *self._last[1:]) >= fixed.NEWS_LEAST


def _num_new(spheres: SplatSet, field: SphereField | None, grid: OccupancyGrid) -> int:
    centers = spheres.centers.astype(np.float64)
    cells = np.floor((centers - grid.origin) / grid.voxel + 0.5).astype(np.int64)
    is_inside = np.all((cells >= 0) & (cells < grid.log_odds.shape), axis=1)
    is_free = np.zeros(len(cells), bool)
    is_free[is_inside] = grid.log_odds[tuple(cells[is_inside].T)] < 0.0
    away = np.full(int(is_free.sum()), np.inf) if field is None else field.query(centers[is_free])[0]
    return int(np.count_nonzero(away + spheres.radii[is_free] > 0.5 * grid.voxel))


def _spheres(splats: SplatSet, balls: Balls | None) -> SplatSet | None:
    try:
        return obstacle_spheres(splats, balls).splats
    except NotEvaluableError:
        return None
