"""A controller of somebody else's: what it is told, and every way in which it can misbehave."""

import json
import sys
import textwrap
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control import line_process, outside
from splatctrl_cli.control.goals import LoggedMotion
from splatctrl_cli.control.line_process import Fault
from splatctrl_cli.control.outside import OutsideController, Program, class_command
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.replay import OpenLoopTask, Outcome, ReplayTask, ReplayTrace, closed_loop, open_loop
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm, far_away
from tests.refused import expect_refusal

CONFIG = ControlConfig()
START, END = np.array([0.3, 0.4]), np.array([0.6, 0.5])
ARM = PlanarArm()
TASK = ReplayTask(start=START, T_world_goal=ARM.frame_pose(END, "tip"), frame="tip", home=END)
HELLO = """
    import json, os, sys, time
    start = json.loads(input())
    print('{"protocol": 1}', flush=True)
    """
LOOP = """
    for line in sys.stdin:
        asked = json.loads(line)
        answer = {"id": asked["id"], "velocity": [0.1, -0.1]}
        if asked["id"] == 3:
            %s
        print(json.dumps(answer), flush=True)
    """


def program(text: str) -> tuple[str, ...]:
    """A program that is this Python text."""
    return sys.executable, "-S", "-c", textwrap.dedent(text)


def at_third(statement: str) -> tuple[str, ...]:
    """A program that answers twice, and then does this first."""
    return program(HELLO + LOOP % statement)


def make_controller(
    command: tuple[str, ...], *, step_limit: float = 10.0, is_twice: bool = False
) -> OutsideController:
    return OutsideController(
        "it",
        lambda start: Program("it", command, start, step_limit),
        ARM,
        CONFIG,
        frame="tip",
        home=END,
        is_twice=is_twice,
    )


def driven(command: tuple[str, ...], **how: float) -> tuple[ReplayTrace, OutsideController]:
    """Half a second of a closed loop, and the controller that drove it."""
    with make_controller(command, **how) as commander:  # type: ignore[arg-type]
        trace = closed_loop(ARM, replace(CONFIG, max_time=0.5), TASK, lambda _: far_away(), commander=commander)
    return trace, commander


FAULTS = {
    "late": ("time.sleep(0.5)", Fault.LATE, "answered after 0."),
    "hangs": ("time.sleep(60)", Fault.HUNG, "no answer within 0.9 s"),
    "nan": ("answer['velocity'][1] = float('nan')", Fault.NOT_FINITE, "got nan of elbow"),
    "infinite": ("answer['velocity'][0] = float('inf')", Fault.NOT_FINITE, "got inf of shoulder"),
    "endless digits": ("answer['velocity'][0] = 10 ** 400", Fault.NOT_FINITE, "got inf of shoulder"),
    "absurd": ("answer['velocity'][0] = 1e300", Fault.TOO_FAST, "1e+300 rad/s of shoulder, whose limit is 1.5"),
    "one too many": ("answer['velocity'].append(0.0)", Fault.WRONG_LENGTH, "expected 2 numbers, got 3"),
    "none at all": ("del answer['velocity']", Fault.WRONG_LENGTH, 'expected 2 numbers, got {"id": 3}'),
    "words": ("answer['velocity'][0] = 'x'", Fault.WRONG_LENGTH, 'got {"id": 3, "velocity": ["x", -0.1]}'),
    "null": ("answer['velocity'][0] = None", Fault.WRONG_LENGTH, "[null, -0.1]"),
    "exception": ("1 / 0", Fault.CRASHED, "exit status 1: ZeroDivisionError: division by zero"),
    "exit status": ("sys.exit('no\\x1b[31m more')", Fault.CRASHED, "exit status 1: no?[31m more"),
    "leaves": ("sys.exit(0)", Fault.ENDED, "exit status 0"),
    "killed": ("os.kill(os.getpid(), 11)", Fault.CRASHED, "killed by signal 11"),
    "closes stdout": ("os.close(1); time.sleep(60)", Fault.ENDED, "closed its stdout"),
    "rubbish": ("print('hello there')", Fault.NOT_JSON, "got 'hello there'"),
    "nan of C": ("print('{\"id\": 3, \"velocity\": [nan, 0]}')", Fault.NOT_JSON, "[nan, 0]"),
    "a number": ("print(3)", Fault.NOT_JSON, "got '3'"),
    "deep": ("print('[' * 100000)", Fault.NOT_JSON, "'[[["),
    "no text": ("os.write(1, b'\\xff\\xfe\\n')", Fault.NOT_JSON, "JSON object"),
    "endless line": ("[os.write(1, b'x' * 65536) for _ in range(1 << 20)]", Fault.ENDLESS_LINE, "more than 1 MiB"),
    "an answer too many": ("print(json.dumps({**answer, 'id': 2}))", Fault.OUT_OF_TURN, "to id 3, got one to 2"),
    "asks without end": (
        "print('{\"id\": 3, \"ask\": \"rows\"}', flush=True); input(); print('{\"id\": 3, \"ask\": \"rows\"}')",
        Fault.WRONG_LENGTH,
        '"ask": "rows"',
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_ends_the_motion_and_is_kept_by_name(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    statement, fault, words = FAULTS[name]
    if name == "closes stdout":
        monkeypatch.setattr(line_process, "LEAVE_LIMIT", 0.3)
    step_limit = 0.3 if fault in {Fault.LATE, Fault.HUNG} else 10.0
    trace, commander = driven(at_third(statement), step_limit=step_limit)
    assert commander.failure is not None and commander.num_answers == len(trace.steps) - 1
    if commander.failure.fault is not fault and step_limit < 1:
        pytest.skip("this machine is too busy to tell late from hung")
    assert commander.failure.fault is fault and words in commander.failure.sentence
    assert trace.outcome is Outcome.CONTROLLER_FAILED
    assert [step.rung for step in trace.steps] == [Rung.OUTSIDE, Rung.OUTSIDE, Rung.HOLD]
    assert commander.failure.stamp_ns == trace.stamp_ns[2] and not trace.steps[2].velocity.any()
    assert trace.steps[2].status == f"{fault}: {commander.failure.sentence}"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("/nowhere/controller",), "cannot be started: No such file or directory"),
        ((__file__,), "cannot be started: Permission denied"),
        (("a\0b",), "cannot be started: embedded null byte"),
        (program("raise SystemExit('no licence')"), "at the start: crashed: exit status 1: no licence"),
        (program("pass"), "at the start: ended: exit status 0"),
        (
            program("print('Welcome!', flush=True); input(); input()"),
            "at the start: not JSON: expected a JSON object",
        ),
        (program("print('{\"protocol\": 2}')"), "at the start: other protocol: expected protocol 1, got 2"),
        (program("print('{}')"), "at the start: other protocol: expected protocol 1, got None"),
        (class_command("nowhere:Class"), "no module nowhere in "),
        (class_command("json:Class"), "has no class Class"),
        (class_command("fractions:Fraction"), "at the start: crashed: exit status 1: TypeError"),
    ],
)
def test_what_does_not_start_is_refused(command: tuple[str, ...], words: str) -> None:
    assert expect_refusal(words, make_controller, command, has_remedy=True).startswith("it: ")


