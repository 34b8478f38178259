"""A log's images that become frames, and the pass that reads them in plan order.

A frame's plan takes some fifty bytes.
"""

import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.files.spilled_rows import RowFile, scratch_folder
from splatctrl_cli.recording.container.raw_log import Damage, RawLog, RawMessage
from splatctrl_cli.recording.log.rig import Camera
from splatctrl_cli.records import Float64, Index

NO_MASK = -1


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A planned frame: message numbers by topic (human_index None: no mask), and the pose."""

    stamp_ns: int
    camera: Camera
    color_index: int
    depth_index: int
    human_index: int | None
    T_world_camera: Float64

    @property
    def keys(self) -> list[tuple[str, int]]:
        """Topic and number of each image."""
        camera = self.camera
        keys = [(camera.color_topic, self.color_index), (camera.depth_topic, self.depth_index)]
        return keys if self.human_index is None else [*keys, (camera.human_topic, self.human_index)]


class FramePlan:
    """Frames by stamp, then camera, then colour number."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._cameras = tuple(sorted(cameras, key=lambda camera: camera.name))
        self._columns = np.zeros((6, 0), dtype=np.int64)  # stamp, camera, colour, depth and mask number, row of pose
        self._poses = RowFile((4, 4))

    def __len__(self) -> int:
        return self._columns.shape[1]

    def __iter__(self) -> Iterator[Planned]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: int) -> Planned:
        stamp, camera, color, depth, human, row = self._columns[:, number].tolist()
        return Planned(
            stamp_ns=stamp,
            camera=self._cameras[camera],
            color_index=color,
            depth_index=depth,
            human_index=None if human == NO_MASK else human,
            T_world_camera=self._poses.read(row, row + 1)[0],
        )

    def add(
        self,
        camera: Camera,
        stamp_ns: Index,
        color: Index,
        depth: Index,
        masks: Mapping[int, int],
        poses: Iterable[Float64 | None],
    ) -> int:
        """Add frames (K,) with known poses (4, 4), masks by colour number; return their number."""
        first = len(self._poses)
        is_known = np.fromiter(map(self._keep, poses), np.bool_, len(stamp_ns))
        human = np.array([masks.get(index, NO_MASK) for index in color[is_known].tolist()], dtype=np.int64)
        num = int(is_known.sum())
        rows = first + np.arange(num)
        fresh = np.stack(
            [
                stamp_ns[is_known],
                np.full(num, self._cameras.index(camera)),
                color[is_known],
                depth[is_known],
                human,
                rows,
            ]
        )
        columns = np.concatenate([self._columns, fresh], axis=1)
        self._columns = columns[:, np.lexsort((columns[2], columns[1], columns[0]))]
        return num

    def _keep(self, T: Float64 | None) -> bool:
        if T is not None:
            self._poses.append(T[None])
        return T is not None

    def uses(self) -> dict[str, Index]:
        """Number of frames that need each image."""
        found: dict[str, list[Index]] = {}
        for number, camera in enumerate(self._cameras):
            of_camera = self._columns[:, self._columns[1] == number]
            for topic, row in ((camera.color_topic, 2), (camera.depth_topic, 3), (camera.human_topic, 4)):
                found.setdefault(topic, []).append(of_camera[row][of_camera[row] != NO_MASK])
        return {
            topic: np.bincount(np.concatenate(indices)) for topic, indices in found.items() if any(map(len, indices))
        }


HELD_BYTES = 96 << 20  # of images that wait for others, in memory; more of them wait in a file without a name
Key = tuple[str, int]  # topic, number of the message within it


class HeldMessages:
    """Waiting messages, which can be half of a log that stores topics apart."""

    def __init__(self) -> None:
        self._messages: dict[Key, RawMessage] = {}
        self._places: dict[Key, tuple[int, int]] = {}  # first byte and length in the file
        self._num_bytes = 0
        self._file = tempfile.TemporaryFile(dir=str(scratch_folder()))  # noqa: SIM115
        weakref.finalize(self, self._file.close)

    def __contains__(self, key: Key) -> bool:
        return key in self._messages

    def add(self, key: Key, message: RawMessage) -> None:
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
        """Remove and return a message."""
        found = self.get(key)
        self._num_bytes -= len(self._messages.pop(key).data)
        self._places.pop(key, None)
        if not self._places:
            self._file.seek(0)
            self._file.truncate()
        return found


def planned_images(
    log: RawLog, plan: FramePlan, damage: Damage, held: HeldMessages
) -> Iterator[tuple[Planned, list[RawMessage]]]:
    """Yield frames in plan order with their colour, depth and mask messages, whatever the log's order.

    `held` keeps waiting ones; missing frames go to `damage`.
    """
    uses, position, num = plan.uses(), 0, len(plan)
    numbers, planned = dict.fromkeys(uses, 0), plan[0]

    def take(topic: str, number: int) -> RawMessage:
        uses[topic][number] -= 1
        return held.get((topic, number)) if uses[topic][number] else held.pop((topic, number))

    for message in log.messages(Damage(), set(uses)):  # the survey has counted this damage
        topic, number = message.topic.name, numbers[message.topic.name]
        numbers[topic] = number + 1
        if number >= len(uses[topic]) or not uses[topic][number]:
            continue
        held.add((topic, number), message)
        while position < num and all(key in held for key in planned.keys):
            yield planned, [take(*key) for key in planned.keys]
            position += 1
            if position < num:
                planned = plan[position]
    if position < num:
        damage.add(f"{log.path.name}: {num - position} frames that were there are gone: it changed while it was read")
