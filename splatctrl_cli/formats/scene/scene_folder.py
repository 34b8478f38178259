"""The ``scene/`` folder that `SceneWriter` writes, or a bare splat file in its place.

splats.ply  shell.ply  occupancy.npz  audit.jsonl  snapshots.csv  checkpoint/state.npz  run.json
snapshots/NNNNNN.ply, .shell.ply and .npz
"""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from splatctrl_cli.config import fixed
from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_faults, refuse_if
from splatctrl_cli.files.output import PARTIAL, Parts
from splatctrl_cli.formats.scene.voxel_file import (
    read_known_occupancy,
    read_occupancy,
    read_seen,
    read_states,
    read_unrepresented,
)
from splatctrl_cli.formats.splat.gaussian_ply import read_gaussian_ply
from splatctrl_cli.formats.splat.splats import check_world, read_shell, read_splats, read_world_splats
from splatctrl_cli.records import Float64, GaussianSet, SplatSet
from splatctrl_cli.voxels import Balls, KnownVoxels, OccupancyGrid, SeenVoxels

FORMAT = "splatctrl-scene 1"
SELF_MODEL = "self.npz"  # what `robot learn` finds in the recording
SHELL_FILE = "shell.ply"
MAP_DELAYS = "map_delays_s"  # metric of a lockstep in real time: from each snapshot's frames until it was known
MADE_FROM = (  # metrics of a reconstruction that go with a field
    *("first_frames", "robot_joints", "robot_links", "robot_base"),
    *("displaced_cameras", "self_mask", "self_mask_residual_mm"),
)
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """Splats after the frames of `stamp_ns`."""

    stamp_ns: int
    path: Path
    num_splats: int
    parts: Parts | None = None  # of its scene

    @property
    def occupancy_path(self) -> Path:
        return self.path.with_suffix(".npz")

    def occupancy(self) -> OccupancyGrid | None:
        """The grid, only as exact as `write_states`; None in an older scene."""
        return self._read_voxels(read_states)

    def seen(self) -> SeenVoxels | None:
        """Last views of the voxels; None in an older scene."""
        return self._read_voxels(read_seen)

    def unrepresented(self) -> Balls | None:
        """Occupied voxels without a splat; None in an older scene."""
        return self._read_voxels(read_unrepresented)

    def splats(self) -> SplatSet:
        return read_world_splats(self.path if self.parts is None else self.parts.checked(self.path))

    @property
    def shell_path(self) -> Path:
        return self.path.with_suffix(f".{SHELL_FILE}")

    def _read_voxels(self, read: Callable[[Path], T]) -> T | None:
        path = self.occupancy_path
        if self.parts is None:
            return read(path) if path.is_file() else None
        return read(self.parts.checked(path)) if self.parts.has(path) else None


@dataclass(frozen=True, kw_only=True)
class ViewCorrection:
    """The correction of a training view; None where used as recorded.

    T_world_camera (4, 4); gain (3,) divides red, green, blue; bend (rows, columns) [1/m] was removed from depth.
    """

    T_world_camera: Float64 | None
    gain: Float64 | None
    bend: Float64 | None = None


def run_value(
    run: Mapping[str, Any], keys: Sequence[str], kind: Callable[[Any], T], default: object = None, *, where: str
) -> T:
    """Convert the value at `keys` of a ``run.json``, or the default, by `kind`.

    Raises InputError naming `where` if missing without a default, or of another kind.
    """
    value: Any = run
    try:
        for key in keys:
            if default is not None and key not in value:
                return kind(default)
            value = value[key]
        return kind(value)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        actual = "nothing" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{where}: {'.'.join(keys)}: expected what reconstruct writes, got {actual}",
            remedy="reconstruct the scene again",
        ) from None


def _color(value: list[Any]) -> tuple[float, float, float]:
    red, green, blue = (float(part) for part in value)
    return red, green, blue


def _corrections(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, int], ViewCorrection]:
    def numbers(value: Any, *shape: int) -> Float64 | None:
        return None if value is None else np.array(value, np.float64).reshape(shape)

    return {
        (str(row["camera"]), int(row["stamp_ns"])): ViewCorrection(
            T_world_camera=numbers(row.get("T_world_camera"), 4, 4), gain=numbers(row.get("gain"), 3)
        )
        for row in rows
    }


