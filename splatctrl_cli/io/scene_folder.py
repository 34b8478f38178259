"""Reads the ``scene/`` folder that `SceneWriter` writes, and its occupancy grids.

splats.ply  occupancy.npz  audit.jsonl  snapshots.csv  snapshots/NNNNNN.ply and .npz  checkpoint/state.npz  run.json
"""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.io.arrays import read_arrays, savez
from splatctrl_cli.io.gaussian_ply import read_gaussian_ply
from splatctrl_cli.io.output import PARTIAL
from splatctrl_cli.io.splats import read_ply
from splatctrl_cli.records import GaussianSet, OccupancyGrid, SplatSet, UInt8, VoxelState

FORMAT = "splatctrl-scene 1"
MOST_VOXELS = 400_000_000  # as many as reconstruct makes
_HEADER = 1 << 20  # bytes


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The splat set as it was after the frames of `stamp_ns`."""

    stamp_ns: int
    path: Path
    num_splats: int

    @property
    def occupancy_path(self) -> Path:
        """What was known of each voxel then."""
        return self.path.with_suffix(".npz")

    def occupancy(self) -> OccupancyGrid | None:
        """The grid of that moment, as coarse as `write_states` keeps it; None in a scene of an older version."""
        return read_states(self.occupancy_path) if self.occupancy_path.is_file() else None


def write_occupancy(path: Path, grid: OccupancyGrid) -> None:
    """Write ``occupancy.npz``: log_odds, num_updates, entity, and a JSON header with frame and units."""
    header = {
        "format": "splatctrl-occupancy 1",
        "frame": "world",
        "units": "m",
        "origin": grid.origin.tolist(),
        "voxel": grid.voxel,
        "shape": list(grid.log_odds.shape),
        "values": "log_odds of occupancy; num_updates 0 = never seen; entity bits 001 robot, 010 human, 100 swept",
    }
    arrays: dict[str, NDArray[np.generic]] = {
        "header": np.array(json.dumps(header)),
        "log_odds": grid.log_odds,
        "num_updates": grid.num_updates,
        "entity": grid.entity,
    }
    savez(path, arrays)


def write_states(path: Path, grid: OccupancyGrid, states: UInt8) -> None:
    """Write `states` (X, Y, Z) of the voxels of `grid`: a tenth of the size of its occupancy."""
    header = {
        "format": "splatctrl-voxel-states 1",
        "frame": "world",
        "units": "m",
        "origin": grid.origin.tolist(),
        "voxel": grid.voxel,
        "shape": list(states.shape),
        "values": {state.name.lower(): int(state) for state in VoxelState},
    }
    savez(path, {"header": np.array(json.dumps(header)), "states": states}, level=6)


def read_states(path: Path) -> OccupancyGrid:
    """An occupancy grid with the states of `write_states`. Raises InputError for anything else, never unpickles."""
    try:
        arrays = read_arrays(path, ("header", "states"), most=_HEADER + MOST_VOXELS)
        header = json.loads(str(arrays["header"]))
        states = _voxels(arrays["states"], "states", np.uint8, header)
        return OccupancyGrid.from_states(np.array(header["origin"], np.float64), float(header["voxel"]), states)
    except Exception as error:
        raise InputError(f"{path}: not the voxel states of a snapshot: {error}") from error


def read_occupancy(path: Path) -> OccupancyGrid:
    """Read ``occupancy.npz``. Raises InputError for anything else, never unpickles."""
    try:
        kinds: dict[str, type[np.generic]] = {"log_odds": np.float32, "num_updates": np.uint16, "entity": np.uint8}
        arrays = read_arrays(path, ("header", *kinds), most=_HEADER + 7 * MOST_VOXELS)
        header = json.loads(str(arrays["header"]))
        return OccupancyGrid(
            origin=np.array(header["origin"], np.float64),
            voxel=float(header["voxel"]),
            **{name: _voxels(arrays[name], name, kind, header) for name, kind in kinds.items()},
        )
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:
        raise InputError(f"{path}: not an occupancy grid of ours: {error}") from error


T = TypeVar("T")


def run_value(
    run: Mapping[str, Any], keys: Sequence[str], kind: Callable[[Any], T], default: object = None, *, where: str
) -> T:
    """What `kind` makes of the value at `keys` of a ``run.json``; of the default where it is not there.

    Raises InputError naming `where` for a value that is missing without a default, or of another kind.
    """
    value: Any = run
    try:
        for key in keys:
            if default is not None and key not in value:
                return kind(default)
            value = value[key]
        return kind(value)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        said = "nothing" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{where}: {'.'.join(keys)}: expected what reconstruct writes, got {said}",
            remedy="reconstruct the scene again",
        ) from None


def _names(value: list[Any]) -> tuple[str, ...]:
    return tuple(str(name) for name in value)


def _color(value: list[Any]) -> tuple[float, float, float]:
    red, green, blue = (float(part) for part in value)
    return red, green, blue


def _voxels(values: NDArray[Any], name: str, kind: type[np.generic], header: Mapping[str, Any]) -> NDArray[Any]:
    """An array of one value a voxel. Raises ValueError for one of another type or shape than the header's."""
    wanted = (np.dtype(kind), tuple(header["shape"]))
    if (values.dtype, values.shape) != wanted or len(values.shape) != 3:
        raise ValueError(f"{name}: expected {wanted[0]} {wanted[1]}, got {values.dtype} {values.shape}")
    return values


