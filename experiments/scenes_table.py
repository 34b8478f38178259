"""Twelve scenes, two controllers (IV-C, Fig. 7): success, lengths of the paths, and their least distances."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.pictures import Panel, trials_picture
from experiments.proportions import mean_between, paired, share_of, signed_rank
from experiments.scenes import problems
from experiments.scenes_trial import (
    BIRRT,
    DETOURS,
    MARGIN,
    METHODS,
    QP_IK,
    QP_IK_ALONE,
    RUNS,
    Transport,
)

EPSILON = 0.02  # [m] of the paper
NAMES = {
    QP_IK: f"QP-IK, up to {DETOURS} ways out planned",
    BIRRT: "BiRRT, followed",
    QP_IK_ALONE: "QP-IK alone",
}
SHORT = {QP_IK: "QP-IK,\nways out", BIRRT: "BiRRT", QP_IK_ALONE: "QP-IK\nalone"}  # in a figure
PAPER = {  # of 24 trials: successes, and what it says of the rest
    QP_IK: (23, "shorter way of the end effector, larger least distance; one trial nearer than 2 cm"),
    BIRRT: (23, "shorter way of the joints among clutter; nearer than 2 cm occasionally"),
}
NUM_PAPER = 24
PANELS: tuple[tuple[str, Callable[[Transport], float | None]], ...] = (
    ("joints [rad]", lambda trial: trial.joint_path_rad),
    ("hand [m]", lambda trial: trial.effector_path_m),
    ("hand [degrees]", lambda trial: trial.effector_path_deg),
    ("error at the end [mm]", lambda trial: None if trial.position_error is None else 1e3 * trial.position_error),
    ("time [s]", lambda trial: trial.duration_s),
    ("least distance to the map [cm]", lambda trial: _cm(trial.field_clearance)),
    ("least true distance [cm]", lambda trial: _cm(trial.true_clearance)),
)
DRAWN = (0, 1, 5, 6)  # of the panels

Rows = Sequence[Sequence[str]]


def sections(trials: Sequence[Transport]) -> Iterator[tuple[str, Sequence[str], Rows]]:
    """Title, header and rows: success, the panels of Fig. 7, verdicts, failures by cause, tests in pairs."""
    num = len({(trial.layout, trial.number) for trial in trials})
    yield f"The cube over the bowl ({num} scenes, {RUNS} runs each)", SUCCESS, list(_successes(trials))
    panels = ("method", *(name for name, _ in PANELS))
    yield "Of the successful runs: mean and its 95 % interval", panels, list(_panels(trials))
    yield "Judged by the map alone, at 2 cm", JUDGED, list(_judged(trials))
    yield "Failures by cause", ("method", "runs", "cause"), _causes(trials)
    yield f"The same runs: {NAMES[QP_IK]}, less another", PAIRED, list(_pairs(trials))


def notes(trials: Sequence[Transport]) -> Iterator[str]:
    """What else is to be known of the tables."""
    whole, there = len(problems(None, None)), len({(t.layout, t.number) for t in trials})
    yield f"Sampled: {there} of {whole} scenes." if there < whole else "Every scene is there."
    yield (
        f"Distances are of the arm and of the cube in its hand, everywhere on the way; {1e3 * MARGIN:.0f} mm are kept"
        " from the map."
    )
    yield (
        "The hand's way down to the cube and up again is the same for every method and counts in success alone. The"
        " paper gives no figures of lengths and distances in its text."
    )


SUCCESS = ("method", "succeeded", "95 %", "nearer than 2 cm, map", "truth", "least [cm], map", "truth", "the paper")
JUDGED = ("method", "judged", "safe", "of these collided", "not evaluable", "failed")
PAIRED = ("method", "what", "pairs", "mean", "95 %", "above 0", "p (Wilcoxon)")


def _there(trials: Sequence[Transport]) -> list[str]:
    return [method for method in METHODS if any(trial.method == method for trial in trials)]


def _successes(trials: Sequence[Transport]) -> Iterator[Sequence[str]]:
    for method in _there(trials):
        of = [trial for trial in trials if trial.method == method]
        share = share_of(sum(trial.success for trial in of), len(of))
        cells = []
        for values in ([t.field_clearance for t in of], [t.true_clearance for t in of]):
            known = [value for value in values if value is not None]
            near, least = sum(value < EPSILON for value in known), min(known, default=np.nan)
            cells.append((f"{near}/{len(known)}", f"{100 * least:.1f}"))
        succeeded, words = PAPER.get(method, (None, ""))
        yield (
            NAMES[method],
            f"{share.num_successes}/{share.num}",
            f"{100 * share.low:.0f} to {100 * share.high:.0f} %",
            *(near for near, _ in cells),
            *(least for _, least in cells),
            "" if succeeded is None else f"{succeeded}/{NUM_PAPER}; {words}",
        )


def _panels(trials: Sequence[Transport]) -> Iterator[Sequence[str]]:
    for method in _there(trials):
        of = [trial for trial in trials if trial.method == method and trial.success]
        known = ([v for v in map(value, of) if v is not None] for _, value in PANELS)
        yield NAMES[method], *("{:.2f} [{:.2f}, {:.2f}]".format(*mean_between(values)) for values in known)


def _judged(trials: Sequence[Transport]) -> Iterator[Sequence[str]]:
    for method in _there(trials):
        of = [trial for trial in trials if trial.method == method and trial.verdict]
        false, counts = sum(trial.is_false_green for trial in of), Counter(trial.verdict for trial in of)
        safe, unknown = counts["safe"], counts["not evaluable"]
        yield NAMES[method], *map(str, (len(of), safe, false, unknown, len(of) - safe - unknown))


def _causes(trials: Sequence[Transport]) -> Rows:
    counts = Counter((trial.method, trial.cause) for trial in trials if trial.cause)
    return [(NAMES[method], str(counts[method, cause]), cause) for method, cause in sorted(counts)]


def _pairs(trials: Sequence[Transport]) -> Iterator[Sequence[str]]:
    """Of runs in which both methods succeeded; of success of all."""
    by = {(t.layout, t.number, t.run, t.method): t for t in trials}
    for method in _there(trials):
        pairs = [
            (by[l, n, r, QP_IK], by[l, n, r, method]) for l, n, r, m in by if m == method and (l, n, r, QP_IK) in by
        ]
        if method == QP_IK or not pairs:
            continue
        test = paired([(a.success, b.success) for a, b in pairs])
        alone = f"{test.only_first} and {test.only_second} alone"
        yield NAMES[method], "succeeded", str(test.num), alone, "", "", f"{test.p_value:.2g} (McNemar)"
        both = [(a, b) for a, b in pairs if a.success and b.success]
        for name, value in PANELS:
            differences = [x - y for a, b in both if (x := value(a)) is not None and (y := value(b)) is not None]
            if np.any(differences):
                yield NAMES[method], name, str(len(differences)), *signed_rank(differences)


def _cm(metres: float | None) -> float | None:
    return None if metres is None else 100 * metres


def draw(trials: Sequence[Transport], path: Path) -> None:
    """Fig. 7: lengths and least distances, a line for each run, coloured by the layout."""
    methods = _there(trials)
    runs = sorted({(trial.layout, trial.number, trial.run) for trial in trials})
    of = {(trial.layout, trial.number, trial.run, trial.method): trial for trial in trials}
    panels = []
    for name, value in (PANELS[k] for k in DRAWN):
        cells = [
            [value(of[*run, method]) if of[*run, method].success else None for method in methods] for run in runs
        ]
        level = (100 * EPSILON, "2 cm") if "cm" in name else None
        panels.append(Panel(title=name, values=np.array(cells, np.float64), level=level))
    names = [SHORT[method] for method in methods]
    trials_picture(path, names, panels, [layout for layout, *_ in runs], f"Pick and place, {len(runs)} runs")
