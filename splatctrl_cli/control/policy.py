"""Policy servers in openpi's protocol: msgpack with arrays, over a WebSocket (docs/controllers.md)."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl, urlsplit, urlunsplit

import cv2
import numpy as np

from splatctrl_cli.control.line_process import Fault, Misbehaved, shown
from splatctrl_cli.control.outside import START_LIMIT, Document, StepClock, checked_velocity
from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.libraries import import_extra
from splatctrl_cli.records import Float64, RgbdFrame, UInt8

MAX_ANSWER = 64 << 20  # bytes
SIDE = 224  # [px] of an image, as openpi's client sends it
JOINTS, IMAGE = "joints", "image:"  # values of an observation; any other is text
VELOCITY, POSITION = "velocity", "position"  # meaning of an action
WHAT = "policy servers"
NUMBERS = "fiub"  # kinds of arrays


@dataclass(frozen=True, kw_only=True)
class PolicyAddress:
    """A server's URL without its query, and the query.

    observed: an observation's values by key, empty for the joints and all images. A value is `JOINTS`, `IMAGE` and a
    camera, or text. actions: joint `VELOCITY` [rad/s] or `POSITION` [rad]; horizon: actions of a chunk to execute, 0
    for all.
    """

    url: str
    observed: Mapping[str, str]
    actions: str = VELOCITY
    horizon: int = 0


def is_policy_server(text: str) -> bool:
    return text.startswith(("ws://", "wss://"))


def parse_address(text: str) -> PolicyAddress:
    """Parse ``ws://HOST:PORT?KEY=VALUE&...``. Raises UsageError."""
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        parts, port = urlsplit("ws:"), None
    refuse_if(
        not parts.hostname or port is None,
        f"--controller: expected ws://HOST:PORT, got {text!r}",
        remedy="openpi's servers listen at port 8000",
        error=UsageError,
    )
    observed = dict(parse_qsl(parts.query, keep_blank_values=True))
    actions, horizon = observed.pop("actions", VELOCITY), observed.pop("horizon", "0")
    refuse_if(
        actions not in (VELOCITY, POSITION) or not horizon.isdecimal(),
        f"--controller: expected actions={VELOCITY} or {POSITION}, horizon=N, got {actions!r} and {horizon!r}",
        remedy="correct the text after the question mark",
        error=UsageError,
    )
    url = urlunsplit((parts.scheme, parts.netloc, parts.path, "", ""))
    return PolicyAddress(url=url, observed=observed, actions=actions, horizon=int(horizon))


class RecordedImages:
    """Newest recorded colour image of each camera."""

    def __init__(self, cameras: Iterable[str], frames: Iterable[RgbdFrame]) -> None:
        """frames: by rising stamp."""
        self.cameras = tuple(cameras)
        self._frames, self._newest = iter(frames), dict[str, UInt8]()
        self._next = next(self._frames, None)

    def at(self, stamp_ns: int) -> Mapping[str, UInt8]:
        """Newest image (SIDE, SIDE, 3) by camera up to a stamp [ns]; stamps never go back."""
        while self._next is not None and self._next.stamp_ns <= stamp_ns:
            self._newest[self._next.camera] = self._next.color
            self._next = next(self._frames, None)
        return {camera: resize_with_pad(image) for camera, image in self._newest.items()}


def resize_with_pad(image: UInt8) -> UInt8:
    """Image (H, W, 3) scaled into the middle of a black square (SIDE, SIDE, 3)."""
    height, width = image.shape[:2]
    scale = SIDE / max(height, width)
    high, wide = (max(round(scale * side), 1) for side in (height, width))
    padded = np.zeros((SIDE, SIDE, 3), np.uint8)
    top, left = (SIDE - high) // 2, (SIDE - wide) // 2
    padded[top : top + high, left : left + wide] = cv2.resize(image, (wide, high), interpolation=cv2.INTER_AREA)
    return padded


def pack_array(value: Any) -> Any:
    """NumPy array or number as a map, by openpi's msgpack extension."""
    if isinstance(value, np.ndarray) and value.dtype.kind in NUMBERS:
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic) and value.dtype.kind in NUMBERS:
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"expected an array of numbers, got {type(value).__name__}")


def unpack_array(value: dict[Any, Any]) -> Any:
    """Inverse of `pack_array`. Raises ValueError or TypeError for another kind of array."""
    if b"__ndarray__" in value:
        kind = np.dtype(value[b"dtype"])
        refuse_if(kind.kind not in NUMBERS, f"array of {kind}", error=ValueError)
        return np.ndarray(buffer=value[b"data"], dtype=kind, shape=tuple(value[b"shape"]))
    return np.dtype(value[b"dtype"]).type(value[b"data"]) if b"__npgeneric__" in value else value


