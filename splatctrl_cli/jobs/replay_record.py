"""States of a replay as they come, block by block: measured, explained, and kept in files."""

from collections.abc import Iterator, Sequence

import numpy as np

from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.audit import AuditTrace, Stamps, audited
from splatctrl_cli.control.explain import EventFold, EventKind, Obstacle, audit_signals, stale_signal, step_signals
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.jobs.known_scene import KnownScene
from splatctrl_cli.jobs.replay_store import BLOCK, Figures, StoredAudit, StoredObjects
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel


class ReplayRecord:
    """The audit of states (T,) in the scenes as they were known, what is nearest to the nearest sphere of each, in
    words, the age (T,) [s] of each state's scene, and what happened.
    """

    def __init__(self, model: "RobotModel", scene: KnownScene, *, margin: float, max_map_age: float) -> None:
        self.audit, self.obstacles, self.ages = StoredAudit(), StoredObjects[str](), Figures()
        self.events = EventFold()
        self._model, self._scene, self._margin, self._max_map_age = model, scene, margin, max_map_age
        self._spheres = sphere_names(model.sphere_set)
        self._number = {name: number for number, name in enumerate(self._spheres)}

    def blocks(self, stamps: Stamps) -> Iterator[tuple[int, int]]:
        """Ranges of at most BLOCK consecutive states of stamps (T,) that see the same scene."""
        first = 0
        while first < len(stamps):
            scene, last = self._scene.at(int(stamps[first])), first + 1
            end = min(first + BLOCK, len(stamps))
            while last < end and self._scene.at(int(stamps[last])) is scene:
                last += 1
            yield first, last
            first = last

    def measured(self, stamps: Stamps, positions: Float64) -> AuditTrace:
        """The audit of the next block of states (T, J), which see one scene."""
        scene = self._scene
        part = audited(
            self._model, stamps, positions, lambda stamp: scene.at(stamp).distances, observed=scene.observed
        )
        self.audit.add(part)
        self.obstacles.extend(["" if obstacle is None else str(obstacle) for obstacle in self._nearest(part)])
        self.ages.append(map_age_s=np.array([scene.age_s(stamp) for stamp in stamps.tolist()]))
        return part

    def explain(self, part: AuditTrace, steps: Sequence[ControlStep | None] = ()) -> None:
        """Find what happened in the block that was measured last, with what a controller did there."""
        signals = audit_signals(part, self._margin, self._spheres, self._model.joint_names)
        age_s = np.array([self._scene.age_s(stamp) for stamp in part.stamp_ns.tolist()])
        signals.append(stale_signal(age_s, self._max_map_age))
        if steps:
            signals += step_signals(steps)

        def near(kind: EventKind, name: str, at: int) -> "Obstacle | None":
            if name not in self._number or kind is EventKind.WITHOUT_DISTANCE:
                return None
            center = self._model.sphere_centers(part.position[at])[[self._number[name]]]
            return self._scene.at(int(part.stamp_ns[at])).obstacles(center)[0]

        self.events.add(part.stamp_ns, signals, near)

    def _nearest(self, part: AuditTrace) -> "list[Obstacle | None]":
        """What is nearest to the nearest sphere, by the controller's field; None without a distance."""
        nearest = part.clearance["barrier"]
        found: list[Obstacle | None] = [None] * len(part.stamp_ns)
        states = np.flatnonzero(np.isfinite(nearest.distance))
        if len(states):
            centers = self._model.sphere_centers_batch(part.position[states])
            points = np.ascontiguousarray(centers[np.arange(len(states)), nearest.sphere[states]])
            obstacles = self._scene.at(int(part.stamp_ns[0])).obstacles(points)
            for state, obstacle in zip(states.tolist(), obstacles, strict=True):
                found[state] = obstacle
        return found
