"""What a replay may know of the scene: a baked grid, or the splats as they were known at each time."""

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from splatctrl_cli.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splatctrl_cli.config import Config
    from splatctrl_cli.control.audit import DistanceFunction, Observed
    from splatctrl_cli.control.explain import Obstacle
    from splatctrl_cli.control.rates import SceneStep
    from splatctrl_cli.field.grid import GridField
    from splatctrl_cli.records import DistanceField, DistanceGrid, Float64, SplatSet

    Index = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class KnownFields:
    """The fields of one scene: `barrier` is what a controller uses, `distances` what an audit puts side by side.

    obstacles: points (Q, 3) [m], world -> what is nearest to each. human: its people alone, None without any.
    """

    barrier: "DistanceField"
    distances: "Mapping[str, DistanceFunction]"
    median_radius: float
    obstacles: "Callable[[Float64], tuple[Obstacle, ...]]"
    human: "DistanceField | None" = None


@dataclass(frozen=True, kw_only=True)
class KnownScene:
    """`at(stamp_ns)` gives the same object for the same scene; nothing is known before `first_ns` (None: always).

    cameras: the cameras that made it, None where that is not recorded. stamps_ns: of the scenes that are there one
    after the other, empty for one scene for all times.
    """

    at: Callable[[int], KnownFields]
    observed: "Observed"
    first_ns: int | None
    cameras: tuple[str, ...] | None
    digests: dict[str, str]
    stamps_ns: tuple[int, ...] = ()

    def age_s(self, stamp_ns: int) -> float:
        """How old [s] the scene in use at a stamp is; NaN where scenes have no times."""
        index = bisect_right(self.stamps_ns, stamp_ns) - 1
        return math.nan if index < 0 else (stamp_ns - self.stamps_ns[index]) * 1e-9

    def step_at(self, stamp_ns: int) -> "SceneStep | None":
        """The two newest scenes at a stamp, None where there is only one."""
        from splatctrl_cli.control.rates import SceneStep

        index = bisect_right(self.stamps_ns, stamp_ns) - 1
        if index < 1:
            return None
        older_ns, newer_ns = self.stamps_ns[index - 1 : index + 1]
        return SceneStep(
            newer=self.at(newer_ns).barrier, older=self.at(older_ns).barrier, seconds=(newer_ns - older_ns) * 1e-9
        )


def from_grid(path: Path) -> KnownScene:
    """The scene of a baked grid: one field for all times. `path` is a field folder or a ``field.npz``."""
    from splatctrl_cli.control.audit import observed_lookup
    from splatctrl_cli.field.grid import GridField, exact_channel
    from splatctrl_cli.io.grid import read_npz
    from splatctrl_cli.io.output import sha256

    file = path / "field.npz" if path.is_dir() else path
    grid = read_npz(file)
    barrier = GridField(grid)
    fields = KnownFields(
        barrier=barrier,
        distances={
            "exact": _distance(GridField(replace(grid, channels={"sdf": exact_channel(grid)}))),
            "barrier": _distance(barrier),
            "certified": barrier.certified,
        },
        median_radius=_median_radius(file, grid.header),
        obstacles=lambda points: _nearest_cells(grid, barrier, points),
    )
    return KnownScene(
        at=lambda stamp_ns: fields,
        observed=observed_lookup(grid.channels["observed"].astype("uint8"), grid.origin, grid.voxel),
        first_ns=None,
        cameras=None,
        digests={file.name: sha256(file)},
    )


