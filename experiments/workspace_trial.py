"""One visit of a person to an arm's table: each method's results, by the truth and by its map. Also the paired tables
of all visits, which compare a controller with a monitored standstill (IV, Fig. 8).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median, stdev

import numpy as np

from experiments import judge
from experiments.pictures import Panel, trials_picture
from experiments.problems import ProblemRequest, named, simulated_arm
from experiments.proportions import signed_rank
from experiments.shared_workspace import PLACES, scene_of, visit_of
from experiments.standstill import StopZone
from experiments.workspace_drives import (
    FPS,
    LABEL_DELAY,
    LABEL_ERROR,
    MAX_TIME,
    STOP_BOX,
    STOP_DISTANCE,
    Drive,
    LiveMap,
    TruthField,
    driven,
    held,
)
from splatctrl_cli import Config
from splatctrl_cli import Outcome as Judgement
from splatctrl_cli.blocks import (
    START_NS,
    Float64,
    MeasuredRobot,
    Primitive,
    Recording,
    RecordingOptions,
    RobotModel,
    Stopwatch,
    distance_to,
    runs_of,
)

STANDSTILL, STANDSTILL_DISTANCE = "standstill", "standstill-distance"
CONTROLLER, CONTROLLER_WIDE = "controller", "controller-wide"
METHODS = (STANDSTILL, STANDSTILL_DISTANCE, CONTROLLER, CONTROLLER_WIDE)
HUMAN_MARGIN = 0.25  # [m] of the second controller
TRUTH_EVERY = 4  # steps of the controller between two looks at the truth
NOT_DONE, TOUCHED, PERSON_TOUCHED = "task not done", "collision", "collision with the person"


@dataclass(frozen=True, kw_only=True)
class Visit:
    """One method's result in one trial; a row of the published table.

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
    """The recording of a visit, and the task done without people."""

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
        config = replace(self.config, control=replace(self.config.control, human_margin=human_margin))
        live = LiveMap(self.recording, config, self.number)
        return driven(self.model, config, live.see, live)

    def held(self, zone: StopZone) -> Drive:
        """The standstill of a zone."""
        return held(self.model, self.config, self.alone, self.people(), zone)


DRIVES: Mapping[str, Callable[[Setting], Drive]] = {
    STANDSTILL: lambda setting: setting.held(STOP_BOX),
    STANDSTILL_DISTANCE: lambda setting: setting.held(STOP_DISTANCE),
    CONTROLLER: lambda setting: setting.watched(0.0),
    CONTROLLER_WIDE: lambda setting: setting.watched(HUMAN_MARGIN),
}


