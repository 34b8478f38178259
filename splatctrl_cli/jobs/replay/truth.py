"""The true clearance of a replay's states, where the log was simulated."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.events import Event, EventFold, EventKind, Obstacle
from splatctrl_cli.control.signals import clearance_signals
from splatctrl_cli.evaluate.clearance_agreement import clearance_agreement, mark_seen
from splatctrl_cli.files.spilled_rows import RowFile, Rows, ranges
from splatctrl_cli.jobs.replay.request import ReplayInputs
from splatctrl_cli.jobs.replay.result import Replay
from splatctrl_cli.records import Float64, RgbdFrame, Stamps
from splatctrl_cli.simulate.truth import distance_to


class TrueSurfaces:
    """The true surface points (T, 3) [m] nearest to each state's spheres, and which of them a camera saw by then."""

    def __init__(self, points: Rows, stamp_ns: Stamps, inputs: ReplayInputs) -> None:
        self._points, self._stamp_ns = points, stamp_ns
        self._cameras, self._has_clock = inputs.scene.cameras, inputs.source.has_clock
        self.seen = np.zeros(len(stamp_ns), dtype=np.bool_)

    def watching(self, frames: Iterable[RgbdFrame]) -> Iterator[RgbdFrame]:
        """The same frames; those of a camera that made the scene are taken in on their way."""
        for frame in frames:
            if self._cameras is None or frame.camera in self._cameras:
                mark_seen(self.seen, self._points, self._stamp_ns, frame, has_clock=self._has_clock)
            yield frame


def with_truth(inputs: ReplayInputs, replay: Replay) -> tuple[Replay, TrueSurfaces | None]:
    """With the true clearance of every state and its events, and the surfaces that it is to; None without a truth."""
    if inputs.truth is None:
        return replay, None
    model, trace = inputs.model, replay.audit
    moving = np.flatnonzero(model.moving_spheres)
    radii = model.sphere_set.radii[moving]
    clearances, surfaces, nearest_spheres = RowFile(), RowFile((3,)), RowFile()
    for first, last in ranges(len(trace.stamp_ns)):
        clearance, surface = np.zeros(last - first), np.zeros((last - first, 3))
        spheres = np.zeros(last - first)
        stamps, positions = trace.stamp_ns[first:last].tolist(), trace.position[first:last]
        for index, (stamp, q) in enumerate(zip(stamps, positions, strict=True)):
            distance, points = inputs.truth.closest(model.sphere_centers(q)[moving], stamp)
            gap = _unexpected(inputs, moving, distance - radii, points, stamp, replay.margin)
            nearest = int(np.argmin(gap))
            clearance[index], surface[index] = gap[nearest], points[nearest]
            spheres[index] = moving[nearest]
        clearances.append(clearance)
        nearest_spheres.append(spheres)
        surfaces.append(surface)
    truth = Rows(clearances)
    events = _true_events(inputs, replay, np.asarray(truth), Rows(nearest_spheres))
    merged = tuple(sorted((*replay.events, *events), key=lambda event: (event.first_ns, -event.last_ns)))
    found = replace(replay, true_clearance=truth, events=merged)
    return found, TrueSurfaces(Rows(surfaces), trace.stamp_ns, inputs)


def with_agreement(replay: Replay, surfaces: TrueSurfaces) -> Replay:
    """With how an audit agrees with the truth near surfaces that a camera saw, once all frames have been seen."""
    truth = np.asarray(replay.true_clearance)
    agreement = {
        name: clearance_agreement(of.distance, truth, surfaces.seen, replay.median_radius)
        for name, of in replay.audit.clearance.items()
    }
    return replace(replay, agreement=agreement)


def _unexpected(
    inputs: ReplayInputs, moving: NDArray[np.intp], gap: Float64, points: Float64, stamp_ns: int, margin: float
) -> Float64:
    """True clearances (M,) of the moving spheres to points (M, 3), infinite where the contact is declared."""
    if not inputs.declared.expected_contact:
        return gap
    links, seconds = inputs.model.sphere_set.links, (stamp_ns - int(inputs.states.stamp_ns[0])) * 1e-9
    is_meant = [
        bool(gap[k] < margin and inputs.declared.expects(links[sphere], points[k], seconds))
        for k, sphere in enumerate(moving)
    ]
    return np.where(is_meant, np.inf, gap)


def _true_events(inputs: ReplayInputs, replay: Replay, clearance: Float64, spheres: Rows) -> tuple[Event, ...]:
    """Intervals (of T states) below the margin, and in contact, by the truth."""
    model, truth, audit = inputs.model, inputs.truth, replay.audit
    assert truth is not None
    names = sphere_names(model.sphere_set)
    nearest = np.asarray(spheres[: len(clearance)], np.int64)
    fold = EventFold()

    def near(kind: EventKind, name: str, at: int) -> Obstacle | None:
        stamp, center = int(audit.stamp_ns[at]), model.sphere_centers(audit.position[at])[[names.index(name)]]
        distance, surface = truth.closest(center, stamp)
        there = [p for p in truth.primitives if p.is_present(stamp)]
        least = min(there, key=lambda p: float(distance_to([p], center, stamp)[0]))
        x, y, z = (float(v) for v in surface[0])
        return Obstacle(distance=float(distance[0]), position=(x, y, z), name=least.name)

    fold.add(audit.stamp_ns, clearance_signals("true", clearance, nearest, replay.margin, names), near)
    return fold.events()