def _bends(bends: Mapping[str, Mapping[str, Any]]) -> dict[str, Float64]:
    grids = {str(camera): np.array(bend["offsets"], np.float64) for camera, bend in bends.items()}
    refuse_if(
        any(grid.shape != fixed.BEND_GRID or not np.isfinite(grid).all() for grid in grids.values()),
        f"not {fixed.BEND_GRID} finite offsets",
        error=ValueError,
    )
    return grids


def _inside(name: str) -> str:
    refuse_if(
        Path(name).is_absolute() or ".." in Path(name).parts, f"{name} lies outside the scene", error=ValueError
    )
    return name


@dataclass(frozen=True)
class SceneFolder:
    """A scene from `reconstruct`."""

    path: Path
    names_its_views: ClassVar[bool] = True
    """The scene records which views trained it."""

    @cached_property
    def run(self) -> dict[str, Any]:
        """``run.json``. Raises InputError if unreadable."""
        file = self.path / "run.json"
        with refuse_faults(f"{file}: cannot be read", OSError, ValueError):
            run = json.loads(file.read_text(encoding="utf-8"))
        for name in ("metrics", "inputs", "config"):
            is_object = isinstance(run, dict) and isinstance(run.get(name, {}), dict)
            refuse_if(not is_object, f"{file}: {name}: expected an object", remedy="reconstruct the scene again")
        return dict(run)

    @cached_property
    def parts(self) -> Parts:
        return Parts.from_run(self.path, self.run)

    @property
    def made_from(self) -> dict[str, Any]:
        """Facts of the scene's log and robot.

        Digests (`inputs`), first frames, joints and links, depth correction, and the robot's residual.
        """
        metrics = self.run.get("metrics", {})
        return {
            "inputs": self.run.get("inputs", {}),
            **{name: metrics[name] for name in MADE_FROM if name in metrics},
            **({"depth_bend": metrics["depth_bend"]} if metrics.get("depth_bend") else {}),
        }

    @property
    def cameras(self) -> tuple[str, ...]:
        return self._metric("cameras", lambda names: tuple(map(str, names)))

    @property
    def training_stamps_ns(self) -> frozenset[int]:
        """Made-up stamps of training views without a clock."""
        return self._metric("training_stamps_ns", frozenset[int], ())

    @property
    def has_clock(self) -> bool:
        return self._metric("has_clock", bool)

    @property
    def stamp_ns(self) -> int:
        return self._metric("stamp_ns", int)

    @property
    def background(self) -> tuple[float, float, float]:
        """Colour in [0, 1] behind the splats; black in an older scene."""
        return self._metric("background", _color, (0.0, 0.0, 0.0))

    @property
    def corrections(self) -> dict[tuple[str, int], ViewCorrection]:
        """Corrections by camera and stamp; may be empty."""
        rows, bends = self._metric("corrected_views", _corrections, ()), self._metric("depth_bends", _bends, {})
        return {key: replace(row, bend=bends.get(key[0])) for key, row in rows.items()}

    @property
    def is_anisotropic(self) -> bool:
        """True for 3D Gaussian splatting: it has `gaussians`, no splats or occupancy."""
        return self._metric("method", "3dgs".__eq__, "")

    def _metric(self, name: str, kind: Callable[[Any], T], default: object = None) -> T:
        return run_value(self.run, ("metrics", name), kind, default, where=str(self.path / "run.json"))

    def gaussians(self) -> GaussianSet:
        """The Gaussians. Raises InputError without any."""
        gaussians = read_gaussian_ply(self.parts.checked(self.path / "splats.ply"))[0]
        refuse_if(
            not len(gaussians),
            f"{self.path}: expected Gaussians, got none: there is nothing to render",
            remedy="reconstruct again with views that have depth; splats.ply is empty",
        )
        return gaussians

    def splats(self) -> SplatSet:
        return read_world_splats(self._isotropic("splats.ply"))

    def _isotropic(self, name: str) -> Path:
        refuse_if(
            self.is_anisotropic,
            f"{self.path}: made by 3D Gaussian splatting; distances are defined on isotropic splats",
            remedy="reconstruct the recording, or 'splatctrl score' this scene",
        )
        return self.parts.checked(self.path / name)

    def occupancy(self) -> OccupancyGrid:
        return read_occupancy(self._isotropic("occupancy.npz"))

    def known(self) -> KnownVoxels | None:
        """Final voxels, and when last seen; None in an older scene."""
        return read_known_occupancy(self._isotropic("occupancy.npz"))

    def seen(self) -> SeenVoxels | None:
        """Last views of the voxels; None in an older scene."""
        return read_seen(self._isotropic("occupancy.npz"))

    @cached_property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """Snapshots by time. Raises InputError for a bad table or stamps that do not ascend."""
        path = self._isotropic("snapshots.csv")
        with (
            refuse_faults(f"{path}: cannot be read", OSError, KeyError, ValueError, TypeError, csv.Error),
            path.open(encoding="utf-8", newline="") as stream,
        ):
            snapshots = tuple(
                Snapshot(
                    stamp_ns=int(row["stamp_ns"]),
                    path=self.path / _inside(row["file"]),
                    num_splats=int(row["num_splats"]),
                    parts=self.parts,
                )
                for row in csv.DictReader(stream)
            )
        for before, after in pairwise(snapshots):
            refuse_if(
                after.stamp_ns <= before.stamp_ns,
                f"{path}: stamp {after.stamp_ns} after {before.stamp_ns}: expected stamps that ascend",
                remedy="reconstruct the scene again",
            )
        return snapshots

    def snapshot_at(self, stamp_ns: int) -> Snapshot:
        """The newest snapshot up to `stamp_ns`. Raises NotEvaluableError before the first."""
        known = [s for s in self.snapshots if s.stamp_ns <= stamp_ns]
        refuse_if(
            not known,
            f"{self.path}: no snapshot at or before stamp {stamp_ns}",
            remedy="the scene was not known yet; ask for a later time",
            error=NotEvaluableError,
        )
        return known[-1]

    def unrepresented_at(self, stamp_ns: int | None) -> Balls | None:
        """Unrepresented voxels at `stamp_ns` (None: the end); None in an older scene."""
        if stamp_ns is not None:
            return self.snapshot_at(stamp_ns).unrepresented()
        path = self.path / "occupancy.npz"
        return read_unrepresented(self.parts.checked(path)) if self.parts.has(path) else None

    def shell_at(self, stamp_ns: int | None) -> SplatSet | None:
        """The shell at `stamp_ns` (None: the end), for pictures; None if absent."""
        path = self.path / SHELL_FILE if stamp_ns is None else self.snapshot_at(stamp_ns).shell_path
        return read_shell(self.parts.checked(path)) if self.parts.has(path) else None

    def splats_at(self, stamp_ns: int) -> SplatSet:
        return self.snapshot_at(stamp_ns).splats()


