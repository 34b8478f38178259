"""``joints.npz`` of a capture: the joint states of one topic, cleaned."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.npz_columns import NpzFile
from splatctrl_cli.io.state_columns import StateColumns
from splatctrl_cli.records import JointState

NEEDED = ("stamp_ns", "position", "velocity")
OPTIONAL = ("commanded_velocity", "T_base_ee", "T_world_ee")  # NaN where a state has none, absent where none has one


def joints_file(joints: Sequence[JointState], num_joints: int) -> bytes:
    """The file's content: stamp_ns (T,) int64; position, velocity, and where there are any commanded_velocity (T, J),
    T_base_ee, T_world_ee (T, 4, 4) float64.
    """
    row, pose = (num_joints,), (4, 4)
    arrays: dict[str, Any] = {
        "stamp_ns": np.array([j.stamp_ns for j in joints], dtype=np.int64),
        "position": np.array([j.position for j in joints], dtype=np.float64).reshape(len(joints), num_joints),
        "velocity": np.array([j.velocity for j in joints], dtype=np.float64).reshape(len(joints), num_joints),
    }
    for name in OPTIONAL:
        nothing = np.full(row if name == "commanded_velocity" else pose, np.nan)
        values = [getattr(j, name) for j in joints]
        if any(value is not None for value in values):
            arrays[name] = np.array([nothing if value is None else value for value in values])
    stream = BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def read_joints(path: Path) -> StateColumns:
    """The states of a capture folder's joints.npz, read a block at a time. Raises InputError."""
    file = path / "joints.npz"
    try:
        content = NpzFile(file)
        stamps = content.stamps("stamp_ns", 1, 0, least=0)
        rows = {name: content.rows(name) for name in (*NEEDED[1:], *OPTIONAL) if name in (*NEEDED, *content.names)}
    except InputError as error:
        raise InputError(error.message, remedy="run `splatctrl ingest` again") from None
    if any(len(values) != len(stamps) for values in rows.values()):
        raise InputError(
            f"{file}: expected {len(stamps)} states in every array, got "
            + ", ".join(f"{name} {len(values)}" for name, values in rows.items()),
            remedy="run `splatctrl ingest` again",
        )
    return StateColumns(stamp_ns=stamps, **rows)
