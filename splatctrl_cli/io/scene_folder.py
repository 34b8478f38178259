"""The ``scene/`` folder: splats, occupancy, audit, snapshots by time, checkpoint, run.json.

splats.ply  occupancy.npz  audit.jsonl  snapshots.csv  snapshots/NNNNNN.ply  checkpoint/state.npz  run.json
"""

import csv
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.io.splats import read_ply, write_ply
from splatctrl_cli.records import OccupancyGrid, SplatSet

FORMAT = "splatctrl-scene 1"


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The splat set as it was after the frames of `stamp_ns`."""

    stamp_ns: int
    path: Path
    num_splats: int


class SceneWriter:
    """Writes a scene into an empty folder, as the fitter goes."""

    def __init__(self, folder: Path, comments: Mapping[str, str]) -> None:
        self.folder = folder
        self.comments = dict(comments)
        self._snapshots: list[Snapshot] = []
        (folder / "snapshots").mkdir()
        (folder / "checkpoint").mkdir()

    def audit(self, row: object) -> None:
        """Append one row to ``audit.jsonl``."""
        assert is_dataclass(row) and not isinstance(row, type)
        with (self.folder / "audit.jsonl").open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(asdict(row)) + "\n")

    def snapshot(self, stamp_ns: int, splats: SplatSet) -> None:
        """Write the splats as they are at `stamp_ns`."""
        path = self.folder / "snapshots" / f"{len(self._snapshots):06d}.ply"
        write_ply(path, splats, self.comments | {"stamp_ns": str(stamp_ns)})
        self._snapshots.append(Snapshot(stamp_ns=stamp_ns, path=path, num_splats=len(splats)))

    def finish(
        self, stamp_ns: int, splats: SplatSet, grid: OccupancyGrid, state: Mapping[str, NDArray[np.generic]]
    ) -> None:
        """Write the final splats, the occupancy grid, the index of snapshots, and the checkpoint."""
        write_ply(self.folder / "splats.ply", splats, self.comments | {"stamp_ns": str(stamp_ns)})
        write_occupancy(self.folder / "occupancy.npz", grid)
        with (self.folder / "snapshots.csv").open("w", newline="", encoding="utf-8") as stream:
            table = csv.writer(stream, lineterminator="\n")
            table.writerow(["stamp_ns", "file", "num_splats"])
            table.writerows([s.stamp_ns, f"snapshots/{s.path.name}", s.num_splats] for s in self._snapshots)
        _savez(self.folder / "checkpoint" / "state.npz", dict(state))


def _savez(path: Path, arrays: dict[str, NDArray[np.generic]]) -> None:
    """`np.savez_compressed` without the clock: the same arrays give the same bytes."""
    import io
    import zipfile

    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.asarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, buffer.getvalue())


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
    _savez(path, arrays)


def read_occupancy(path: Path) -> OccupancyGrid:
    """Read ``occupancy.npz``. Raises InputError for anything else, never unpickles."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            header = json.loads(str(archive["header"]))
            return OccupancyGrid(
                origin=np.array(header["origin"], np.float64),
                voxel=float(header["voxel"]),
                log_odds=archive["log_odds"],
                num_updates=archive["num_updates"],
                entity=archive["entity"],
            )
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:
        raise InputError(f"{path}: not an occupancy grid of ours: {error}") from error


@dataclass(frozen=True)
class SceneFolder:
    """A scene that `reconstruct` wrote."""

    path: Path

    @cached_property
    def run(self) -> dict[str, Any]:
        """``run.json``."""
        try:
            run: dict[str, Any] = json.loads((self.path / "run.json").read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{self.path / 'run.json'}: cannot be read: {error}") from None
        return run

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that trained the scene."""
        return tuple(self.run["metrics"]["cameras"])

    @property
    def training_stamps_ns(self) -> frozenset[int]:
        """The views that trained a scene without a clock, by their made-up stamps."""
        return frozenset(self.run["metrics"].get("training_stamps_ns", ()))

    @property
    def has_clock(self) -> bool:
        """False where the stamps are made up."""
        return bool(self.run["metrics"]["has_clock"])

    @property
    def stamp_ns(self) -> int:
        """Of the last frame."""
        return int(self.run["metrics"]["stamp_ns"])

    def splats(self) -> SplatSet:
        """The final splats."""
        return read_ply(self.path / "splats.ply")[0]

    def occupancy(self) -> OccupancyGrid:
        """The final occupancy grid."""
        return read_occupancy(self.path / "occupancy.npz")

    @cached_property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """By time."""
        path = self.path / "snapshots.csv"
        try:
            with path.open(encoding="utf-8", newline="") as stream:
                return tuple(
                    Snapshot(
                        stamp_ns=int(row["stamp_ns"]),
                        path=self.path / row["file"],
                        num_splats=int(row["num_splats"]),
                    )
                    for row in csv.DictReader(stream)
                )
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"{path}: cannot be read: {error}") from None

    def splats_at(self, stamp_ns: int) -> SplatSet:
        """The newest snapshot not later than `stamp_ns`; NotEvaluableError before the first."""
        known = [s for s in self.snapshots if s.stamp_ns <= stamp_ns]
        if not known:
            raise NotEvaluableError(
                f"{self.path}: no snapshot at or before stamp {stamp_ns}",
                remedy="the scene was not known yet; ask for a later time",
            )
        return read_ply(known[-1].path)[0]


def open_scene(path: Path) -> SceneFolder:
    """The scene in a folder. Raises InputError where it is none."""
    if not path.exists():
        raise InputError(f"{path}: no such scene folder", remedy="give what 'splatctrl reconstruct' wrote")
    if not (path / "splats.ply").is_file() or not (path / "run.json").is_file():
        raise InputError(
            f"{path}: expected a scene folder with splats.ply and run.json",
            remedy="give what 'splatctrl reconstruct' wrote",
        )
    return SceneFolder(path)
