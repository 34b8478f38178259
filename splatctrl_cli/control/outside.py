"""External controllers: processes that answer JSON lines (docs/controllers.md)."""

import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, Protocol, TypeVar

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.line_process import Fault, LineProcess, Misbehaved, shown
from splatctrl_cli.control.step import Commander, ControlStep, Moment, QpIkController, View
from splatctrl_cli.control.terms import JointLimits, RowKind
from splatctrl_cli.control.user_controller import PROTOCOL
from splatctrl_cli.errors import InputError, refuse_faults
from splatctrl_cli.records import Float64, Stamps
from splatctrl_cli.robot.model import RobotModel

STEP_LIMIT = 10.0  # [s] for one answer, also on a busy machine
PATIENCE = 3.0  # times that limit, after which waiting ends
START_LIMIT = 120.0  # [s] for the first answer: loading may take long
RUN_LIMIT = 3600.0  # [s] for all answers together
MAX_SPEED = 10.0  # times a joint's velocity limit; a faster command is a fault
SERVE = "import sys; from splatctrl_cli.control.user_controller import serve; serve(sys.argv[1])"

Document = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Failure:
    """The fault that ended a controller at a stamp [ns]."""

    fault: Fault
    sentence: str
    stamp_ns: int


class StepClock:
    """Time limits of a controller's answers; spent [s]: on the present step."""

    def __init__(self, step_limit: float) -> None:
        self._step_limit, self._seconds = step_limit, 0.0
        self.spent = 0.0

    def measure(self, exchange: Callable[[float], T]) -> T:
        """Answer of `exchange`, a function of its time limit [s]. Raises Misbehaved if late."""
        if self._seconds > RUN_LIMIT:
            raise Misbehaved(Fault.OUT_OF_TIME, f"took {RUN_LIMIT:g} s for all its answers together")
        began = time.monotonic()
        answer = exchange(PATIENCE * self._step_limit)
        seconds = time.monotonic() - began
        self.spent, self._seconds = self.spent + seconds, self._seconds + seconds
        if self.spent > self._step_limit:
            raise Misbehaved(
                Fault.LATE, f"answered after {self.spent:.3g} s, --controller-step-limit {self._step_limit:g}"
            )
        return answer


class Connection(Protocol):
    """A connection to a user's controller."""

    clock: StepClock

    def velocity(
        self, question: Document, rows: Callable[[], list[Document]], limits: Mapping[str, float]
    ) -> Float64: ...

    def close(self) -> None: ...


Connect = Callable[[Document], Connection]
"""The first line (`ControllerStart`) -> a new connection. Raises InputError if the controller cannot start."""


class Program(LineProcess):
    """A controller process (docs/controllers.md)."""

    def __init__(self, name: str, command: Sequence[str], start: Document, step_limit: float) -> None:
        """Start the process and send `start`. Raises InputError if it fails or is no controller."""
        self.clock, self._num = StepClock(step_limit), 0
        with refuse_faults(
            lambda error: f"{name}: cannot be started: {getattr(error, 'strerror', None) or error}",
            OSError,
            ValueError,
            remedy="check its path, and that it may be executed",
        ):
            super().__init__(command)
        try:
            version = _document(self.exchange(_line(start), max(START_LIMIT, step_limit))).get("protocol")
            if version != PROTOCOL:
                raise Misbehaved(Fault.OTHER_PROTOCOL, f"expected protocol {PROTOCOL}, got {shown(repr(version))}")
        except Misbehaved as error:
            self.close()
            is_gone = error.fault in {Fault.CRASHED, Fault.ENDED}
            remedy = "what it is to do" if is_gone else "answer each line with one, and flush it"
            remedy = f"{remedy} (splatctrl help controllers)"
            raise InputError(f"{name}: at the start: {error}", remedy=remedy) from None
        except BaseException:
            self.close()
            raise

    def velocity(
        self, question: Document, rows: Callable[[], list[Document]], limits: Mapping[str, float]
    ) -> Float64:
        """Answered velocities (J,) [rad/s], sending rows on request. Raises Misbehaved.

        limits [rad/s]: by joint.
        """
        self._num += 1
        self.clock.spent, has_rows = 0.0, False
        line = _line({"id": self._num} | question)
        while True:
            answer = _document(self.clock.measure(partial(self.exchange, line)))
            if answer.get("id") != self._num:
                got = shown(repr(answer.get("id")))
                raise Misbehaved(Fault.OUT_OF_TURN, f"expected the answer to id {self._num}, got one to {got}")
            if answer.get("ask") != "rows" or has_rows:
                return checked_velocity(answer, limits)
            line, has_rows = _line({"rows": rows()}), True


class RecordedCommands:
    """A `Connection` that repeats a log's newest command; stamp_ns (T,), commands (T, J) [rad/s]."""

    def __init__(self, stamp_ns: Stamps, commands: Float64) -> None:
        self.clock, self._stamp_ns, self._commands = StepClock(math.inf), stamp_ns, commands

    def velocity(
        self, question: Document, rows: Callable[[], list[Document]], limits: Mapping[str, float]
    ) -> Float64:
        newest = max(int(np.searchsorted(self._stamp_ns, question["stamp_ns"], side="right")) - 1, 0)
        return checked_velocity({"velocity": self._commands[newest].tolist()}, limits)

    def close(self) -> None:
        """Do nothing."""


