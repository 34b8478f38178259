"""What came while no camera looked: where the next depth shows a thing in the arm's place of a moment before it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import UNWATCHED_AFTER_NS, UNWATCHED_APART_NS, UNWATCHED_NS
from splatctrl_cli.control.audit import moving_clearance
from splatctrl_cli.control.near_space import NearSpace
from splatctrl_cli.jobs.replays.known_scene import KnownScene
from splatctrl_cli.records import Float64, Stamps
from splatctrl_cli.robot.model import RobotModel

STEP_NS = 100_000_000  # between looks after a motion


@dataclass(frozen=True, kw_only=True)
class Unwatched:
    """A stretch of time without depth from about the arm, from `since_ns` to `until_ns`, after which a thing stands
    in its place: the arm of `stamp_ns`, in that time, is `clearance` [m] from it, less than the margin.
    """

    since_ns: int
    until_ns: int
    stamp_ns: int
    clearance: float


class Hindsight:
    """Keeps the postures since the last depth from about the arm, and holds them against the map after the next."""

    def __init__(self, model: RobotModel, scene: KnownScene, near: NearSpace, margin: float) -> None:
        self._model, self._scene, self._near, self._margin = model, scene, near, margin
        self._stamps: list[int] = []
        self._postures: list[Float64] = []
        self._seen_ns: int | None = None  # when most of the space about the arm was last seen
        self.found: list[Unwatched] = []

    def add(self, stamps: Stamps, positions: Float64) -> None:
        """The next states (T,), (T, J) of the motion."""
        for at, stamp in enumerate(stamps.tolist()):
            if not self._stamps or stamp >= self._stamps[-1] + UNWATCHED_APART_NS or at == len(stamps) - 1:
                self._stamps.append(stamp)
                self._postures.append(positions[at].copy())

    def looked(self, stamp_ns: int, age_s: float) -> None:
        """At a stamp the depth from about the arm was so old; NaN where that is not known."""
        if not np.isfinite(age_s):
            return
        seen_ns = stamp_ns - round(age_s * 1e9)
        before, self._seen_ns = self._seen_ns, max(seen_ns, self._seen_ns or seen_ns)
        num = int(np.searchsorted(self._stamps, self._seen_ns, side="right"))
        if before is not None and self._seen_ns - before > UNWATCHED_NS and num:
            self._hold_against(before, stamp_ns, num)
        del self._stamps[:num], self._postures[:num]

    def finish(self) -> None:
        """After the motion: wait for the next depth, and look back once more."""
        if not self._stamps or self._seen_ns is None:
            return
        last_ns, last = self._stamps[-1], self._postures[-1]
        for stamp_ns in self._later(last_ns):
            known = self._scene.seen_at(stamp_ns)
            if known is not None:
                self.looked(stamp_ns, self._near.look(stamp_ns, last, known).age)
            if not self._stamps:
                return

    def _later(self, stamp_ns: int) -> Iterator[int]:
        """Stamps at which a newer scene is known."""
        shown = self._scene.age_s(stamp_ns)
        for later_ns in range(stamp_ns + STEP_NS, stamp_ns + UNWATCHED_AFTER_NS, STEP_NS):
            age = self._scene.age_s(later_ns)
            if age < shown + (later_ns - stamp_ns) * 1e-9 - 1e-6:
                yield later_ns

    def _hold_against(self, since_ns: int, until_ns: int, num: int) -> None:
        """The first `num` postures against the map at `until_ns`: those that were clear of what was known of then."""
        q = np.asarray(self._postures[:num])
        after = self._clearance(until_ns, q)
        late = np.flatnonzero(after < self._margin)
        late = np.array([k for k in late if self._clearance(self._stamps[k], q[[k]])[0] >= self._margin], np.int64)
        if not len(late):
            return
        worst = int(late[np.argmin(after[late])])
        self.found.append(
            Unwatched(
                since_ns=since_ns, until_ns=until_ns, stamp_ns=self._stamps[worst], clearance=float(after[worst])
            )
        )

    def _clearance(self, stamp_ns: int, q: Float64) -> Float64:
        """Of postures (T, J) in the map that is known at a stamp (T,) [m]."""
        distance = self._scene.at(stamp_ns).distances["exact"]
        return moving_clearance(self._model, self._model.sphere_centers_batch(q), distance)[0].distance
