"""Obstacles that only later depth shows where the arm was."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from splatctrl_cli.config.fixed import UNWATCHED_AFTER_NS, UNWATCHED_APART_NS, UNWATCHED_NS
from splatctrl_cli.control.near_space import NearSpace
from splatctrl_cli.jobs.replay.known_scene import KnownScene
from splatctrl_cli.records import Float64, Stamps

STEP_NS = 100_000_000  # between looks after a motion

ClearanceIn = Callable[[int, Stamps, Float64], Float64]
"""Function of a scene's stamp, stamps (T,), positions (T, J): clearances (T,) [m] without declared contact."""


@dataclass(frozen=True, kw_only=True)
class LaterDepth:
    """State with the margin in its own map, but not in later depth.

    stamp_ns: of the state. clearance [m]: in the depth of `depth_ns`. since_ns: start of the time without depth about
    the arm, or 0.
    """

    depth_ns: int
    stamp_ns: int
    clearance: float
    since_ns: int = 0


class NewerDepth:
    """Comparison of states with their own depth, and of the last state with later depth."""

    def __init__(self, scene: KnownScene, margin: float, clearance_in: ClearanceIn) -> None:
        self._scene, self._margin, self._clearance_in = scene, margin, clearance_in
        self._waiting: list[tuple[int, Float64]] = []  # states whose own depth is not known yet
        self._last: tuple[int, Float64] | None = None
        self.later: list[LaterDepth] = []

    def add(self, stamps: Stamps, positions: Float64, clearance: Float64) -> None:
        """Add stamps (T,), positions (T, J) and clearances (T,) [m] in the map of their time."""
        is_clear = clearance >= self._margin
        states = [(int(stamps[k]), positions[k].copy()) for k in np.flatnonzero(is_clear)]
        self._last = states[-1] if is_clear[-1] else None
        if self._scene.own_ns(int(stamps[-1])) != stamps[-1]:
            self._waiting += states
            self._hold(int(stamps[-1]))

    def finish(self) -> None:
        """Compare waiting states with their own depth, and the last state with the next depth."""
        if self._last is None or not self._scene.stamps_ns:
            return
        stamp_ns, q = self._last
        own_ns = self._scene.own_ns(stamp_ns)
        self._hold(own_ns)
        before_ns, known_ns = self._scene.depth_ns(own_ns), self._scene.next_ns(own_ns)
        next_ns = None if known_ns is None else self._scene.depth_ns(known_ns)
        if known_ns is None or before_ns is None or next_ns is None or next_ns - before_ns > UNWATCHED_NS:
            return  # a longer gap is left to `Hindsight`
        self._compare(known_ns, [(stamp_ns, q)])

    def _hold(self, now_ns: int) -> None:
        own_ns = self._scene.own_ns
        due = [state for state in self._waiting if own_ns(state[0]) <= now_ns]
        del self._waiting[: len(due)]
        for _, together in groupby(due, key=lambda state: self._scene.depth_ns(own_ns(state[0]))):
            states = list(together)
            self._compare(own_ns(states[0][0]), states)

    def _compare(self, known_ns: int, states: Sequence[tuple[int, Float64]]) -> None:
        stamps = np.array([stamp for stamp, _ in states])
        clearance = self._clearance_in(known_ns, stamps, np.array([q for _, q in states]))
        worst = int(clearance.argmin())
        if clearance[worst] < self._margin and (depth_ns := self._scene.depth_ns(known_ns)) is not None:
            self.later.append(
                LaterDepth(depth_ns=depth_ns, stamp_ns=int(stamps[worst]), clearance=float(clearance[worst]))
            )


class Hindsight:
    """Comparison of a later map with postures since the last depth about the arm."""

    def __init__(self, scene: KnownScene, near: NearSpace, margin: float, clearance_in: ClearanceIn) -> None:
        self._scene, self._near, self._margin, self._clearance_in = scene, near, margin, clearance_in
        self._stamps: list[int] = []
        self._postures: list[Float64] = []
        self._seen_ns: int | None = None  # when most of the space about the arm was last seen
        self.later: list[LaterDepth] = []

    def add(self, stamps: Stamps, positions: Float64) -> None:
        """Add stamps (T,) and positions (T, J) of the motion."""
        for at, stamp in enumerate(stamps.tolist()):
            if not self._stamps or stamp >= self._stamps[-1] + UNWATCHED_APART_NS or at == len(stamps) - 1:
                self._stamps.append(stamp)
                self._postures.append(positions[at].copy())

    def looked(self, stamp_ns: int, age_s: float) -> None:
        """Register the age [s] of depth about the arm; NaN if unknown."""
        if not np.isfinite(age_s):
            return
        seen_ns = stamp_ns - round(age_s * 1e9)
        before, self._seen_ns = self._seen_ns, max(seen_ns, self._seen_ns or seen_ns)
        num = int(np.searchsorted(self._stamps, self._seen_ns, side="right"))
        if before is not None and self._seen_ns - before > UNWATCHED_NS and num:
            self._hold_against(before, stamp_ns, num)
        del self._stamps[:num], self._postures[:num]

    def finish(self) -> None:
        """Wait for the next depth after the motion, and compare once more."""
        if not self._stamps or self._seen_ns is None:
            return
        last_ns, last = self._stamps[-1], self._postures[-1]
        shown = self._scene.age_s(last_ns)
        for stamp_ns in range(last_ns + STEP_NS, last_ns + UNWATCHED_AFTER_NS, STEP_NS):
            is_newer = self._stamps and self._scene.age_s(stamp_ns) < shown + (stamp_ns - last_ns) * 1e-9 - 1e-6
            if is_newer and (known := self._scene.seen_at(stamp_ns)) is not None:
                self.looked(stamp_ns, self._near.look(stamp_ns, last, known).age)

    def _hold_against(self, since_ns: int, until_ns: int, num: int) -> None:
        stamps, q = np.array(self._stamps[:num]), np.asarray(self._postures[:num])
        after = self._clearance_in(until_ns, stamps, q)
        near = np.flatnonzero(after < self._margin)
        before = (self._clearance_in(int(stamps[k]), stamps[[k]], q[[k]])[0] for k in near)  # each in its own time
        late = [k for k, clearance in zip(near, before, strict=True) if clearance >= self._margin]
        if not late:
            return
        worst = min(late, key=lambda k: after[k])
        self.later.append(
            LaterDepth(
                since_ns=since_ns, depth_ns=until_ns, stamp_ns=self._stamps[worst], clearance=float(after[worst])
            )
        )