class OutsideController(Commander, AbstractContextManager["OutsideController"]):
    """The `Commander` of a user's controller, or of two instances with bit-identical answers.

    num_answers; seconds, slowest [s]: their total and longest time.
    """

    def __init__(
        self,
        name: str,
        connect: Connect,
        model: RobotModel,
        config: ControlConfig,
        *,
        frame: str,
        home: Float64 | None = None,
        is_twice: bool = False,
    ) -> None:
        """name: for messages; frame, home: as for `QpIkController`. Raises InputError if it cannot start."""
        self.name, self.num_answers, self.seconds, self.slowest = name, 0, 0.0, 0.0
        self.failure: Failure | None = None
        self._model, self._frame = model, frame
        self._programs: list[Connection] = []
        start = _start(model, config, frame, model.middle if home is None else home)
        try:
            for _ in range(2 if is_twice else 1):
                self._programs.append(connect(start))
        except BaseException:
            self.close()
            raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        while self._programs:
            self._programs.pop().close()

    @property
    def is_over(self) -> bool:
        return self.failure is not None

    def step(self, controller: QpIkController, moment: Moment) -> ControlStep:
        view = controller.view(moment)
        question = _question(self._model, self._frame, moment, view)
        try:
            velocity = self._agree(question, lambda: _rows(controller, view))
        except Misbehaved as error:
            self.failure = Failure(fault=error.fault, sentence=error.sentence, stamp_ns=moment.stamp_ns)
            self.close()
            return controller.take_velocity(view, None, str(error))
        spent = max(program.clock.spent for program in self._programs)
        self.num_answers, self.seconds, self.slowest = (
            self.num_answers + 1,
            self.seconds + spent,
            max(self.slowest, spent),
        )
        return controller.take_velocity(view, velocity)

    def _agree(self, question: Document, rows: Callable[[], list[Document]]) -> Float64:
        limits = dict(zip(self._model.joint_names, self._model.velocity_limit.tolist(), strict=True))
        velocity, *others = [program.velocity(question, rows, limits) for program in self._programs]
        for other in others:
            if len(differs := np.flatnonzero(velocity != other)):
                joint = int(differs[0])
                name, values = self._model.joint_names[joint], (float(velocity[joint]), float(other[joint]))
                raise Misbehaved(
                    Fault.DIFFERS,
                    f"two instances answer one input differently: {name} {values[0]} and {values[1]} rad/s",
                )
        return velocity


def class_command(target: str) -> tuple[str, ...]:
    return sys.executable, "-P", "-c", SERVE, target


def _start(model: RobotModel, config: ControlConfig, frame: str, home: Float64) -> Document:
    return {
        "protocol": PROTOCOL,
        "joints": list(model.joint_names),
        "lower": _list(model.lower),
        "upper": _list(model.upper),
        "velocity_limit": _list(model.velocity_limit),
        "acceleration_limit": _list(JointLimits.of(model, config).acceleration),
        "frame": frame,
        "home": _list(home),
        "period": config.period,
        "margin": config.margin,
    }


def _question(model: RobotModel, frame: str, moment: Moment, view: View) -> Document:
    guide = moment.guide
    return {
        "stamp_ns": moment.stamp_ns,
        "q": _list(moment.q),
        "dq": _list(moment.last_velocity),
        "goal": _list(moment.T_world_goal),
        "goal_twist": None if guide is None else _list(guide.twist),
        "goal_posture": None if guide is None else _list(guide.posture),
        "goal_velocity": None if guide is None else _list(guide.velocity),
        "pose": _list(model.frame_pose(moment.q, frame)),
        "error": _list(view.error),
        "jacobian": _list(view.state.jacobian),
    }


def _rows(controller: QpIkController, view: View) -> list[Document]:
    """Rows of the scene, and of pairs in the program; see `ClearanceRow`."""
    rows, kinds = view.rows, controller.row_kinds
    G = np.concatenate([barrier.G for barrier in rows.barriers])
    h, distance = rows.h, rows.distance
    return [
        {
            "name": name,
            "kind": str(kinds[i]),
            "distance": float(distance[i]),
            "margin": float(rows.margin[i]),
            "G": _list(G[i]),
            "h": float(h[i]),
        }
        for i, name in enumerate(controller.row_names)
        if rows.in_qp[i] or kinds[i] is RowKind.SCENE
    ]


def _list(values: Float64 | None) -> Any:
    return None if values is None else np.asarray(values, np.float64).tolist()


def _line(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode() + b"\n"


def _document(line: bytes) -> Document:
    try:
        # An integer longer than any float is infinite.
        document = json.loads(
            line.decode("utf-8"), parse_int=lambda digits: int(digits) if len(digits) < 300 else math.inf
        )
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict):
        got = shown(line[:200].decode("utf-8", "replace"))
        raise Misbehaved(Fault.NOT_JSON, f"expected a JSON object on a line, got {got!r}")
    return document


def checked_velocity(answer: Document, limits: Mapping[str, float]) -> Float64:
    """Velocities (J,) [rad/s] of an answer; limits: by joint.

    Raises Misbehaved for a wrong length, or values not finite or above MAX_SPEED limits.
    """
    values = answer.get("velocity")
    if not isinstance(values, list) or len(values) != len(limits) or any(type(v) not in (int, float) for v in values):
        got = (
            f"{len(values)}" if isinstance(values, list) and len(values) != len(limits) else shown(json.dumps(answer))
        )
        raise Misbehaved(Fault.WRONG_LENGTH, f"velocity: expected {len(limits)} numbers, got {got}")
    for value, (joint, limit) in zip(values, limits.items(), strict=True):
        if not math.isfinite(value):
            raise Misbehaved(Fault.NOT_FINITE, f"velocity: expected finite numbers, got {value} of {joint}")
        if abs(value) > MAX_SPEED * limit:
            got = shown(repr(value))
            raise Misbehaved(Fault.TOO_FAST, f"velocity: {got} rad/s of {joint}, whose limit is {limit:g}")
    return np.array(values, np.float64)
