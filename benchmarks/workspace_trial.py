"""One trial at a table shared with a person: the controller on its own map, and the standstill on the truth.

The controller's loop is closed through the cameras: every frame shows the arm where it was driven to.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.scenes import TRAINING, sample_robot
from splatctrl_cli.config import Config
from splatctrl_cli.control.events import runs_of
from splatctrl_cli.control.goals import Guide, LoggedMotion
from splatctrl_cli.control.replay import is_at_goal
from splatctrl_cli.control.scene_field import SceneStep, rate_of
from splatctrl_cli.control.standstill import BoxZone, StopZone, Zone, monitored_standstill
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.jobs.replays.known_scene import splat_fields
from splatctrl_cli.records import Bool, Box, DistanceField, Float64
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.posture import posture_of
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions
from splatctrl_cli.simulate.shared_workspace import HOME, TASK, Visit, visit_of
from splatctrl_cli.simulate.truth import closest_of, distance_to

FRAME = "hand"
FPS, WIDTH, HEIGHT = 10.0, 160, 120
SETTINGS = ("scene.iterations_per_step=15",)  # at twice the frames of the sample log
HUMAN_MARGIN = 0.10  # [m] of the second controller
MAX_TIME = 60.0  # [s]
WORKSPACE = Box(lower=np.array([0.15, -0.60, 0.0]), upper=np.array([0.90, 0.60, 0.80]))
STOP_BOX = BoxZone(box=WORKSPACE, hysteresis=0.10)
STOP_DISTANCE = Zone(stop=0.3, resume=0.4)
TRUTH_EVERY = 4  # steps of the controller between two looks at the truth
STILL = 0.01  # [rad/s] no joint faster: the arm stands


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A motion of T states, a period apart: position (T, J), is_stopped (T,); is_complete: the task was done.

    num_interventions: intervals in which a scene row shaped the command; relaxed: share of steps where one gave way.
    """

    position: Float64
    is_stopped: Bool
    is_complete: bool
    num_interventions: int = 0
    relaxed: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Row:
    """What one method did in one trial: lengths [m], times [s].

    Distances to the person are those of the moving spheres' surfaces by the truth, over the person's whole visit: a
    finished arm rests at home, an unfinished one goes on. least_any: to anything but the arm itself, over the task.
    """

    place: str
    seed: int
    method: str
    completed: bool
    duration: float
    visit: float
    mean_human: float
    least_human: float
    least_any: float
    num_stops: int
    stopped: float
    interventions: int
    relaxed: float