class PolicyClient:
    """A connection to a policy server; its chunks of actions are executed in order."""

    def __init__(self, address: PolicyAddress, start: Document, step_limit: float, images: RecordedImages) -> None:
        """Connect, and read the server's metadata. Raises InputError for no answer or an unknown camera."""
        self.clock, self._address, self._images = StepClock(step_limit), address, images
        self._num_joints, self._period, self._chunk = len(start["joints"]), float(start["period"]), list[Float64]()
        self._observed = dict(address.observed) or {
            "observation/joint_position": JOINTS,
            **{f"observation/{camera}": IMAGE + camera for camera in images.cameras},
        }
        for value in self._observed.values():
            camera = value.removeprefix(IMAGE)
            refuse_if(
                value.startswith(IMAGE) and camera not in images.cameras,
                f"{address.url}: the recording has no camera {camera}",
                remedy=f"its cameras: {', '.join(images.cameras) or 'none'}",
            )
        self._opened = ExitStack()
        self._msgpack = import_extra("msgpack", "policy", WHAT)
        client = import_extra("websockets.sync.client", "policy", WHAT)
        self._errors = import_extra("websockets.exceptions", "policy", WHAT)
        try:
            how = {"compression": None, "max_size": MAX_ANSWER, "open_timeout": START_LIMIT, "proxy": None}
            self._socket = self._opened.enter_context(client.connect(address.url, **how))
        except (OSError, TimeoutError, self._errors.WebSocketException) as error:
            raise InputError(
                f"{address.url}: cannot be reached: {error}", remedy="check host and port, and that the server runs"
            ) from None
        try:
            self._receive(max(START_LIMIT, step_limit))
        except Misbehaved as error:
            self.close()
            raise InputError(
                f"{address.url}: at the start: {error}", remedy="start a policy server of openpi"
            ) from None

    def velocity(
        self, question: Document, rows: Callable[[], list[Document]], limits: Mapping[str, float]
    ) -> Float64:
        """Velocities (J,) [rad/s] of the next action. Raises Misbehaved."""
        self.clock.spent = 0.0
        if not self._chunk:
            observation = self._msgpack.packb(self._observe(question), default=pack_array)
            self._chunk = self._actions(self.clock.measure(lambda limit: self._exchange(observation, limit)))
        action = self._chunk.pop(0)
        if len(action) == self._num_joints + 1:  # the last is a gripper's
            action = action[:-1]
        if self._address.actions == POSITION and len(action) == self._num_joints:
            action = (action - np.array(question["q"])) / self._period
        return checked_velocity({"velocity": action.tolist()}, limits)

    def close(self) -> None:
        self._opened.close()

    def _observe(self, question: Document) -> Document:
        images, observation = self._images.at(question["stamp_ns"]), dict[str, Any]()
        for key, value in self._observed.items():
            camera = value.removeprefix(IMAGE)
            if value == JOINTS:
                observation[key] = np.array(question["q"], np.float32)
            elif camera == value:
                observation[key] = value
            elif camera in images:
                observation[key] = images[camera]
        return observation

    def _exchange(self, observation: bytes, limit: float) -> Document:
        try:
            self._socket.send(observation)
        except self._errors.ConnectionClosed as error:
            raise Misbehaved(Fault.ENDED, f"closed the connection: {shown(str(error))}") from None
        return self._receive(limit)

    def _receive(self, limit: float) -> Document:
        try:
            answer = self._socket.recv(timeout=limit)
        except TimeoutError:
            raise Misbehaved(Fault.HUNG, f"no answer within {limit:g} s") from None
        except self._errors.ConnectionClosed as error:
            raise Misbehaved(Fault.ENDED, f"closed the connection: {shown(str(error))}") from None
        if isinstance(answer, str):  # a server's traceback
            raise Misbehaved(Fault.CRASHED, f"the server failed: {shown(answer.strip().rpartition(chr(10))[2])}")
        try:
            document = self._msgpack.unpackb(answer, object_hook=unpack_array)
        except (ValueError, TypeError, KeyError, self._msgpack.UnpackException) as error:
            raise Misbehaved(
                Fault.NOT_MSGPACK, f"expected msgpack, got {shown(repr(answer[:40]))}: {error}"
            ) from None
        if not isinstance(document, dict):
            raise Misbehaved(Fault.NOT_MSGPACK, f"expected a map, got {shown(repr(document))}")
        return document

    def _actions(self, answer: Document) -> list[Float64]:
        """Rows (A,) of a chunk of actions."""
        actions = answer.get("actions")
        is_chunk = (
            isinstance(actions, np.ndarray) and actions.ndim == 2 and actions.size and actions.dtype.kind == "f"
        )
        if not is_chunk:
            got = f"shape {actions.shape}" if isinstance(actions, np.ndarray) else shown(repr(actions))
            raise Misbehaved(Fault.WRONG_LENGTH, f"actions: expected an array (H, {self._num_joints}), got {got}")
        return list(np.asarray(actions, np.float64)[: self._address.horizon or None])
