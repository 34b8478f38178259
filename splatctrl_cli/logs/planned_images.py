"""The second pass over a log: brings the images of each planned frame together, in the plan's order."""

import tempfile
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace

from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage
from splatctrl_cli.files.rows import scratch_folder
from splatctrl_cli.logs.decoder import MessageDecoder, UndecodableMessageError
from splatctrl_cli.logs.frame_plan import FramePlan, Planned
from splatctrl_cli.logs.messages import ImageMessage, read_image
from splatctrl_cli.logs.rig import Camera
from splatctrl_cli.logs.shot import Place

HELD_BYTES = 96 << 20  # of images that wait for others, in memory; more of them wait in a file without a name
Key = tuple[str, int]  # topic, number of the message within it


class HeldMessages:
    """Messages that wait for others; where a log keeps its topics apart, these can be half of it."""

    def __init__(self) -> None:
        self._messages: dict[Key, RawMessage] = {}
        self._places: dict[Key, tuple[int, int]] = {}  # first byte and length in the file
        self._num_bytes = 0
        self._file = tempfile.TemporaryFile(dir=str(scratch_folder()))  # noqa: SIM115
        weakref.finalize(self, self._file.close)

    def __contains__(self, key: Key) -> bool:
        return key in self._messages

    def add(self, key: Key, message: RawMessage) -> None:
        """Keep a message."""
        if self._num_bytes + len(message.data) > HELD_BYTES:
            first = self._file.seek(0, 2)
            self._file.write(message.data)
            self._places[key] = (first, len(message.data))
            message = replace(message, data=b"")
        self._num_bytes += len(message.data)
        self._messages[key] = message

    def get(self, key: Key) -> RawMessage:
        """A message, which stays."""
        message, place = self._messages[key], self._places.get(key)
        if place is None:
            return message
        self._file.seek(place[0])
        return replace(message, data=self._file.read(place[1]))

    def pop(self, key: Key) -> RawMessage:
        """A message, which goes."""
        found = self.get(key)
        self._num_bytes -= len(self._messages.pop(key).data)
        self._places.pop(key, None)
        if not self._places:
            self._file.seek(0)
            self._file.truncate()
        return found


class PlannedImages:
    """The images of the frames of a plan."""

    def __init__(self, log: RawLog, plan: FramePlan) -> None:
        self._log = log
        self._plan = plan
        self._held = HeldMessages()
        self._uses = plan.uses()

    def of_frames(
        self, damage: Damage, decodes: Callable[[Camera], bool]
    ) -> Iterator[tuple[Planned, list[ImageMessage], tuple[Place, ...]]]:
        """Yield each planned frame with its colour, depth and mask, and their places; what fails goes to `damage`.

        decodes: whether all of a camera's images are decoded, and not only those that a capture cannot keep.
        """
        numbers = dict.fromkeys(self._uses, 0)
        decoder = MessageDecoder()
        position, num = 0, len(self._plan)
        planned = self._plan[0]
        for message in self._log.messages(Damage(), set(self._uses)):  # the survey has counted this damage
            topic, number = message.topic.name, numbers[message.topic.name]
            numbers[topic] = number + 1
            if number >= len(self._uses[topic]) or not self._uses[topic][number]:
                continue
            self._held.add((topic, number), message)
            while position < num and all(key in self._held for key in planned.keys):
                taken = [self._take(key) for key in planned.keys]
                try:
                    images = _read(decoder, planned.camera, taken, is_whole=decodes(planned.camera))
                except UndecodableMessageError as error:
                    damage.add(f"camera {planned.camera.name} at {planned.stamp_ns} ns: {error}")
                else:
                    yield planned, images, tuple(_place(message) for message in taken)
                position += 1
                if position < num:
                    planned = self._plan[position]
        if position < num:
            name = self._log.path.name
            damage.add(f"{name}: {num - position} frames that were there are gone: it changed while it was read")

    def _take(self, key: Key) -> RawMessage:
        topic, number = key
        self._uses[topic][number] -= 1
        return self._held.get(key) if self._uses[topic][number] else self._held.pop(key)


def keeps_files(camera: Camera) -> tuple[bool, bool, bool]:
    """Whether image files of colour, depth and masks go into a capture as they are."""
    is_plain = camera.undistortion is None
    return is_plain, is_plain and camera.depth_to_color is None, False


def _read(
    decoder: MessageDecoder, camera: Camera, messages: list[RawMessage], *, is_whole: bool
) -> list[ImageMessage]:
    """Colour, depth and mask; is_whole: all of them decoded. Raises UndecodableMessageError."""
    kept = (False,) * 3 if is_whole else keeps_files(camera)
    images = [
        read_image(decoder.decode(message), message.topic.type_name, lazily=lazily)
        for message, lazily in zip(messages, kept, strict=False)
    ]
    registration = camera.depth_to_color
    lenses = (camera.intrinsics, camera.intrinsics if registration is None else registration.depth_intrinsics)
    for image, lens in zip(images, lenses, strict=False):
        if (image.width, image.height) != (lens.width, lens.height):
            raise UndecodableMessageError(
                f"expected an image of {lens.width}x{lens.height}, got {image.width}x{image.height}"
            )
    return images


def _place(message: RawMessage) -> Place:
    return Place(file=message.file, offset=message.offset, log_time_ns=message.log_time_ns)
