"""What a replay may know of the scene: a baked grid, or the splats as they were known at each time."""

from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from splatctrl_cli.errors import InputError

if TYPE_CHECKING:
    from splatctrl_cli.config import Config
    from splatctrl_cli.control.audit import DistanceFunction, Observed
    from splatctrl_cli.records import DistanceField, Float64, SplatSet


@dataclass(frozen=True, kw_only=True)
class KnownFields:
    """The fields of one scene: `barrier` is what a controller uses, `distances` what an audit puts side by side."""

    barrier: "DistanceField"
    distances: "Mapping[str, DistanceFunction]"
    median_radius: float


@dataclass(frozen=True, kw_only=True)
class KnownScene:
    """`at(stamp_ns)` gives the same object for the same scene; nothing is known before `first_ns` (None: always).

    cameras: the cameras that made it, None where that is not recorded.
    """

    at: Callable[[int], KnownFields]
    observed: "Observed"
    first_ns: int | None
    cameras: tuple[str, ...] | None
    digests: dict[str, str]


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
    )


def splat_fields(splats: "SplatSet", config: "Config", threads: int) -> KnownFields:
    """Exact and barrier field of the splats, the robot's own left out."""
    import numpy as np

    from splatctrl_cli.field.distance import SphereField, field_over
    from splatctrl_cli.field.selection import field_splats
    from splatctrl_cli.field.spheres import Spheres

    chosen = field_splats(splats)
    spheres = Spheres.of(chosen.centers, chosen.radii)
    barrier = field_over(spheres, config.field, threads=threads)
    return KnownFields(
        barrier=barrier,
        distances={"exact": _distance(SphereField.over(spheres, threads=threads)), "barrier": _distance(barrier)},
        median_radius=float(np.median(chosen.radii)),
    )


def _distance(field: "DistanceField") -> "DistanceFunction":
    def distance(points: "Float64") -> "Float64":
        return field.query(points)[0]

    return distance


def _median_radius(file: Path, header: Mapping[str, object]) -> float:
    radius = header.get("radius")
    if not isinstance(radius, Mapping) or not isinstance(radius.get("median"), float):
        raise InputError(f"{file}: header: expected the splats' median radius, got none", remedy="bake it again")
    return float(radius["median"])
