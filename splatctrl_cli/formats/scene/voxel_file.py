"""Voxel files of a scene: ``occupancy.npz`` and snapshots' states, with evidence."""

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import refuse_faults, refuse_if
from splatctrl_cli.formats.arrays import read_arrays, savez
from splatctrl_cli.records import Array, Label, UInt8, Values
from splatctrl_cli.voxels import (
    FIRST_REASON,
    MOST_VOXELS,
    NO_EDGES,
    Balls,
    KnownVoxels,
    LostEdges,
    OccupancyGrid,
    SeenVoxels,
    Unseen,
    VoxelState,
)

_HEADER = 1 << 22  # bytes
_MOST_EDGES = 1 << 26  # bytes
_WIDE = 0xFF00  # by which `Unseen` in two bytes is larger than in one
_GRID: Mapping[str, type[np.generic]] = {"log_odds": np.float32, "num_updates": np.uint16, "entity": np.uint8}
_EVIDENCE = ("last_seen", "unrepresented", "unrepresented_labels")
_STATES, _OCCUPANCY, _OURS = "the voxel states of a snapshot", "an occupancy grid of ours", "a voxel file of ours"

Arrays = Mapping[str, Array]


def write_occupancy(path: Path, known: KnownVoxels) -> None:
    """Write ``occupancy.npz``: log_odds, num_updates, entity, `_evidence` and a JSON header."""
    values = "log_odds of occupancy; num_updates 0 = never seen; entity bits 001 robot, 010 human, 100 swept"
    header = _header(known, {"format": "splatctrl-occupancy 2", "values": values})
    savez(path, {"header": header, **{name: getattr(known.grid, name) for name in _GRID}, **_evidence(known)})


def write_states(path: Path, known: KnownVoxels, states: UInt8) -> None:
    """Write `states` (X, Y, Z) instead of log-odds: a tenth of the size."""
    values = {state.name.lower(): int(state) for state in VoxelState}
    header = _header(known, {"format": "splatctrl-voxel-states 2", "values": values})
    savez(path, {"header": header, "states": states, **_evidence(known)}, level=3)


def _header(known: KnownVoxels, special: Mapping[str, object]) -> Values:
    common = {
        "frame": "world",
        "units": "m",
        "origin": known.grid.origin.tolist(),
        "voxel": known.grid.voxel,
        "shape": list(known.last_seen.shape),
        "last_seen": "1 + index into step_stamps_ns of the last time step with depth through or on it, 0 never, "
        "from 0xF0 of one byte or 0xFFF0 of two on: why never",
        "unseen": {reason.name.lower(): int(reason) & 0xFF for reason in Unseen},
        "unrepresented": "centres (K, 3) [m] of voxels that are occupied, not the robot, and have no splat",
        "edges": "centre and radius (K, 4) [m] of balls in which a surface may go on where its edge was lost",
        "step_stamps_ns": known.step_stamps_ns.tolist(),
    }
    return np.array(json.dumps({**special, **common}))


def _evidence(known: KnownVoxels) -> dict[str, Values]:
    balls = known.unrepresented
    return {
        "last_seen": known.last_seen.astype(np.uint8 if len(known.step_stamps_ns) < FIRST_REASON else np.uint16),
        "unrepresented": balls.centers,
        "unrepresented_labels": balls.labels,
        "edges": np.column_stack([known.edges.centers, known.edges.radii]),
    }


def _refuse(path: Path, what: str) -> AbstractContextManager[None]:
    return refuse_faults(
        lambda error: (
            f"{path}: no such file" if isinstance(error, FileNotFoundError) else f"{path}: not {what}: {error}"
        ),
        Exception,
    )


def read_states(path: Path) -> OccupancyGrid:
    """Read a `write_states` grid. Raises InputError otherwise; never unpickles."""
    with _refuse(path, _STATES):
        arrays = read_arrays(path, ("header", "states"), most=_HEADER + MOST_VOXELS)
        header = json.loads(str(arrays["header"]))
        states = _voxels(arrays["states"], "states", np.uint8, header)
        return OccupancyGrid.from_states(np.array(header["origin"], np.float64), float(header["voxel"]), states)


def read_seen(path: Path) -> SeenVoxels | None:
    """Read only voxels' last views and lost edges.

    None in an older file. Raises InputError for another kind.
    """
    with _refuse(path, _OURS):
        header = _read_header(path)
        if "step_stamps_ns" not in header:
            return None
        is_snapshot = str(header.get("format")).startswith("splatctrl-voxel-states")
        names = ("last_seen", *({"edges"} & header.keys()), *(["states"] if is_snapshot else []))
        arrays = read_arrays(path, names, most=3 * MOST_VOXELS + _MOST_EDGES)
        stamps_ns = np.array(header["step_stamps_ns"], np.int64)
        states = _voxels(arrays["states"], "states", np.uint8, header) if is_snapshot else None
        return SeenVoxels(
            origin=np.array(header["origin"], np.float64),
            voxel=float(header["voxel"]),
            last_seen=_last_seen(arrays["last_seen"], header, len(stamps_ns)),
            step_stamps_ns=stamps_ns,
            edges=_edges(arrays),
            is_free=None if states is None else states == VoxelState.FREE,
        )


def _read_header(path: Path) -> dict[str, Any]:
    header: dict[str, Any] = json.loads(str(read_arrays(path, ("header",), most=_HEADER)["header"]))
    return header


