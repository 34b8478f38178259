"""Options that say which robot: URDF, folders of its meshes, locked joints, spheres."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.numbers import several
from splatctrl_cli.errors import UsageError


def add_robot(parser: argparse.ArgumentParser, *, spheres: str | None = None) -> None:
    """``--urdf``, ``--packages`` and, where `spheres` says what for, ``--spheres``."""
    parser.add_argument(
        "--urdf", type=Path, required=True, metavar="FILE", help="the robot's URDF (expanded, no xacro)"
    )
    parser.add_argument(
        "--packages",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="folder in which package:// paths of meshes are found (repeatable; default: the folders above the URDF)",
    )
    if spheres is not None:
        parser.add_argument("--spheres", type=Path, metavar="FILE", help=spheres)


def add_lock(parser: argparse.ArgumentParser) -> None:
    """``--lock``."""
    parser.add_argument(
        "--lock",
        action="append",
        default=[],
        metavar="JOINT=VALUE",
        help="hold a joint still at a value [rad or m], and what mimics it, e.g. a finger (repeatable)",
    )


def locked_joints(assignments: list[str]) -> dict[str, float]:
    """Values by joint of ``--lock JOINT=VALUE``. Raises UsageError for a value that is no number."""
    locked = {}
    for assignment in assignments:
        name, _, text = assignment.partition("=")
        value = several(text)
        if len(value) != 1:
            raise UsageError(f"--lock {assignment}: expected JOINT=VALUE, got {text!r} for the value")
        locked[name] = value[0]
    return locked
