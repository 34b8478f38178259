"""``joints.npz`` of a capture: the joint states of one topic, cleaned."""

from pathlib import Path

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.npz_columns import NpzFile
from splatctrl_cli.logs.state_columns import StateColumns

NEEDED = ("stamp_ns", "position", "velocity")
OPTIONAL = ("commanded_velocity", "T_base_ee", "T_world_ee")  # NaN where a state has none, absent where none has one


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