def test_a_program_that_prints_nothing_is_not_waited_for_nor_one_for_longer_than_its_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(outside, "RUN_LIMIT", 0.2)
    _, commander = driven(at_third("time.sleep(0.3)"))
    assert commander.failure.fault is Fault.OUT_OF_TIME
    monkeypatch.setattr(outside, "START_LIMIT", 0.5)
    sleeping = program("import time; time.sleep(60)")
    expect_refusal("at the start: hung: no answer within 0.5 s", make_controller, sleeping, step_limit=0.1)


def test_a_program_and_what_it_started_are_ended(tmp_path: Path) -> None:
    started = "import subprocess; child = subprocess.Popen(['sleep', '60']); open(%r, 'w').write(str(child.pid))"
    driven(at_third(started % str(tmp_path / "pid")))
    status = Path(f"/proc/{(tmp_path / 'pid').read_text()}/stat")
    for _ in range(100):  # a signal that was sent takes a moment
        if has_ended := not status.exists() or status.read_text().split()[2] == "Z":
            break
        time.sleep(0.1)
    assert has_ended


def test_a_program_is_told_what_our_own_controller_is(tmp_path: Path) -> None:
    heard = tmp_path / "heard"
    trace, _ = driven(at_third(f"open({str(heard)!r}, 'a').write(json.dumps(start) + '\\n' + line)"))
    start, question = map(json.loads, heard.read_text().splitlines())
    assert start == {
        "protocol": 1,
        "joints": ["shoulder", "elbow"],
        "lower": [-2.9, -2.6],
        "upper": [2.9, 2.6],
        "velocity_limit": [1.5, 1.5],
        "acceleration_limit": None,
        "frame": "tip",
        "home": END.tolist(),
        "period": CONFIG.period,
        "margin": CONFIG.margin,
    }
    q = trace.position[2]
    assert question["id"] == 3 and question["stamp_ns"] == trace.stamp_ns[2] and question["q"] == q.tolist()
    assert question["dq"] == [0.1, -0.1] and question["goal_twist"] is None is question["goal_posture"]
    np.testing.assert_array_equal(question["goal"], TASK.T_world_goal)
    np.testing.assert_array_equal(question["pose"], ARM.frame_pose(q, "tip"))
    np.testing.assert_array_equal(question["jacobian"], ARM.frame_jacobian(q, "tip"))
    np.testing.assert_array_equal(question["error"], trace.steps[2].pose_error)


MODULE = """
    import json, random

    class Still:
        def __init__(self, start):
            self.num = len(start.joints)
            print("what a class prints is no answer")

        def step(self, now):
            return [0.0] * self.num

    class Recorded(Still):
        def __init__(self, start):
            super().__init__(start)
            self.velocities = iter(json.load(open("recorded.json")))

        def step(self, now):
            return next(self.velocities)

    class Away(Still):
        def step(self, now):
            from splatctrl_cli import ClearanceRow, ControllerInput
            nearest = min(now.rows(), key=lambda row: row.distance)
            assert isinstance(now, ControllerInput) and isinstance(nearest, ClearanceRow)
            assert now.rows() is now.rows() and nearest.kind == "scene" and nearest.margin == 0.02
            return 0.3 * nearest.G / max(abs(nearest.G))

    class Raises(Still):
        def step(self, now):
            return self.nothing

    class Nothing(Still):
        def step(self, now):
            pass

    class Nested(Still):
        def step(self, now):
            return [[0.0] * self.num]
    """