class TruthField:
    """The distance to primitives that stand still, with its gradient."""

    def __init__(self, primitives: Sequence[Primitive]) -> None:
        self._primitives = primitives

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance (Q,) [m] and gradient (Q, 3) at points (Q, 3)."""
        distance, surface = closest_of(self._primitives, points, START_NS)
        away = np.where(np.abs(distance) > 1e-9, distance, 1.0)[:, None]
        return distance, (points - surface) / away


class LiveMap:
    """The map of what the cameras see, with the two newest fields."""

    def __init__(self, recording: Recording, config: Config, seed: int) -> None:
        self._recording, self._config, self._model = recording, config, recording.robot
        reach, base = self._model.reach(), self._model.base_position
        workspace = Box(lower=base - reach, upper=base + reach)
        self._fitter = SceneFitter(
            config.scene, config.occupancy, workspace, human=config.human, seed=seed, threads=1
        )
        self._fields: list[DistanceField] = []

    def see(self, index: int, q: Float64) -> DistanceField:
        """Take in frame `index` of the training cameras, with the arm at q (J,)."""
        frames = list(self._recording.frames_at(index, q, TRAINING))
        self._fitter.step(frames, posture_of(self._model, q, {frame.stamp_ns: q for frame in frames}))
        field = splat_fields(self._fitter.splats(), self._config, 1).barrier
        self._fields = [*self._fields[-1:], field]
        return field

    def step_at(self, stamp_ns: int) -> SceneStep | None:
        """The two newest fields."""
        if len(self._fields) < 2:
            return None
        return SceneStep(newer=self._fields[1], older=self._fields[0], seconds=1 / FPS)


def driven(config: Config, see: Callable[[int, Float64], DistanceField], live: LiveMap | None) -> Drive:
    """The task in closed loop, in the field that `see` gives at every frame; it ends when done or at MAX_TIME."""
    model, control = sample_robot(), config.control
    q, at, velocity = np.array(HOME), 1, np.zeros(len(HOME))
    goals = [model.frame_pose(np.array(posture), FRAME) for posture in TASK]
    every = round(1 / (FPS * control.period))
    controller = None
    positions, stopped, shaped, relaxed = [], [], [], 0
    for index in range(round(MAX_TIME / control.period)):
        if index % every == 0:
            field = see(index // every, q)
            controller = (
                controller.with_field(field) if controller else QpIkController(model, control, field, frame=FRAME)
            )
        assert controller is not None
        stamp = START_NS + round(index * control.period * 1e9)
        rate = rate_of(control, model, None if live is None else live.step_at, stamp, q)
        guide = Guide(twist=np.zeros(6), posture=np.array(TASK[at]), velocity=np.zeros(len(q)))
        step = controller.step(q, goals[at], distance_rate=rate, guide=guide, last_velocity=velocity)
        positions.append(q)
        velocity = step.velocity
        stopped.append(bool(np.max(np.abs(velocity)) < STILL))
        shaped.append(any(row.kind == "scene" for row in step.interventions))
        relaxed += bool(step.relaxed)
        if is_at_goal(step.pose_error, control):
            at += 1
            if at == len(TASK):
                break
        q = q + control.period * velocity
    return Drive(
        position=np.array(positions),
        is_stopped=np.array(stopped),
        is_complete=at == len(TASK),
        num_interventions=len(runs_of(np.array(shaped))),
        relaxed=relaxed / len(positions),
    )


def watched(config: Config, recording: Recording, seed: int) -> Drive:
    """The task in closed loop, on the map that the cameras make of it."""
    live = LiveMap(recording, config, seed)
    return driven(config, live.see, live)


def held(config: Config, alone: Drive, people: Sequence[Primitive], zone: StopZone) -> Drive:
    """The path that the controller takes with nobody there, held by a zone that knows the truth about people."""
    period = config.control.period
    stamps = START_NS + np.rint(np.arange(len(alone.position)) * period * 1e9).astype(np.int64)
    motion = LoggedMotion(
        stamp_ns=stamps, position=alone.position, velocity=np.gradient(alone.position, period, axis=0)
    )
    run = monitored_standstill(
        sample_robot(), motion, lambda points, stamp: distance_to(people, points, stamp), zone,
        start_ns=START_NS, period=period, max_wait=MAX_TIME, max_acceleration=config.control.stop_acceleration,
    )  # fmt: skip
    return Drive(position=run.position, is_stopped=run.is_stopped, is_complete=run.is_complete)


def trial(place: str, seed: int, config: Config) -> list[Row]:
    """A row per method: the controller, and the standstill by a box and by distance."""
    recording = Recording(
        RecordingOptions(
            human_arm=place, seed=seed, duration_s=MAX_TIME, fps=FPS, width=WIDTH, height=HEIGHT, color_rays=0
        ),
        sample_robot(),
    )
    visit = visit_of(place, seed)
    people = [p for p in recording.primitives if p.name.startswith("human")]
    static = TruthField([p for p in recording.primitives if not p.name.startswith("human")])
    near, wide = (replace(config, control=replace(config.control, human_margin=m)) for m in (0.0, HUMAN_MARGIN))
    alone = driven(config, lambda index, q: static, None)
    drives = {
        "alone": alone,
        "controller": watched(near, recording, seed),
        "controller-wide": watched(wide, recording, seed),
        "standstill": held(config, alone, people, STOP_BOX),
        "standstill-distance": held(config, alone, people, STOP_DISTANCE),
    }
    return [measured(place, seed, name, drive, recording, visit, config) for name, drive in drives.items()]


def measured(
    place: str, seed: int, method: str, drive: Drive, recording: Recording, visit: Visit, config: Config
) -> Row:
    """The row of a drive, by the truth; alone it is measured as if nobody were there."""
    model, period = sample_robot(), config.control.period
    moving = np.flatnonzero(model.moving_spheres)
    radii = model.sphere_set.radii[moving]
    there = [p for p in recording.primitives if method != "alone" or not p.name.startswith("human")]
    people = [p for p in there if p.name.startswith("human")]
    num_states = max(len(drive.position), round(visit.end_s / period))
    human, anything = [], []
    for index in range(0, num_states, TRUTH_EVERY):
        stamp = START_NS + round(index * period * 1e9)
        centers = model.sphere_centers(drive.position[min(index, len(drive.position) - 1)])[moving]
        if any(person.is_present(stamp) for person in people):
            human.append(float(np.min(distance_to(people, centers, stamp) - radii)))
        if index < len(drive.position):
            anything.append(float(np.min(distance_to(there, centers, stamp) - radii)))
    return Row(
        place=place,
        seed=seed,
        method=method,
        completed=drive.is_complete,
        duration=period * (len(drive.position) - 1),
        visit=visit.end_s - visit.start_s,
        mean_human=float(np.mean(human)) if human else np.nan,
        least_human=min(human, default=np.nan),
        least_any=min(anything),
        num_stops=len(runs_of(drive.is_stopped)),
        stopped=period * int(drive.is_stopped.sum()),
        interventions=drive.num_interventions,
        relaxed=drive.relaxed,
    )
