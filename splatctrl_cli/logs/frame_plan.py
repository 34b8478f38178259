"""Which images of a log become frames, and where their cameras stood: some fifty bytes of memory a frame."""

from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.files.rows import BLOCK, RowFile
from splatctrl_cli.logs.rig import Camera
from splatctrl_cli.records import Float64

Index = NDArray[np.int64]
NO_MASK = -1


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A frame to be: message numbers within the colour, depth and mask topics (None: no mask), and the pose."""

    stamp_ns: int
    camera: Camera
    color_index: int
    depth_index: int
    human_index: int | None
    T_world_camera: Float64

    @property
    def keys(self) -> list[tuple[str, int]]:
        """Topic and number of each of its images."""
        camera = self.camera
        keys = [(camera.color_topic, self.color_index), (camera.depth_topic, self.depth_index)]
        return keys if self.human_index is None else [*keys, (camera.human_topic, self.human_index)]


class FramePlan:
    """The frames of a log, by stamp, then camera, then number of the colour image."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._cameras = tuple(sorted(cameras, key=lambda camera: camera.name))
        self._columns = np.zeros((6, 0), dtype=np.int64)  # stamp, camera, colour, depth and mask number, row of pose
        self._poses = RowFile((3, 4))

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
            T_world_camera=np.vstack([self._poses.read(row, row + 1)[0], [[0.0, 0.0, 0.0, 1.0]]]),
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
        """Take those frames (K,) of a camera whose pose (4, 4) is known, masks by colour number; returns how many."""
        first = len(self._poses)
        is_known = self._written(poses)
        number = self._cameras.index(camera)
        human = np.array([masks.get(index, NO_MASK) for index in color[is_known].tolist()], dtype=np.int64)
        num = int(is_known.sum())
        rows = first + np.arange(num)
        fresh = np.stack([stamp_ns[is_known], np.full(num, number), color[is_known], depth[is_known], human, rows])
        columns = np.concatenate([self._columns, fresh], axis=1)
        self._columns = columns[:, np.lexsort((columns[2], columns[1], columns[0]))]
        return num

    def _written(self, poses: Iterable[Float64 | None]) -> NDArray[np.bool_]:
        """Write the poses that are known; which these are (K,)."""
        is_known, waiting = array("b"), []
        for T in poses:
            is_known.append(T is not None)
            if T is not None:
                waiting.append(T[:3])
            if len(waiting) == BLOCK:
                self._poses.append(np.array(waiting))
                waiting = []
        if waiting:
            self._poses.append(np.array(waiting))
        return np.array(is_known, dtype=np.bool_)

    def uses(self) -> dict[str, Index]:
        """How many frames need each image, by topic and number."""
        found: dict[str, Index] = {}
        for number, camera in enumerate(self._cameras):
            of_camera = self._columns[:, self._columns[1] == number]
            for topic, row in ((camera.color_topic, 2), (camera.depth_topic, 3), (camera.human_topic, 4)):
                indices = of_camera[row][of_camera[row] != NO_MASK]
                if len(indices):
                    counts = np.bincount(indices)
                    before = found.get(topic, np.zeros(0, dtype=np.int64))
                    longer = np.zeros(max(len(before), len(counts)), dtype=np.int64)
                    longer[: len(before)] = before
                    longer[: len(counts)] += counts
                    found[topic] = longer
        return found