def visits_of(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[Visit]:
    """A row per method of the visit with a name, PLACE-NUMBER. Raises InputError for one that is none."""
    place, number = named(request.problem, PLACES, "place")
    options = RecordingOptions(
        seed=number,
        duration_s=MAX_TIME,
        fps=FPS,
        width=request.width,
        height=3 * request.width // 4,
        color_rays=0,
    )
    recording = Recording(options, simulated_arm(), scene_of(place, number))
    things = TruthField([p for p in recording.primitives if not p.name.startswith("human")])
    with stopwatch.stage("alone"):
        alone = driven(recording.robot, config, lambda index, q: things, None)
    setting = Setting(place=place, number=number, recording=recording, config=config, alone=alone)
    robot = judge.measured(recording.robot, config)
    for method in request.methods:
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


NUM_TRIALS = 16  # at each place: the paper's 8 people x 2
NAMES = {
    STANDSTILL: "standstill, workspace",
    STANDSTILL_DISTANCE: f"standstill, {100 * STOP_DISTANCE.stop:.0f} cm",
    CONTROLLER: "controller",
    CONTROLLER_WIDE: f"controller, {100 * HUMAN_MARGIN:.0f} cm from people",
}
CM = 100.0
PAPER = (
    "The paper (Fig. 8; 8 people, 4 trials each, no figures in its text): faster than the standstill, at a greater"
    " mean distance to the person, and no contact."
)

Rows = Sequence[Sequence[str]]


def problems(trials: int | None, archive: Path | None) -> list[tuple[str, int]]:
    """Place and number of the visits: as many as the paper's trials, or at most so many at each place."""
    return [(place, n) for place in PLACES for n in range(NUM_TRIALS if trials is None else min(trials, NUM_TRIALS))]


def sections(trials: Sequence[Visit]) -> Iterator[tuple[str, Sequence[str], Rows]]:
    """Title, header and rows: each method over all visits and by place, verdicts, and paired differences."""
    for place in ("", *PLACES):
        of = [trial for trial in trials if trial.place.startswith(place)]
        if of:
            num = len({(trial.place, trial.number) for trial in of})
            rows = [_line([t for t in of if t.method == method]) for method in _there(of)]
            yield f"{(place or 'both places').replace('-', ' ').capitalize()} ({num} visits)", COLUMNS, rows
    yield "Judged by the map alone, and by the truth", JUDGED, list(_judged(trials))
    yield "Differences from the standstill of the workspace, within a visit", DIFFERENCES, list(_paired(trials))


def notes(trials: Sequence[Visit]) -> Iterator[str]:
    """What else is to be known of the tables."""
    yield PAPER
    num = len({(trial.place, trial.number) for trial in trials})
    if num < NUM_TRIALS * len(PLACES):
        yield f"Sampled: {num} of {NUM_TRIALS * len(PLACES)} visits."
    yield f"The same task with nobody there takes {mean(trial.alone_s for trial in trials):.1f} s."
    yield (
        f"Masks of the person are {LABEL_DELAY} frame (0.1 s) late and {LABEL_ERROR} px off along their outline; the"
        " standstills know where the person is."
    )


COLUMNS = (
    *("method", "done", "time [s]", "median", "mean distance to the person [cm]", "median"),
    *("least in any [cm]", "least to anything [cm]", "stands [s]", "interventions", "relaxed steps [%]"),
)
JUDGED = ("method", "judged", "safe", "of these collided", "not evaluable", "collisions", "nearer than 2 cm")
DIFFERENCES = ("method", "what", "mean", "95 %", "visits above 0", "p (Wilcoxon)")


def _there(trials: Sequence[Visit]) -> list[str]:
    return [method for method in METHODS if any(trial.method == method for trial in trials)]


def _line(of: Sequence[Visit]) -> list[str]:
    time, distance = [trial.duration_s for trial in of], [CM * trial.mean_human for trial in of]
    return [
        NAMES[of[0].method],
        f"{sum(trial.success for trial in of)}/{len(of)}",
        _spread(time),
        f"{median(time):.1f}",
        _spread(distance),
        f"{median(distance):.1f}",
        f"{CM * min(trial.least_human for trial in of):.1f}",
        f"{CM * min(trial.true_clearance or 0.0 for trial in of):.1f}",
        f"{mean(trial.stopped_s for trial in of):.1f}",
        f"{mean(trial.interventions for trial in of):.1f}",
        f"{CM * mean(trial.relaxed for trial in of):.1f}",
    ]


def _judged(trials: Sequence[Visit]) -> Iterator[Sequence[str]]:
    for method in _there(trials):
        of = [trial for trial in trials if trial.method == method]
        judged = [trial for trial in of if trial.verdict]
        counts = (
            len(judged),
            sum(trial.verdict == "safe" for trial in judged),
            sum(trial.is_false_green for trial in judged),
            sum(trial.verdict == "not evaluable" for trial in judged),
            sum((trial.true_clearance or 0.0) <= 0 for trial in of),
            sum((trial.true_clearance or 0.0) < 0.02 for trial in of),
        )
        yield NAMES[method], *map(str, counts)


def _paired(trials: Sequence[Visit]) -> Iterator[Sequence[str]]:
    """Of visits that a method and the standstill both had."""
    base = {(t.place, t.number): t for t in trials if t.method == STANDSTILL}
    for method in _there(trials):
        pairs = [(t, base[t.place, t.number]) for t in trials if t.method == method and (t.place, t.number) in base]
        if method == STANDSTILL or not pairs:
            continue
        for what, values in (
            ("time [s]", [a.duration_s - b.duration_s for a, b in pairs]),
            ("mean distance [cm]", [CM * (a.mean_human - b.mean_human) for a, b in pairs]),
            ("least distance [cm]", [CM * (a.least_human - b.least_human) for a, b in pairs]),
        ):
            yield NAMES[method], what, *signed_rank(values)


def _spread(values: Sequence[float]) -> str:
    return f"{mean(values):.1f} +- {stdev(values) if len(values) > 1 else 0.0:.1f}"


def draw(trials: Sequence[Visit], path: Path) -> None:
    """Fig. 8: time and mean distance to the person, a line for each visit."""
    methods, visits = _there(trials), sorted({(trial.place, trial.number) for trial in trials})
    of = {(trial.place, trial.number, trial.method): trial for trial in trials}
    table = [[of[place, number, method] for method in methods] for place, number in visits]
    alone = mean(trial.alone_s for trial in trials)
    panels = [
        Panel(
            title="completion time [s]",
            values=np.array([[trial.duration_s for trial in row] for row in table]),
            level=(alone, "nobody there"),
        ),
        Panel(
            title="mean distance to the person [cm]",
            values=np.array([[CM * trial.mean_human for trial in row] for row in table]),
        ),
    ]
    groups = [f"person works {place.replace('-', ' ')}" for place, _ in visits]
    trials_picture(
        path,
        [NAMES[method].replace(", ", ",\n") for method in methods],
        panels,
        groups,
        f"A table shared with a person, {len(visits)} visits",
    )
