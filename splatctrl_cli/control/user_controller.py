"""Python controllers: their input, and the process that serves them (docs/controllers.md)."""

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from splatctrl_cli.records import Float64

PROTOCOL = 1
"""The version of the lines; another one is refused."""


@dataclass(frozen=True, kw_only=True)
class ControllerStart:
    """A controller's initial input.

    joints (J,): names, in the order of all vectors; lower, upper, home (J,) [rad]; velocity_limit (J,) [rad/s];
    acceleration_limit (J,) [rad/s^2] (None: no limit); frame: to drive; period [s] of a velocity; margin [m] to the
    scene.
    """

    joints: tuple[str, ...]
    lower: Float64
    upper: Float64
    velocity_limit: Float64
    acceleration_limit: Float64 | None
    frame: str
    home: Float64
    period: float
    margin: float

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> "ControllerStart":
        arrays = ("lower", "upper", "velocity_limit", "acceleration_limit", "home")
        return cls(
            joints=tuple(document["joints"]),
            frame=document["frame"],
            period=document["period"],
            margin=document["margin"],
            **{name: _array(document[name]) for name in arrays},
        )


@dataclass(frozen=True, kw_only=True)
class ClearanceRow:
    """A row, satisfied by velocities v (J,) [rad/s] with ``G @ v <= h``; G (J,) [m/rad], h [m/s].

    name: moving sphere (kind "scene") or pair of spheres (kind "self"); distance, margin [m].
    """

    name: str
    kind: str
    distance: float
    margin: float
    G: Float64
    h: float


@dataclass(frozen=True, kw_only=True)
class ControllerInput:
    """A controller's input at a step, in world.

    q (J,) [rad]; dq (J,) [rad/s]: last velocity; goal, pose (4, 4): of goal and frame; error (6,) [m, rad]:
    twist from frame to goal in a second, linear first; jacobian (6, J) of the frame. goal_twist (6,) [m/s, rad/s],
    goal_posture (J,) [rad] and its goal_velocity (J,) [rad/s] are None if the goal is only a pose. rows() returns the
    built-in controller's: moving spheres, and pairs that an allowed velocity could violate.
    """

    stamp_ns: int
    q: Float64
    dq: Float64
    goal: Float64
    goal_twist: Float64 | None
    goal_posture: Float64 | None
    goal_velocity: Float64 | None
    pose: Float64
    error: Float64
    jacobian: Float64
    rows: Callable[[], Sequence[ClearanceRow]] = field(repr=False)


class Controller(Protocol):
    """A user's class, constructed with a `ControllerStart`."""

    def step(self, now: ControllerInput) -> Sequence[float] | Float64:
        """Joint velocities (J,) [rad/s] for a period."""


ARRAYS = ("q", "dq", "goal", "goal_twist", "goal_posture", "goal_velocity", "pose", "error", "jacobian")


def serve(target: str) -> None:
    """Answer lines on stdin with the class ``module:Class``; its prints go to stderr."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    questions = os.fdopen(os.dup(0), encoding="utf-8")
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout = sys.stderr

    def answer(**document: object) -> None:
        answers.write(json.dumps(document) + "\n")
        answers.flush()

    def line() -> dict[str, Any]:
        if not (text := questions.readline()):
            sys.exit(0)
        document: dict[str, Any] = json.loads(text)
        return document

    controller = class_named(target)(ControllerStart.of(line()))
    answer(protocol=PROTOCOL)
    while True:
        question = line()
        known: list[Sequence[ClearanceRow]] = []

        def rows(number: int = question["id"], known: list[Sequence[ClearanceRow]] = known) -> Sequence[ClearanceRow]:
            if not known:
                answer(id=number, ask="rows")
                known.append([ClearanceRow(**{**row, "G": _array(row["G"])}) for row in line()["rows"]])
            return known[0]

        arrays = {name: _array(question[name]) for name in ARRAYS}
        now = ControllerInput(stamp_ns=question["stamp_ns"], rows=rows, **arrays)
        answer(id=question["id"], velocity=_velocities(target, controller.step(now)))


def class_named(target: str) -> Callable[[ControllerStart], Controller]:
    """Class ``module:Class``, also from the current folder. Exits with a message if missing."""
    module_name, _, name = target.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        sys.exit(f"no module {error.name} in {Path.cwd()} nor installed")
    factory: Callable[[ControllerStart], Controller] | None = getattr(module, name, None)
    if not callable(factory):
        sys.exit(f"module {module_name} ({module.__file__}) has no class {name}")
    return factory


def _array(values: Sequence[Any] | None) -> Any:
    return None if values is None else np.array(values, np.float64)


def _velocities(target: str, velocity: Sequence[float] | Float64) -> object:
    with suppress(TypeError, ValueError):
        values = np.asarray(velocity, np.float64)
        if values.ndim == 1:
            return values.tolist()
    raise TypeError(f"{target}.step: expected a row of joint velocities, got {repr(velocity)[:80]}")
