"""References of a replay: held-out depth (``--evidence``), and the truth of a simulated log.

The map's distance at a true surface point, where it should be 0, is called the residual. Let d be a sphere's true
clearance, to surface point p. The exact distance is 1-Lipschitz: the map's clearance is at most d plus the residual
at p. Let no residual within `verdict.evidence_reach` of the motion exceed b (`evaluate.conformal`). Then the true
clearance is at least the map's clearance minus b, or exceeds that reach.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.calibration.displacement import correct_pose
from splatctrl_cli.config.fixed import ROBOT_MARGIN, SAME_MOMENT_NS, SPHERE_CELL
from splatctrl_cli.config.sections import VerdictConfig
from splatctrl_cli.control.audit import DistanceFunction
from splatctrl_cli.control.columns import Event, EventKind, Obstacle, clearance_signals, events_of, names_at
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.conformal import conformal_bound
from splatctrl_cli.evaluate.held_out_depth import depth_edges
from splatctrl_cli.evaluate.metrics import clearance_agreement, mark_seen
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.files.spilled_rows import Rows, ranges
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.jobs.reconstruct.reconstruction import training_cameras
from splatctrl_cli.jobs.replay.request import MapError, Replay, ReplayInputs, ReplayRequest, Trace
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import Box, Float64, RecordSource, RgbdFrame, Stamps
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import sphere_names
from splatctrl_cli.scene.time_steps import TimeStep, time_steps
from splatctrl_cli.simulate.truth import Truth, distance_to

EVERY = "held_out_every"  # metric of a lockstep scene: k if each k-th frame set is held out


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Source of held-out frame sets: all sets of `cameras`, or each `every`-th."""

    source: RecordSource
    cameras: tuple[str, ...]
    name: str
    every: int | None = None

    def frame_sets(self) -> Iterator[TimeStep]:
        return select_held_out(time_steps(self.source.records(), self.cameras, has_clock=True), self.every)


def select_held_out(steps: Iterable[TimeStep], every: int | None) -> Iterator[TimeStep]:
    """Select each `every`-th frame set, the held-out ones; None selects all."""
    return islice(iter(steps), None if every is None else every - 1, None, every or 1)


def select_trained(steps: Iterable[TimeStep], every: int | None) -> Iterator[TimeStep]:
    return (step for number, step in enumerate(steps, start=1) if every is None or number % every)


def every_of(evidence: str | None) -> int | None:
    """Parse k from ``--evidence k``, None for a camera. Raises UsageError for k below two."""
    try:
        every = int(evidence or "")
    except ValueError:
        return None
    refuse_if(
        every < 2,
        f"--evidence {evidence}: expected a camera, or a number of frame sets from 2",
        remedy="--evidence 4 leaves every 4th frame set out of the training",
        error=UsageError,
    )
    return every


def check_evidence(request: ReplayRequest) -> None:
    """Raise UsageError for evidence that trained the map, if request or scene show it."""
    if request.evidence is None:
        return
    every, option = every_of(request.evidence), f"--evidence {request.evidence}"
    refuse_if(
        request.field is not None,
        f"{option}: a baked field does not say which cameras made it",
        remedy="give --scene",
        error=UsageError,
    )
    if request.lockstep:
        refuse_if(
            every is None and request.evidence in (request.options.cameras or ()),
            f"{option}: --cameras names it as a training camera",
            remedy="leave it out of --cameras",
            error=UsageError,
        )
        return
    assert request.scene is not None
    scene = open_scene(request.scene)
    refuse_if(
        every is None and request.evidence in scene.cameras,
        f"{option}: {request.scene} was made from its depth",
        remedy=f"name a held-out camera: any but {', '.join(scene.cameras)}",
        error=UsageError,
    )
    refuse_if(
        every is not None and scene.run.get("metrics", {}).get(EVERY) != every,
        f"{option}: {request.scene} was made from every frame set of {', '.join(scene.cameras)}",
        remedy="name a held-out camera, or give --lockstep, which leaves these sets out",
        error=UsageError,
    )


def training_options(request: ReplayRequest, cameras: tuple[str, ...]) -> SourceOptions:
    """Log options of a lockstep without the held-out camera.

    Raises UsageError without another camera.
    """
    others = tuple(camera for camera in cameras if camera != request.evidence)
    refuse_if(
        not others,
        f"--evidence {request.evidence}: no other camera is left to train on",
        remedy="leave out frame sets instead, such as every 4th with --evidence 4",
        error=UsageError,
    )
    return replace(request.options, cameras=others)


def open_evidence(request: ReplayRequest, model: RobotModel) -> Evidence | None:
    """Open the log again with the held-out cameras; None without ``--evidence``.

    Raises InputError without depth from these cameras.
    """
    if request.evidence is None:
        return None
    every = every_of(request.evidence)
    chosen = request.options.cameras if every is not None else (request.evidence,)
    if every is not None and request.scene is not None:
        chosen = open_scene(request.scene).cameras
    source = open_states(request.log, replace(request.options, cameras=chosen), model.joint_names)
    name = f"camera {request.evidence}" if every is None else f"each frame set of {every}"
    refuse_if(not source.cameras, f"{request.log}: --evidence: expected cameras, got joint states alone")
    refuse_if(not source.has_clock, f"{request.log}: --evidence: expected frames with times, got views without")
    evidence = Evidence(
        source=source,
        cameras=source.cameras if every is None else tuple(training_cameras(source)),
        name=name,
        every=every,
    )
    refuse_if(
        not any(step.has_depth for step in evidence.frame_sets()),
        f"{request.log}: --evidence: {name} has no pixel with depth",
        remedy="name a camera with depth",
    )
    return evidence


