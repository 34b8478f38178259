"""``--golden``: the commands of this replay against those of an earlier one, step by step."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from splatctrl_cli.errors import GateFailed, InputError, UsageError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, failed
from splatctrl_cli.jobs.replays.request import ReplayRequest
from splatctrl_cli.jobs.replays.result import Replay


@dataclass(frozen=True, kw_only=True)
class Golden:
    """The commands of an earlier run: joint names (J,), and per step its stamp [ns] and velocities (J,), None where
    there was no command.
    """

    path: Path
    joints: tuple[str, ...]
    stamps_ns: tuple[int, ...]
    velocity: tuple[tuple[float, ...] | None, ...]


def read_golden(request: ReplayRequest) -> Golden | None:
    """The earlier run that --golden names, None without one. Raises UsageError for an audit, which commands nothing,
    InputError for a file without commands.
    """
    if request.golden is None:
        return None
    if request.mode == "audit":
        raise UsageError("--golden: an audit has no commands", remedy="give --mode open-loop or closed-loop")
    path: Path = request.golden
    file = path / "steps.csv" if path.is_dir() else path.with_name("steps.csv") if path.suffix == ".json" else path
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            joints = tuple(name[2:] for name in reader.fieldnames or () if name.startswith("v_"))
            rows = [(int(row["stamp_ns"]), _velocity([row[f"v_{joint}"] for joint in joints])) for row in reader]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read: {error}", remedy="give --golden an earlier replay") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: not the steps of a replay: {error}") from None
    if not joints or not rows:
        raise InputError(f"{file}: expected commands (columns v_JOINT), got none", remedy="an audit has none")
    stamps, velocity = zip(*rows, strict=True)
    return Golden(path=file, joints=joints, stamps_ns=stamps, velocity=velocity)


def golden_reason(golden: Golden, replay: Replay, tolerance: float) -> Reason:
    """`check_golden` as a criterion."""
    try:
        check_golden(golden, replay, tolerance)
    except GateFailed as error:
        return failed(
            criterion="golden",
            sentence=error.message,
            remedy=error.remedy,
            count=len(golden.velocity),
            label="golden run differs",
        )
    return Reason(
        criterion="golden", outcome=Outcome.PASSED, sentence=f"as {golden.path}", count=len(golden.velocity)
    )


def check_golden(golden: Golden, replay: Replay, tolerance: float) -> None:
    """Raise GateFailed naming the first step and joint that differ by more than `tolerance` [rad/s], else a number of
    steps that does; InputError where the joints are others.
    """
    joints = tuple(replay.model.joint_names)
    if set(joints) != set(golden.joints):
        raise InputError(f"{golden.path}: expected the joints {', '.join(joints)}, got {', '.join(golden.joints)}")
    order = [golden.joints.index(joint) for joint in joints]
    stamps = replay.audit.stamp_ns
    for index, step in enumerate(islice(replay.steps, len(golden.velocity))):
        when = f"step {index} at {float(stamps[index] - stamps[0]) * 1e-9:.3f} s"
        if int(stamps[index]) != golden.stamps_ns[index]:
            raise GateFailed(f"{when}: expected stamp {golden.stamps_ns[index]} ns, got {stamps[index]} ns")
        expected = golden.velocity[index]
        if expected is None or step is None:
            if (expected is None) != (step is None):
                raise GateFailed(f"{when}: expected {_is_there(expected)}, got {_is_there(step)}")
            continue
        for joint, at, value in zip(joints, order, step.velocity, strict=True):
            if not abs(value - expected[at]) <= tolerance:
                raise GateFailed(
                    f"{when}: joint {joint}: expected {expected[at]:.9g} rad/s within {tolerance:g}, got {value:.9g}",
                    remedy="if the change is meant, keep this run as the golden one",
                )
    if len(replay.steps) != len(golden.velocity):
        raise GateFailed(f"expected {len(golden.velocity)} steps, got {len(replay.steps)}; those in common agree")


def _velocity(cells: Sequence[str]) -> tuple[float, ...] | None:
    """The command of a row, None where every cell is empty."""
    return None if not any(cells) else tuple(float(cell) for cell in cells)


def _is_there(command: object) -> str:
    return "no command" if command is None else "a command"