@pytest.fixture
def classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "own.py").write_text(textwrap.dedent(MODULE))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def recorded(classes: Path, velocities: Sequence[Float64]) -> OutsideController:
    """A class that commands these velocities."""
    (classes / "recorded.json").write_text(json.dumps([velocity.tolist() for velocity in velocities]))
    return make_controller(class_command("own:Recorded"))


def test_the_recorded_commands_of_our_controller_drive_the_same_motion(classes: Path) -> None:
    ball = Balls([ARM.sphere_centers(END)[-1] + np.array([0.0, 0.1, 0.0])], [0.05])
    driving = partial(closed_loop, ARM, replace(CONFIG, max_time=3.0), TASK, lambda _: ball)
    ours = driving()
    assert any(step.interventions for step in ours.steps)
    with recorded(classes, [step.velocity for step in ours.steps]) as commander:
        theirs = driving(commander=commander)
    assert theirs.outcome is ours.outcome and commander.failure is None
    np.testing.assert_array_equal(theirs.position, ours.position)
    for their, our in zip(theirs.steps, ours.steps, strict=True):
        np.testing.assert_array_equal(their.velocity, our.velocity)
        np.testing.assert_array_equal(their.pose_error, our.pose_error)
        assert (their.clearance, their.nearest, their.num_rows) == (our.clearance, our.nearest, our.num_rows)
        assert their.rung is Rung.OUTSIDE and not their.relaxed and not their.interventions


def test_in_open_loop_it_is_asked_at_every_state_until_it_fails(classes: Path) -> None:
    stamps, share = np.arange(6) * 100_000_000, np.linspace(0, 1, 6)[:, None]
    motion = LoggedMotion(stamp_ns=stamps, position=START + share * (END - START), velocity=np.full((6, 2), 0.2))
    given = ARM, CONFIG, motion, OpenLoopTask(frame="tip"), lambda _: far_away()
    asking = partial(open_loop, *given, has_distance=stamps != stamps[2])  # type: ignore[arg-type]
    ours = asking()
    with recorded(classes, ours["v"][[0, 1, 3]]) as commander:
        theirs = asking(commander=commander)
    np.testing.assert_array_equal(theirs["v"][:4], ours["v"][:4])
    assert commander.failure is not None and commander.failure.fault is Fault.CRASHED
    assert "StopIteration" in commander.failure.sentence and commander.failure.stamp_ns == stamps[4]
    assert theirs["rung"] == ["outside", "outside", "", "outside", "hold", ""]
    np.testing.assert_array_equal(theirs["barrier_margin_logged"], ours["barrier_margin_logged"])
    assert theirs["velocity_row_logged"] == ours["velocity_row_logged"]


def test_clearance_rows_are_given_on_request_and_broken_ones_are_told(classes: Path) -> None:
    ball = Balls([ARM.sphere_centers(START)[-1] + np.array([0.0, 0.12, 0.0])], [0.05])
    with make_controller(class_command("own:Away")) as commander:
        trace = closed_loop(ARM, replace(CONFIG, max_time=0.05), TASK, lambda _: ball, commander=commander)
    assert commander.failure is None
    broken = trace.steps[0].relaxed
    assert broken and broken[0].name == trace.steps[0].nearest and broken[0].slack > 0.05  # G v > h: towards it
    assert trace.steps[1].clearance < trace.steps[0].clearance


@pytest.mark.parametrize(
    ("name", "fault", "words"),
    [
        ("Raises", Fault.CRASHED, "exit status 1: AttributeError: 'Raises' object has no attribute 'nothing'"),
        ("Nothing", Fault.CRASHED, "TypeError: own:Nothing.step: expected a row of joint velocities, got None"),
        ("Nested", Fault.CRASHED, "expected a row of joint velocities, got [[0.0, 0.0]]"),
    ],
)
def test_a_class_that_misbehaves_is_named_as_a_program_is(classes: Path, name: str, fault: Fault, words: str) -> None:
    trace, commander = driven(class_command(f"own:{name}"))
    assert commander.failure is not None and len(trace.steps) == 1
    assert commander.failure.fault is fault and words in commander.failure.sentence


def test_two_of_it_must_agree_and_may_talk_much_on_stderr() -> None:
    talking = at_third("[print('x' * 9999, file=sys.stderr) for _ in range(200)]")
    _, same = driven(talking, is_twice=True)
    assert same.failure is None and same.num_answers == 50
    _, other = driven(at_third("answer['velocity'][0] = 0.5 + 1e-9 * os.getpid()"), is_twice=True)
    assert other.failure.fault is Fault.DIFFERS
    assert other.failure.sentence.startswith("two instances answer one input differently: shoulder 0.")