def open_scene(path: Path) -> SceneFolder:
    """Open a scene folder. Raises InputError if it is none."""
    refuse_if(not path.exists(), f"{path}: no such scene folder", remedy="give what 'splatctrl reconstruct' wrote")
    refuse_if(
        path.name.endswith(PARTIAL),
        f"{path}: an interrupted run",
        remedy="continue it: the same command and --resume",
    )
    refuse_if(
        not (path / "splats.ply").is_file() or not (path / "run.json").is_file(),
        f"{path}: expected a scene folder with splats.ply and run.json",
        remedy="give what 'splatctrl reconstruct' wrote",
    )
    return SceneFolder(path)


@dataclass(frozen=True)
class SplatFile(SceneFolder):
    """A splat file rendered as it is: any shape, its own harmonics, on black."""

    names_its_views: ClassVar[bool] = False

    @cached_property
    def run(self) -> dict[str, Any]:
        return {"metrics": {"cameras": [], "has_clock": False, "stamp_ns": 0}, "inputs": {}, "config": {}}

    @cached_property
    def parts(self) -> Parts:
        return Parts(folder=self.path.parent)

    @property
    def is_anisotropic(self) -> bool:
        """True if stretched or with view-dependent colour."""
        return isinstance(self._content, GaussianSet)

    @cached_property
    def _content(self) -> SplatSet | GaussianSet:
        splats, comments = read_splats(self.path)
        check_world(self.path, comments)
        refuse_if(
            not len(splats), f"{self.path}: has no splats: there is nothing to render", remedy="give another file"
        )
        return splats

    def gaussians(self) -> GaussianSet:
        assert isinstance(self._content, GaussianSet)
        return self._content

    def splats(self) -> SplatSet:
        assert isinstance(self._content, SplatSet)
        return self._content

    @cached_property
    def snapshots(self) -> tuple[Snapshot, ...]:
        return ()


def open_splats(path: Path) -> SceneFolder:
    """Open a scene folder or splat file. Raises InputError for neither."""
    return SplatFile(path) if path.is_file() else open_scene(path)
