"""One visit of a person to the table of an arm: what each method did, by the truth and by what its map knew."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.events import runs_of
from splatctrl_cli.control.standstill import StopZone
from splatctrl_cli.evaluate.verdict import Outcome as Judgement
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.jobs.replays.inputs import MeasuredRobot
from splatctrl_cli.jobs.studies import judge
from splatctrl_cli.jobs.studies.problems import named, simulated_arm
from splatctrl_cli.jobs.studies.workspace_drives import (
    FPS,
    MAX_TIME,
    STOP_BOX,
    STOP_DISTANCE,
    Drive,
    TruthField,
    driven,
    held,
    watched,
)
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions
from splatctrl_cli.simulate.shared_workspace import PLACES, visit_of
from splatctrl_cli.simulate.truth import distance_to

STANDSTILL, STANDSTILL_DISTANCE = "standstill", "standstill-distance"
CONTROLLER, CONTROLLER_WIDE = "controller", "controller-wide"
METHODS = (STANDSTILL, STANDSTILL_DISTANCE, CONTROLLER, CONTROLLER_WIDE)
HUMAN_MARGIN = 0.25  # [m] of the second controller
TRUTH_EVERY = 4  # steps of the controller between two looks at the truth
NOT_DONE, TOUCHED, PERSON_TOUCHED = "task not done", "collision", "collision with the person"


@dataclass(frozen=True, kw_only=True)
class Visit:
    """What one method did in one trial; a row of what is published.

    success: the task was done and nothing touched. Distances [m] to the person are those of the moving spheres'
    surfaces by the truth, over the person's whole visit: a finished arm rests at home, an unfinished one goes on.
    true_clearance [m]: the least to anything but the arm itself, over the task; relaxed: share of steps in which a
    row gave way; alone_s [s]: the same task with nobody there; visit_s [s]: how long the person stays.
    """

    place: str
    number: int
    method: str
    success: bool
    cause: str
    verdict: str
    is_false_green: bool
    reason: str
    duration_s: float
    alone_s: float
    visit_s: float
    mean_human: float
    least_human: float
    true_clearance: float | None
    num_stops: int
    stopped_s: float
    interventions: int
    relaxed: float

    @property
    def label(self) -> str:
        """Which trial it is."""
        return f"{self.place} {self.number}, {self.method}"

    @property
    def told(self) -> str:
        """What came of it, in a few words."""
        verdict = f"; {self.verdict.upper()}" if self.verdict else ""
        return (
            f"{self.method}: {self.duration_s:.1f} s, {100 * self.mean_human:.1f} cm from the person on average"
            f"{'' if self.success else ', ' + self.cause}{verdict}"
        )


@dataclass(frozen=True, kw_only=True)
class Setting:
    """The recording of a visit, and the task done with nobody there."""

    place: str
    number: int
    recording: Recording
    config: Config
    alone: Drive

    @property
    def model(self) -> RobotModel:
        """The arm."""
        return self.recording.robot

    def people(self) -> list[Primitive]:
        """The person's solids."""
        return [p for p in self.recording.primitives if p.name.startswith("human")]

    def watched(self, human_margin: float) -> Drive:
        """The controller, that far from people."""
        control = replace(self.config.control, human_margin=human_margin)
        return watched(replace(self.config, control=control), self.recording, self.number)

    def held(self, zone: StopZone) -> Drive:
        """The standstill of a zone."""
        return held(self.model, self.config, self.alone, self.people(), zone)


DRIVES: Mapping[str, Callable[[Setting], Drive]] = {
    STANDSTILL: lambda setting: setting.held(STOP_BOX),
    STANDSTILL_DISTANCE: lambda setting: setting.held(STOP_DISTANCE),
    CONTROLLER: lambda setting: setting.watched(0.0),
    CONTROLLER_WIDE: lambda setting: setting.watched(HUMAN_MARGIN),
}


def visits_of(
    name: str, methods: Sequence[str], config: Config, *, width: int, stopwatch: Stopwatch
) -> Iterator[Visit]:
    """A row per method of the visit with a name, PLACE-NUMBER. Raises InputError for one that is none."""
    place, number = named(name, PLACES, "place")
    options = RecordingOptions(
        human_arm=place,
        seed=number,
        duration_s=MAX_TIME,
        fps=FPS,
        width=width,
        height=3 * width // 4,
        color_rays=0,
    )
    recording = Recording(options, simulated_arm())
    things = TruthField([p for p in recording.primitives if not p.name.startswith("human")])
    with stopwatch.stage("alone"):
        alone = driven(recording.robot, config, lambda index, q: things, None)
    setting = Setting(place=place, number=number, recording=recording, config=config, alone=alone)
    robot = judge.measured(recording.robot, config)
    for method in methods:
        with stopwatch.stage(f"{method}: drive"):
            drive = DRIVES[method](setting)
        with stopwatch.stage(f"{method}: judge"):
            yield judged(setting, robot, method, drive)


def judged(setting: Setting, robot: MeasuredRobot, method: str, drive: Drive) -> Visit:
    """The row of a drive, by the truth and by what its map knew."""
    human, to_person, anything = _distances(setting, drive)
    is_hit = anything <= 0
    cause = "" if drive.is_complete else NOT_DONE
    verdict = (
        None
        if drive.known is None
        else judge.verdict_on(robot, drive.position, START_NS, drive.known, setting.config)
    )
    visit, period = visit_of(setting.place, setting.number), setting.config.control.period
    return Visit(
        place=setting.place,
        number=setting.number,
        method=method,
        success=drive.is_complete and not is_hit,
        cause=(PERSON_TOUCHED if to_person <= 0 else TOUCHED) if is_hit else cause,
        verdict="" if verdict is None else verdict.label,
        is_false_green=is_hit and verdict is not None and verdict.outcome is Judgement.PASSED,
        reason="" if verdict is None or not verdict.decisive else str(verdict.decisive[0]),
        duration_s=period * (len(drive.position) - 1),
        alone_s=period * (len(setting.alone.position) - 1),
        visit_s=visit.end_s - visit.start_s,
        mean_human=float(np.mean(human)),
        least_human=float(np.min(human)),
        true_clearance=anything,
        num_stops=len(runs_of(drive.is_stopped)),
        stopped_s=period * int(drive.is_stopped.sum()),
        interventions=drive.num_interventions,
        relaxed=drive.relaxed,
    )


def _distances(setting: Setting, drive: Drive) -> tuple[Float64, float, float]:
    """By the truth [m]: to the person at each look of the visit, the least of them over the task, and the least to
    anything over the task.
    """
    model, period = setting.model, setting.config.control.period
    moving = np.flatnonzero(model.moving_spheres)
    radii, people = model.sphere_set.radii[moving], setting.people()
    num_states = max(len(drive.position), round(visit_of(setting.place, setting.number).end_s / period))
    human, beside, anything = list[float](), list[float](), list[float]()
    for index in range(0, num_states, TRUTH_EVERY):
        stamp = START_NS + round(index * period * 1e9)
        centers = model.sphere_centers(drive.position[min(index, len(drive.position) - 1)])[moving]
        if any(person.is_present(stamp) for person in people):
            human.append(float(np.min(distance_to(people, centers, stamp) - radii)))
        if index < len(drive.position):
            anything.append(float(np.min(distance_to(setting.recording.primitives, centers, stamp) - radii)))
            beside += human[-1:]
    return np.array(human), min(beside, default=np.inf), min(anything)
