"""The last experiment of IV (Fig. 8): a controller beside a person against a monitored standstill, in pairs."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean, median, stdev

import numpy as np

from splatctrl_cli.evaluate.proportions import signed_rank
from splatctrl_cli.jobs.studies.workspace_drives import LABEL_DELAY, LABEL_ERROR, STOP_DISTANCE
from splatctrl_cli.jobs.studies.workspace_trial import (
    CONTROLLER,
    CONTROLLER_WIDE,
    HUMAN_MARGIN,
    METHODS,
    STANDSTILL,
    STANDSTILL_DISTANCE,
    Visit,
)
from splatctrl_cli.report.study_pictures import Panel, trials_picture
from splatctrl_cli.simulate.shared_workspace import PLACES

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
    yield "Judged by the map alone, and by the truth", JUDGED, _judged(trials)
    yield "Differences from the standstill of the workspace, within a visit", DIFFERENCES, _paired(trials)


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


def _judged(trials: Sequence[Visit]) -> Rows:
    rows = []
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
        rows.append((NAMES[method], *map(str, counts)))
    return rows


def _paired(trials: Sequence[Visit]) -> Rows:
    """Of visits that a method and the standstill both had."""
    rows, base = list[Sequence[str]](), {(t.place, t.number): t for t in trials if t.method == STANDSTILL}
    for method in _there(trials):
        pairs = [(t, base[t.place, t.number]) for t in trials if t.method == method and (t.place, t.number) in base]
        if method == STANDSTILL or not pairs:
            continue
        for what, values in (
            ("time [s]", [a.duration_s - b.duration_s for a, b in pairs]),
            ("mean distance [cm]", [CM * (a.mean_human - b.mean_human) for a, b in pairs]),
            ("least distance [cm]", [CM * (a.least_human - b.least_human) for a, b in pairs]),
        ):
            rows.append((NAMES[method], what, *signed_rank(values)))
    return rows


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