def _inside(name: str) -> str:
    """The name itself. Raises ValueError where it leads out of its folder."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise ValueError(f"{name} lies outside the scene")
    return name


@dataclass(frozen=True)
class SceneFolder:
    """A scene that `reconstruct` wrote."""

    path: Path

    @cached_property
    def run(self) -> dict[str, Any]:
        """``run.json``. Raises InputError where it is none."""
        file = self.path / "run.json"
        try:
            run = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{file}: cannot be read: {error}") from None
        for name in ("metrics", "inputs", "config"):
            if not isinstance(run, dict) or not isinstance(run.get(name, {}), dict):
                raise InputError(f"{file}: {name}: expected an object", remedy="reconstruct the scene again")
        return dict(run)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that trained the scene."""
        return self._metric("cameras", _names)

    @property
    def training_stamps_ns(self) -> frozenset[int]:
        """The views that trained a scene without a clock, by their made-up stamps."""
        return self._metric("training_stamps_ns", frozenset[int], ())

    @property
    def has_clock(self) -> bool:
        """False where the stamps are made up."""
        return self._metric("has_clock", bool)

    @property
    def stamp_ns(self) -> int:
        """Of the last frame."""
        return self._metric("stamp_ns", int)

    @property
    def background(self) -> tuple[float, float, float]:
        """What is seen where no splat is: a colour in [0, 1]; black in a scene of an older version."""
        return self._metric("background", _color, (0.0, 0.0, 0.0))

    @property
    def is_anisotropic(self) -> bool:
        """True for what `reconstruct --method 3dgs` made: `gaussians` instead of splats and occupancy."""
        return self._metric("method", "3dgs".__eq__, "")

    def _metric(self, name: str, kind: Callable[[Any], T], default: object = None) -> T:
        return run_value(self.run, ("metrics", name), kind, default, where=str(self.path / "run.json"))

    def gaussians(self) -> GaussianSet:
        """The Gaussians of a scene that is anisotropic."""
        return read_gaussian_ply(self.path / "splats.ply")[0]

    def splats(self) -> SplatSet:
        """The final splats."""
        self._expect_isotropic()
        return read_ply(self.path / "splats.ply")[0]

    def _expect_isotropic(self) -> None:
        if self.is_anisotropic:
            raise InputError(
                f"{self.path}: made by --method 3dgs; distances are defined on isotropic splats",
                remedy="reconstruct without --method, or 'splatctrl score' it",
            )

    def occupancy(self) -> OccupancyGrid:
        """The final occupancy grid."""
        self._expect_isotropic()
        return read_occupancy(self.path / "occupancy.npz")

    @cached_property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """By time."""
        self._expect_isotropic()
        path = self.path / "snapshots.csv"
        try:
            with path.open(encoding="utf-8", newline="") as stream:
                return tuple(
                    Snapshot(
                        stamp_ns=int(row["stamp_ns"]),
                        path=self.path / _inside(row["file"]),
                        num_splats=int(row["num_splats"]),
                    )
                    for row in csv.DictReader(stream)
                )
        except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
            raise InputError(f"{path}: cannot be read: {error}") from None

    def snapshot_at(self, stamp_ns: int) -> Snapshot:
        """The newest snapshot not later than `stamp_ns`; NotEvaluableError before the first."""
        known = [s for s in self.snapshots if s.stamp_ns <= stamp_ns]
        if not known:
            raise NotEvaluableError(
                f"{self.path}: no snapshot at or before stamp {stamp_ns}",
                remedy="the scene was not known yet; ask for a later time",
            )
        return known[-1]

    def splats_at(self, stamp_ns: int) -> SplatSet:
        """The splats of `snapshot_at`."""
        return read_ply(self.snapshot_at(stamp_ns).path)[0]


def open_scene(path: Path) -> SceneFolder:
    """The scene in a folder. Raises InputError where it is none."""
    if not path.exists():
        raise InputError(f"{path}: no such scene folder", remedy="give what 'splatctrl reconstruct' wrote")
    if path.name.endswith(PARTIAL):
        raise InputError(f"{path}: an interrupted run", remedy="continue it: the same command and --resume")
    if not (path / "splats.ply").is_file() or not (path / "run.json").is_file():
        raise InputError(
            f"{path}: expected a scene folder with splats.ply and run.json",
            remedy="give what 'splatctrl reconstruct' wrote",
        )
    return SceneFolder(path)
