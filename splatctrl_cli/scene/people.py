"""How long voxels that nobody sees any more stay a person's."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.records import Label, RgbdFrame
from splatctrl_cli.scene.occupancy import OccupancyMap


class PeopleMemory:
    """The voxels of people, and when a camera last looked at each: indices `voxels` (K,), `stamps_ns` (K,) int64.

    What a camera sees as free or as something else is a person's no longer (`OccupancyMap.take_in`). What none has
    looked at for longer than `memory` [s] is unknown: as if it had never been seen.
    """

    def __init__(self, memory: float) -> None:
        self.memory = memory
        self.voxels: NDArray[np.int64] = np.zeros(0, np.int64)
        self.stamps_ns: NDArray[np.int64] = np.zeros(0, np.int64)

    def take_in(self, occupancy: OccupancyMap, frames: Sequence[RgbdFrame]) -> None:
        """Add the depth images of one time step to a grid, and forget the people whom none has seen for too long."""
        num_updates, log_odds = occupancy.num_updates.reshape(-1), occupancy.log_odds.reshape(-1)
        entity = occupancy.entity.reshape(-1)
        before = num_updates[self.voxels]
        occupancy.take_in(frames)
        is_unseen = num_updates[self.voxels] == before
        unseen, since_ns = self.voxels[is_unseen], self.stamps_ns[is_unseen]
        now_ns = max(frame.stamp_ns for frame in frames)
        lost = unseen[now_ns - since_ns > self.memory * 1e9]
        entity[lost] &= np.uint8(~Label.HUMAN & 0xFF)
        log_odds[lost], num_updates[lost] = 0.0, 0
        self.voxels = np.flatnonzero(entity & Label.HUMAN)
        self.stamps_ns = np.full(len(self.voxels), now_ns, np.int64)
        is_still = np.isin(unseen, self.voxels)
        self.stamps_ns[np.searchsorted(self.voxels, unseen[is_still])] = since_ns[is_still]