def map_error(evidence: Evidence, inputs: ReplayInputs, trace: Trace, config: VerdictConfig) -> MapError:
    stamps_ns, residuals, num_points = residuals_of(evidence.frame_sets(), inputs, trace, config.evidence_reach)
    bound = conformal_bound(residuals[:, 0], config.confidence)
    error = MapError(
        source=evidence.name,
        num_sets=len(stamps_ns),
        num_seen=int(np.isfinite(residuals[:, 0]).sum()),
        num_points=num_points,
        bound=None,
    )
    if bound is None:
        return error
    x, y, z = (float(value) for value in residuals[bound.at, 1:])
    return replace(
        error,
        bound=replace(bound, bound=max(bound.bound, 0.0)),
        time_s=float(stamps_ns[bound.at] - trace.stamp_ns[0]) * 1e-9,
        place=(x, y, z),
    )


def residuals_of(
    frame_sets: Iterable[TimeStep], inputs: ReplayInputs, trace: Trace, reach: float
) -> tuple[list[int], Float64, int]:
    """Largest residual of each held-out frame set near the motion, without the robot.

    Returns stamps [ns] of the T sets in the audited time, an array (T, 4) [m], and the number of points. Its columns
    are the largest residual and the place, NaN without points. Near means within `reach` [m]. Each set is compared
    with the map just before it: the next map contains other cameras of that moment, and its residuals are smaller.
    """
    swept, cameras = Swept.of(inputs.model, trace, reach), inputs.scene.figures().get("displaced_cameras") or {}
    motion, first_ns, last_ns = inputs.motion(), int(trace.stamp_ns[0]), int(trace.stamp_ns[-1])
    stamps: list[int] = []
    worst: list[Float64] = []
    num_points = 0
    for step in frame_sets:
        if not first_ns <= step.stamp_ns <= last_ns:
            continue
        points = np.concatenate(
            [
                apart_from_robot(
                    inputs.model,
                    motion.at(frame.stamp_ns)[0],
                    swept.near(surface_points(correct_pose(frame, cameras))),
                )
                for frame in step.frames
            ]
        )
        stamps.append(step.stamp_ns)
        exact = inputs.scene.at(max(step.stamp_ns - SAME_MOMENT_NS, first_ns)).distances["exact"]
        worst.append(largest_miss(points, exact))
        num_points += len(points)
    return stamps, np.array(worst).reshape(-1, 4), num_points


def surface_points(frame: RgbdFrame) -> Float64:
    """Back-project a frame to points (Q, 3) [m], world, without mixed pixels at depth edges."""
    is_chosen = (frame.depth > 0) & ~depth_edges(frame.depth)
    return transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[is_chosen])


def apart_from_robot(model: RobotModel, q: Float64, points: Float64) -> Float64:
    """Keep points (Q, 3) [m] that cannot be the robot at q (J,).

    These are over ROBOT_MARGIN outside the robot's spheres, each enlarged by the surface it leaves uncovered.
    """
    if not len(points):
        return points
    deficit = np.maximum(np.nan_to_num(np.asarray(model.sphere_deficit, np.float64)), 0.0)
    body = SphereField(Spheres.of(model.sphere_centers(q), model.sphere_set.radii + deficit))
    return points[body.query(points)[0] > ROBOT_MARGIN]


def largest_miss(points: Float64, distance: DistanceFunction) -> Float64:
    """Array (4,) [m]: largest distance of points (Q, 3) to the map, and its point."""
    if not len(points):
        return np.full(4, np.nan)
    values = distance(points)
    worst = int(np.argmax(values))
    return np.array([values[worst], *points[worst]])


class Swept:
    """Space within `reach` [m] of an arm's moving spheres, larger by at most a cell's diagonal."""

    def __init__(self, cells: Float64, radii: Float64, reach: float) -> None:
        """Enclose cells (K, 3), counted in SPHERE_CELL; radii (K,) [m]: the largest in each cell."""
        centers, self._reach = (cells + 0.5) * SPHERE_CELL, reach
        enlarged = radii + 0.5 * SPHERE_CELL * 3**0.5
        self._field = SphereField(Spheres.of(centers, enlarged))
        far = (enlarged + reach)[:, None]
        self._box = Box(lower=(centers - far).min(axis=0), upper=(centers + far).max(axis=0))

    @classmethod
    def of(cls, model: RobotModel, trace: Trace, reach: float) -> "Swept":
        """Sweep every audited state; memory grows only with the swept space."""
        moving = np.flatnonzero(model.moving_spheres)
        cells, radii = np.zeros((0, 3)), np.zeros(0)
        for first, last in ranges(len(trace.rows("q"))):
            centers = model.sphere_centers_batch(trace.rows("q")[first:last])[:, moving]
            cells = np.concatenate([cells, np.floor(centers.reshape(-1, 3) / SPHERE_CELL)])
            radii = np.concatenate([radii, np.tile(model.sphere_set.radii[moving], last - first)])
            cells, index = np.unique(cells, axis=0, return_inverse=True)
            largest = np.zeros(len(cells))
            np.maximum.at(largest, index.ravel(), radii)
            radii = largest
        return cls(cells, radii, reach)

    def near(self, points: Float64) -> Float64:
        """Keep points (Q, 3) [m] inside the swept space."""
        inside = points[self._box.contains(points)]
        return inside[self._field.query(inside)[0] <= self._reach] if len(inside) else inside