def read_occupancy(path: Path) -> OccupancyGrid:
    """Read the ``occupancy.npz`` grid. Raises InputError otherwise; never unpickles."""
    with _refuse(path, _OCCUPANCY):
        arrays = read_arrays(path, ("header", *_GRID), most=_HEADER + 7 * MOST_VOXELS)
        return _grid_of(arrays, json.loads(str(arrays["header"])))


def read_known_occupancy(path: Path) -> KnownVoxels | None:
    """Read all of ``occupancy.npz``; None in an older file. Raises InputError otherwise."""
    with _refuse(path, _OCCUPANCY):
        header = _read_header(path)
        if "step_stamps_ns" not in header:
            return None
        arrays = read_arrays(
            path, (*_GRID, *_EVIDENCE, *({"edges"} & header.keys())), most=22 * MOST_VOXELS + _MOST_EDGES
        )
        grid = _grid_of(arrays, header)
        stamps_ns = np.array(header["step_stamps_ns"], np.int64)
        last_seen = _last_seen(arrays["last_seen"], header, len(stamps_ns))
        wide = last_seen.astype(np.uint16)
        if last_seen.dtype == np.uint8:
            wide[last_seen >= FIRST_REASON] += _WIDE
        return KnownVoxels(
            grid=grid,
            last_seen=wide,
            step_stamps_ns=stamps_ns,
            unrepresented=_balls(arrays, grid.voxel),
            edges=_edges(arrays),
        )


def read_unrepresented(path: Path) -> Balls | None:
    """Read only unrepresented voxels; None in an older file. Raises InputError for another kind."""
    with _refuse(path, _OURS):
        header = _read_header(path)
        if "step_stamps_ns" not in header:
            return None
        return _balls(read_arrays(path, _EVIDENCE[1:], most=13 * MOST_VOXELS), float(header["voxel"]))


def _grid_of(arrays: Arrays, header: Mapping[str, Any]) -> OccupancyGrid:
    return OccupancyGrid(
        origin=np.array(header["origin"], np.float64),
        voxel=float(header["voxel"]),
        **{name: _voxels(arrays[name], name, kind, header) for name, kind in _GRID.items()},
    )


def _last_seen(stored: Array, header: Mapping[str, Any], num_steps: int) -> Array:
    """Check `last_seen` of one byte or two; its largest numbers say why never seen."""
    is_short = stored.dtype == np.uint8
    stored = _voxels(stored, "last_seen", np.uint8 if is_short else np.uint16, header)
    is_old = "unseen" not in header  # then only the largest number is no time step, and means `UNANSWERED`
    if is_short and num_steps >= FIRST_REASON:
        is_none = (stored == 0xFF) & (num_steps < 0xFF)
        stored = np.where(is_none, np.uint16(Unseen.UNANSWERED), stored.astype(np.uint16))
    highest = int(np.iinfo(stored.dtype).max)
    is_late = (stored > num_steps) & (stored < (highest if is_old else highest & ~0xF))
    if is_late.any():
        raise ValueError(f"last_seen: expected at most {num_steps} time steps, got {stored[is_late].max()}")
    return stored


def _balls(arrays: Arrays, voxel: float) -> Balls:
    centers, labels = arrays["unrepresented"], arrays["unrepresented_labels"]
    refuse_if(
        centers.dtype != np.float32 or labels.dtype != np.uint8 or centers.shape != (labels.size, 3),
        f"unrepresented: expected float32 (K, 3) and uint8 (K,), got {centers.shape}, {labels.shape}",
        error=ValueError,
    )
    refuse_if(not np.isfinite(centers).all(), "unrepresented: expected finite centres", error=ValueError)
    return Balls.from_voxels(centers, voxel, labels)


def _edges(arrays: Arrays) -> LostEdges:
    if "edges" not in arrays:
        return NO_EDGES
    edges = arrays["edges"]
    refuse_if(
        edges.dtype != np.float32 or edges.shape != (edges.size // 4, 4) or not np.isfinite(edges).all(),
        f"edges: expected finite float32 (K, 4), got {edges.dtype} {edges.shape}",
        error=ValueError,
    )
    return LostEdges(centers=edges[:, :3], radii=edges[:, 3])


def _voxels(values: Array, name: str, kind: type[np.generic], header: Mapping[str, Any]) -> Array:
    expected = (np.dtype(kind), tuple(header["shape"]))
    refuse_if(
        (values.dtype, values.shape) != expected or len(values.shape) != 3,
        f"{name}: expected {expected[0]} {expected[1]}, got {values.dtype} {values.shape}",
        error=ValueError,
    )
    return values


def known_space(grid: OccupancyGrid, thresholds: OccupancyConfig) -> dict[str, object]:
    """A grid's extent [m], share of each `VoxelState`, robot and human voxels."""
    states = grid.states(thresholds.free_below, thresholds.occupied_above)
    counts = np.bincount(states.ravel(), minlength=len(VoxelState))
    return {
        "extent_m": [round(grid.voxel * count, 6) for count in states.shape],
        "free_below": thresholds.free_below,
        "occupied_above": thresholds.occupied_above,
        "share": {state.name.lower(): round(float(counts[state] / states.size), 6) for state in VoxelState},
        "robot_voxels": int(np.count_nonzero(grid.entity & Label.ROBOT)),
        "human_voxels": int(np.count_nonzero(grid.entity & Label.HUMAN)),
    }