def from_splats(path: Path, config: "Config", threads: int) -> KnownScene:
    """The scene of a reconstruction: at each stamp the fields of its newest snapshot not later.

    Known space is what a camera saw, and what the robot itself was in at some time of the log.
    """
    from splatctrl_cli.control.audit import observed_lookup
    from splatctrl_cli.io.output import sha256
    from splatctrl_cli.io.scene_folder import open_scene
    from splatctrl_cli.records import SWEPT

    scene = open_scene(path)
    occupancy = scene.occupancy()
    known = (occupancy.num_updates > 0) | ((occupancy.entity & SWEPT) > 0)
    stamps = sorted({snapshot.stamp_ns for snapshot in scene.snapshots} | {scene.stamp_ns})
    has_times = scene.has_clock and len(stamps) > 1

    @cache
    def fields(index: int) -> KnownFields:
        splats = scene.splats_at(stamps[index]) if has_times and index < len(stamps) - 1 else scene.splats()
        return splat_fields(splats, config, threads)

    def at(stamp_ns: int) -> KnownFields:
        if not has_times:
            return fields(len(stamps) - 1)
        index = bisect_right(stamps, stamp_ns) - 1
        if index < 0:
            scene.splats_at(stamp_ns)  # raises: nothing is known yet
        return fields(index)

    return KnownScene(
        at=at,
        observed=observed_lookup(known.astype("uint8"), occupancy.origin, occupancy.voxel),
        first_ns=stamps[0] if has_times else None,
        cameras=tuple(scene.cameras),
        digests={"splats.ply": sha256(path / "splats.ply")},
        stamps_ns=tuple(stamps) if has_times else (),
    )


def splat_fields(splats: "SplatSet", config: "Config", threads: int) -> KnownFields:
    """Exact and barrier field of the splats, the robot's own left out."""
    import numpy as np

    from splatctrl_cli.field.distance import SphereField, field_over
    from splatctrl_cli.field.selection import DEFAULT_LABELS, field_splats
    from splatctrl_cli.field.spheres import Spheres
    from splatctrl_cli.records import Label

    chosen = field_splats(splats)
    index = np.flatnonzero(np.isin(splats.labels, [int(label) for label in DEFAULT_LABELS]))
    spheres = Spheres.of(chosen.centers, chosen.radii)
    barrier, exact = field_over(spheres, config.field, threads=threads), SphereField.over(spheres, threads=threads)
    people = chosen.labels == Label.HUMAN
    return KnownFields(
        barrier=barrier,
        distances={"exact": _distance(exact), "barrier": _distance(barrier)},
        median_radius=float(np.median(chosen.radii)),
        obstacles=lambda points: _nearest_splats(splats, index[exact.nearest(points)], points),
        human=SphereField(chosen.centers[people], chosen.radii[people], threads=threads) if people.any() else None,
    )


def _nearest_splats(splats: "SplatSet", index: "Index", points: "Float64") -> "tuple[Obstacle, ...]":
    """The splats that are nearest to points (Q, 3), by their index (Q,) in their file."""
    import numpy as np

    from splatctrl_cli.control.explain import Obstacle
    from splatctrl_cli.records import Label

    offset = points - splats.centers[index].astype(np.float64)
    gap = np.linalg.norm(offset, axis=1)
    radius = splats.radii[index].astype(np.float64)
    surface = splats.centers[index] + offset * (radius / np.maximum(gap, 1e-12))[:, None]
    return tuple(
        Obstacle(
            distance=float(gap[k] - radius[k]),
            position=_place(surface[k]),
            splat=int(splat),
            label=Label(splats.labels[splat]).name.lower(),
        )
        for k, splat in enumerate(index)
    )


def _nearest_cells(grid: "DistanceGrid", field: "GridField", points: "Float64") -> "tuple[Obstacle, ...]":
    """The cells that hold the nearest surface to points (Q, 3), as the gradient points to it."""
    import numpy as np

    from splatctrl_cli.control.explain import Obstacle

    distance, gradient = field.query(points)
    length = np.maximum(np.linalg.norm(gradient, axis=1), 1e-12)
    surface = points - gradient * (distance / length)[:, None]
    cells = np.nan_to_num(np.floor((surface - grid.origin) / grid.voxel + 0.5)).astype(np.int64)
    return tuple(
        Obstacle(
            distance=float(distance[k]), position=_place(surface[k]), cell=(int(cell[0]), int(cell[1]), int(cell[2]))
        )
        for k, cell in enumerate(cells)
    )


def _place(point: "Float64") -> tuple[float, float, float]:
    return float(point[0]), float(point[1]), float(point[2])


def _distance(field: "DistanceField") -> "DistanceFunction":
    def distance(points: "Float64") -> "Float64":
        return field.query(points)[0]

    return distance


def _median_radius(file: Path, header: Mapping[str, object]) -> float:
    radius = header.get("radius")
    if not isinstance(radius, Mapping) or not isinstance(radius.get("median"), float):
        raise InputError(f"{file}: header: expected the splats' median radius, got none", remedy="bake it again")
    return float(radius["median"])