class TrueSurfaces:
    """True surface points (T, 3) [m] nearest to each state; `seen` (T,): seen by then."""

    def __init__(self, points: Rows, stamp_ns: Stamps, inputs: ReplayInputs) -> None:
        self._points, self._stamp_ns = points, stamp_ns
        self._cameras, self._has_clock = inputs.scene.cameras, inputs.source.has_clock
        self.seen = np.zeros(len(stamp_ns), dtype=np.bool_)

    def watching(self, frames: Iterable[RgbdFrame]) -> Iterator[RgbdFrame]:
        """Yield the frames; mark what the scene's cameras see in them."""
        for frame in frames:
            if self._cameras is None or frame.camera in self._cameras:
                mark_seen(self.seen, self._points, self._stamp_ns, frame, has_clock=self._has_clock)
            yield frame


def add_truth(inputs: ReplayInputs, replay: Replay) -> tuple[Replay, TrueSurfaces | None]:
    """Add true clearances and their events; the surfaces are None without a truth."""
    if inputs.truth is None:
        return replay, None
    model, trace = inputs.model, replay.trace
    names, moving = sphere_names(model.sphere_set), np.flatnonzero(model.moving_spheres)
    radii, all_stamps = model.sphere_set.radii[moving], trace.stamp_ns
    for first, last in ranges(len(all_stamps)):
        clearance, surface = np.zeros(last - first), np.zeros((last - first, 3))
        spheres = np.zeros(last - first, dtype=np.int64)
        stamps, positions = all_stamps[first:last].tolist(), trace.rows("q")[first:last]
        for index, (stamp, q) in enumerate(zip(stamps, positions, strict=True)):
            distance, points = inputs.truth.closest(model.sphere_centers(q)[moving], stamp)
            gap = _drop_expected(inputs, moving, distance - radii, points, stamp, replay.margin)
            nearest = int(np.argmin(gap))
            clearance[index], surface[index] = gap[nearest], points[nearest]
            spheres[index] = moving[nearest]
        of_truth = {"clearance_true": clearance, "nearest_true": names_at(names, spheres), "surface_true": surface}
        trace.append(of_truth)
    events = (*replay.events, *_true_events(inputs, replay, inputs.truth))
    merged = tuple(sorted(events, key=lambda event: (event.first_ns, -event.last_ns)))
    return replace(replay, events=merged), TrueSurfaces(trace.rows("surface_true"), all_stamps, inputs)


def add_agreement(replay: Replay, surfaces: TrueSurfaces) -> Replay:
    """Compare the audit with the truth near seen surfaces; call after the last frame."""
    truth = replay.trace["clearance_true"]
    return replace(
        replay,
        agreement={
            name: clearance_agreement(replay.trace[f"clearance_{name}"], truth, surfaces.seen, replay.median_radius)
            for name in replay.fields
        },
    )


def _drop_expected(
    inputs: ReplayInputs, moving: NDArray[np.intp], gap: Float64, points: Float64, stamp_ns: int, margin: float
) -> Float64:
    if not inputs.declared.expected_contact:
        return gap
    links, seconds = inputs.model.sphere_set.links, (stamp_ns - int(inputs.states.stamp_ns[0])) * 1e-9
    is_meant = [
        bool(gap[k] < margin and inputs.declared.find_expected(links[sphere], points[k], seconds))
        for k, sphere in enumerate(moving)
    ]
    return np.where(is_meant, np.inf, gap)


def _true_events(inputs: ReplayInputs, replay: Replay, truth: Truth) -> tuple[Event, ...]:
    model, trace = inputs.model, replay.trace
    names, stamps = sphere_names(model.sphere_set), trace.stamp_ns

    def near(kind: EventKind, name: str, at: int) -> Obstacle | None:
        stamp, center = int(stamps[at]), model.sphere_centers(trace.rows("q")[at])[[names.index(name)]]
        distance, surface = truth.closest(center, stamp)
        there = [p for p in truth.primitives if p.is_present(stamp)]
        least = min(there, key=lambda p: float(distance_to([p], center, stamp)[0]))
        x, y, z = (float(v) for v in surface[0])
        return Obstacle(distance=float(distance[0]), position=(x, y, z), name=least.name)

    return events_of(stamps, clearance_signals(trace, "true", replay.margin), near)
