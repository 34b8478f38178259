"""A policy server on this machine: what it is asked, and every way in which it can misbehave."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from threading import Thread
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control import policy
from splatctrl_cli.control.line_process import Fault
from splatctrl_cli.control.outside import OutsideController
from splatctrl_cli.control.policy import (
    PolicyClient,
    RecordedImages,
    pack_array,
    parse_address,
    resize_with_pad,
    unpack_array,
)
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.libraries import import_extra
from splatctrl_cli.records import Intrinsics
from tests.control.fakes import PlanarArm, far_away
from tests.plain import plain_frame
from tests.refused import expect_refusal

msgpack, server = pytest.importorskip("msgpack"), pytest.importorskip("websockets.sync.server")
CONFIG, ARM = ControlConfig(), PlanarArm()
START, END = np.array([0.3, 0.4]), np.array([0.6, 0.5])
TASK = ReplayTask(start=START, T_world_goal=ARM.frame_pose(END, "tip"), frame="tip", home=END)
Answer = Callable[[Any, dict[str, Any], int], None]


def packed(document: Any) -> bytes:
    return bytes(msgpack.packb(document, default=pack_array))


def chunk(*actions: tuple[float, ...]) -> bytes:
    return packed({"actions": np.array(actions)})


@contextmanager
def serving(answer: Answer, metadata: bytes | str = packed({"name": "fake"})) -> Iterator[str]:
    """The address of a server that calls answer(connection, observation, its number), from 1 on."""

    def handle(connection: Any) -> None:
        connection.send(metadata)
        for number, message in enumerate(connection, start=1):
            answer(connection, msgpack.unpackb(message, object_hook=unpack_array), number)

    with server.serve(handle, "127.0.0.1", 0, compression=None) as listening:
        thread = Thread(target=listening.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{listening.socket.getsockname()[1]}"
        finally:
            listening.shutdown()
            thread.join()


def client(address: str, step_limit: float = 10.0, images: RecordedImages | None = None) -> OutsideController:
    images = images or RecordedImages((), ())
    return OutsideController(
        "it", lambda start: PolicyClient(parse_address(address), start, step_limit, images), ARM, CONFIG, frame="tip"
    )


def driven(
    address: str, step_limit: float = 10.0, images: RecordedImages | None = None
) -> tuple[ReplayTrace, OutsideController]:
    with client(address, step_limit, images) as commander:
        config = replace(CONFIG, max_time=8 * CONFIG.period)
        return closed_loop(ARM, config, TASK, lambda _: far_away(), commander=commander), commander


def test_chunks_are_executed_in_order_and_the_next_is_asked_for_after_the_last() -> None:
    seen: list[dict[str, Any]] = []

    def answer(connection: Any, observation: dict[str, Any], number: int) -> None:
        seen.append(observation)
        connection.send(chunk(*((0.1 * number, 0.01 * k, 1.0) for k in range(3))))

    camera = Intrinsics(width=8, height=4, fx=9.0, fy=9.0, cx=3.5, cy=1.5)
    frames = [plain_frame(1.0, camera, stamp_ns=stamp, color=color) for stamp, color in ((0, 50), (10**12, 90))]
    asked = "?state=joints&image=image:cam0&prompt=pick+up+the+cup"
    with serving(answer) as address:
        trace, commander = driven(address + asked, images=RecordedImages(("cam0",), frames))
    assert commander.failure is None and commander.num_answers == len(trace.steps) >= 6
    velocities = [tuple(np.round(step.velocity, 6)) for step in trace.steps]
    assert velocities[:5] == [(0.1, 0.0), (0.1, 0.01), (0.1, 0.02), (0.2, 0.0), (0.2, 0.01)]
    assert seen[0].keys() == {"state", "image", "prompt"} and seen[0]["prompt"] == "pick up the cup"
    assert seen[0]["state"].dtype == np.float32 and seen[1]["state"] == pytest.approx(trace.position[3])
    image = seen[0]["image"]
    assert image.shape == (224, 224, 3) and np.all(image[60:160] == 50) and not image[:56].any()


def test_positions_become_velocities_of_a_period_and_a_horizon_cuts_a_chunk() -> None:
    def answer(connection: Any, observation: dict[str, Any], number: int) -> None:
        aim = observation["observation/joint_position"] + 0.001 * number
        connection.send(packed({"actions": np.stack([aim, aim + 9.0])}))

    with serving(answer) as address:
        trace, _ = driven(f"{address}?actions=position&horizon=1&observation/joint_position=joints")
    found = np.array([step.velocity for step in trace.steps[:3]])
    assert found == pytest.approx(np.array([[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]), abs=1e-4)


FAULTS: dict[str, tuple[Answer, Fault, str]] = {
    "late": (lambda c, o, n: (time.sleep(0.5), c.send(chunk((0.0, 0.0)))), Fault.LATE, "answered after 0."),  # type: ignore[func-returns-value]
    "hangs": (lambda c, o, n: time.sleep(2.0), Fault.HUNG, "no answer within 0.9 s"),
    "nan": (lambda c, o, n: c.send(chunk((0.0, np.nan))), Fault.NOT_FINITE, "got nan of elbow"),
    "one too few": (lambda c, o, n: c.send(chunk((0.0,))), Fault.WRONG_LENGTH, "expected 2 numbers, got 1"),
    "two too many": (lambda c, o, n: c.send(chunk((0.0,) * 4)), Fault.WRONG_LENGTH, "expected 2 numbers, got 4"),
    "no chunk": (
        lambda c, o, n: c.send(packed({"actions": np.zeros(2)})),
        Fault.WRONG_LENGTH,
        "expected an array (H, 2), got shape (2,)",
    ),
    "no actions": (lambda c, o, n: c.send(packed({})), Fault.WRONG_LENGTH, "array (H, 2), got None"),
    "words": (
        lambda c, o, n: c.send(packed({"actions": [["a", "b"]]})),
        Fault.WRONG_LENGTH,
        "array (H, 2), got [['a', 'b']]",
    ),
    "absurd": (lambda c, o, n: c.send(chunk((1e300, 0.0))), Fault.TOO_FAST, "of shoulder, whose limit is 1.5"),
    "closes": (lambda c, o, n: c.close(), Fault.ENDED, "closed the connection"),
    "traceback": (lambda c, o, n: c.send("Traceback:\n  KeyError: 'state'"), Fault.CRASHED, "KeyError: 'state'"),
    "rubbish": (lambda c, o, n: c.send(b"\xc1\xff"), Fault.NOT_MSGPACK, "expected msgpack"),
    "a number": (lambda c, o, n: c.send(packed(3)), Fault.NOT_MSGPACK, "expected a map, got 3"),
    "objects": (
        lambda c, o, n: c.send(
            packed({"actions": {b"__ndarray__": True, b"dtype": "|O", b"data": b"", b"shape": [1]}})
        ),
        Fault.NOT_MSGPACK,
        "array of object",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_ends_the_motion_and_is_kept_by_name(name: str) -> None:
    answer, fault, words = FAULTS[name]
    with serving(answer) as address:
        trace, commander = driven(address, step_limit=0.3 if fault in {Fault.LATE, Fault.HUNG} else 10.0)
    assert commander.failure is not None
    if commander.failure.fault is not fault and fault is Fault.LATE:
        pytest.skip("this machine is too busy to tell late from hung")
    assert commander.failure.fault is fault and words in commander.failure.sentence
    assert trace.outcome is Outcome.CONTROLLER_FAILED and not trace.steps[-1].velocity.any()


def test_two_copies_must_agree() -> None:
    draw = np.random.default_rng(0)
    with serving(lambda c, o, n: c.send(chunk(tuple(draw.uniform(0, 0.1, 2))))) as address:
        images = RecordedImages((), ())
        with OutsideController(
            "it",
            lambda start: PolicyClient(parse_address(address), start, 10.0, images),
            ARM,
            CONFIG,
            frame="tip",
            is_twice=True,
        ) as commander:
            closed_loop(ARM, replace(CONFIG, max_time=0.1), TASK, lambda _: far_away(), commander=commander)
    assert commander.failure is not None and commander.failure.fault is Fault.DIFFERS


def test_what_does_not_answer_at_the_start_is_missing_input(monkeypatch: pytest.MonkeyPatch) -> None:
    def idle(*_: object) -> None: ...

    def missing(module: str, extra: str, what: str) -> Any:
        return import_extra(f"{module}.missing", extra, what)

    expect_refusal(
        "ws://127.0.0.1:9: cannot be reached", client, "ws://127.0.0.1:9", error=InputError, has_remedy=True
    )
    with serving(idle, metadata=b"\xc1") as address:
        expect_refusal("at the start: not msgpack", client, address, error=InputError, has_remedy=True)
    with serving(idle) as address:
        expect_refusal("has no camera cam7; its cameras: none", client, f"{address}?a=image:cam7", error=InputError)
    monkeypatch.setattr(policy, "import_extra", missing)
    with serving(idle) as address:
        expect_refusal(r"pip install 'splatctrl-cli\[policy\]'", client, address, error=UsageError)


@pytest.mark.parametrize(
    "text", ["ws://", "ws://host", "ws://host:x", "ws://h:1?actions=torque", "ws://h:1?horizon=-1"]
)
def test_an_address_that_is_none_is_refused(text: str) -> None:
    expect_refusal("--controller: expected", parse_address, text, error=UsageError, has_remedy=True)


@pytest.mark.parametrize("value", [np.float32(0.5), np.arange(6).reshape(2, 3), np.array([True]), np.zeros((0, 3))])
def test_arrays_survive_the_way_there_and_back(value: Any) -> None:
    found = msgpack.unpackb(packed({"x": value}), object_hook=unpack_array)["x"]
    assert found.dtype == value.dtype and np.array_equal(found, value)


def test_an_image_is_scaled_into_a_square() -> None:
    assert resize_with_pad(np.full((400, 100, 3), 9, np.uint8))[100, [83, 84, 139, 140], 0].tolist() == [0, 9, 9, 0]
