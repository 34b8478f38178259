"""Table II of the paper (IV-B): success rates with 2, 4 and 6 cameras, the paper's and ours."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.environments import ENVIRONMENTS
from experiments.problems import FAMILIES, PER_FAMILY
from experiments.proportions import Paired, Share, paired, share_of
from experiments.trial import CAMERAS, FULL, METHODS, OURS, SUBSET, TRUTH, Trial

NUM_PROBLEMS = {"tabletop": 546, "cubby": 174, "merged-cubby": 222, **dict.fromkeys(FAMILIES, PER_FAMILY)}
PAPER = {  # success rates [%] with 2, 4, 6 cameras: 3D-GS and SplatCtrl, with the planner
    "tabletop": ((50.59, 78.43, 33.88), (95.28, 92.87, 98.17)),
    "cubby": ((6.45, 1.24, 0.00), (95.48, 87.58, 88.51)),
    "merged-cubby": ((8.04, 4.19, 0.45), (93.97, 94.42, 96.85)),
    "all": ((32.83, 48.13, 19.75), (95.01, 92.32, 96.07)),
}
OF_PAPER = ("3D-GS (paper)", "SplatCtrl (paper)")
NAMES = {
    OURS: "ours, planner",
    "tsdf": "TSDF, planner",
    TRUTH: "truth, planner",
    "qp-ik": "ours, QP-IK",
    "qp-ik-detours": "ours, QP-IK with ways out",
    "paper": "--preset paper, planner",
    "3dgs": "3D-GS, planner",
    "occupancy": "occupancy grid, planner",
}
TITLES = {"tabletop": "Tabletop", "cubby": "Cubby", "merged-cubby": "Merged cubby"}
COUNTS_APART = (
    "The paper's rates imply 862, 937 and 942 trials for 2, 4 and 6 cameras; here every number of cameras sees the "
    "same problems."
)
FAMILY = "MotionBenchMaker"

Rows = Sequence[Sequence[str]]


def problems(trials: int | None, archive: Path | None) -> list[tuple[str, int]]:
    """Environment and number of the problems: all of the paper's counts, or at most `trials` of each environment."""
    environments = (*ENVIRONMENTS, *(FAMILIES if archive else ()))
    return [
        (name, number + (name in FAMILIES))
        for name in environments
        for number in range(min(NUM_PROBLEMS[name], NUM_PROBLEMS[name] if trials is None else trials))
    ]


def sections(trials: Sequence[Trial]) -> Iterator[tuple[str, Sequence[str], Rows]]:
    """Title, header and rows of each part: rates, verdicts, failures by cause, paired tests."""
    header = ("", "trials", *(f"{n} cameras" for n in CAMERAS))
    for environment in ENVIRONMENTS:
        of = [trial for trial in trials if trial.environment == environment]
        if of:
            full = f"{len({t.number for t in of})} of {NUM_PROBLEMS[environment]} problems"
            yield f"{TITLES[environment]} ({full}), success [%]", header, list(_rates(of, environment))
    drawn = [trial for trial in trials if trial.environment in ENVIRONMENTS]
    if len({trial.environment for trial in drawn}) == len(ENVIRONMENTS):
        yield "The three, weighted by the paper's counts, success [%]", header, list(_averages(drawn))
    archive = [trial for trial in trials if trial.environment in FAMILIES]
    if archive:
        full = f"{len({(t.environment, t.number) for t in archive})} of {len(FAMILIES) * PER_FAMILY} problems"
        yield f"{FAMILY} ({full}), success [%]", header, list(_rates(archive, ""))
    yield "Judged by the map alone", _JUDGED, list(_judged(trials))
    yield "Failures by cause", ("method", *(f"{n} cameras" for n in CAMERAS), "cause"), list(_causes(trials))
    yield "The same problems, two methods", _PAIRED, _tests(trials)


def notes(trials: Sequence[Trial]) -> Iterator[str]:
    """Notes on full and sampled cells, and on the table."""
    there = [method for method in METHODS if any(trial.method == method for trial in trials)]
    sampled = [
        f"{name} {count} of {NUM_PROBLEMS[name]}"
        for name, count in Counter(e for e, _ in {(t.environment, t.number) for t in trials}).items()
        if count < NUM_PROBLEMS[name]
    ]
    yield f"Sampled environments: {', '.join(sorted(sampled))}." if sampled else "Every environment is full."
    part = [NAMES[method] for method in there if method not in FULL]
    if part:
        yield f"On the first {SUBSET} problems of each of the three alone: {'; '.join(part)}."
    left_out = [NAMES[method] for method in METHODS if method not in there]
    if left_out:
        yield f"Not run: {'; '.join(left_out)}."
    yield COUNTS_APART
    yield "In brackets: 95 % intervals (Wilson; of the weighted rows by the strata's variances)."


def _of_paper(environment: str) -> list[tuple[str, ...]]:
    named = zip(OF_PAPER, PAPER.get(environment, ()), strict=False)
    return [(name, "", *(f"{rate:.2f}" for rate in rates)) for name, rates in named]


def _rates(trials: Sequence[Trial], environment: str) -> Iterator[Sequence[str]]:
    yield from _of_paper(environment)
    for method in METHODS:
        cells = [_share(trials, method, n) for n in CAMERAS]
        if cells[0].num:
            yield NAMES[method], str(cells[0].num), *map(_shown, cells)


def _averages(trials: Sequence[Trial]) -> Iterator[Sequence[str]]:
    yield from _of_paper("all")
    of = {name: [trial for trial in trials if trial.environment == name] for name in ENVIRONMENTS}
    for method in METHODS:
        strata = ({name: _share(of[name], method, num) for name in ENVIRONMENTS} for num in CAMERAS)
        count = sum(trial.method == method and trial.cameras in (0, CAMERAS[0]) for trial in trials)
        if count:
            yield NAMES[method], str(count), *map(_weighted, strata)


def _weighted(strata: Mapping[str, Share]) -> str:
    """Mean over environments weighted by the paper's counts, with an interval from each one's Wilson interval."""
    if not all(share.num for share in strata.values()):
        return "-"
    weights = np.array([NUM_PROBLEMS[name] for name in strata], np.float64)
    weights /= weights.sum()
    value = np.array([share.value for share in strata.values()])
    below = np.sqrt(np.sum((weights * [s.value - s.low for s in strata.values()]) ** 2))
    above = np.sqrt(np.sum((weights * [s.high - s.value for s in strata.values()]) ** 2))
    mean = float(weights @ value)
    return f"{100 * mean:.2f} [{100 * (mean - below):.1f}, {100 * (mean + above):.1f}]"


def _share(trials: Sequence[Trial], method: str, num_cameras: int) -> Share:
    of = [trial for trial in trials if trial.method == method and trial.cameras in (0, num_cameras)]
    return share_of(sum(trial.success for trial in of), len(of))


def _shown(share: Share) -> str:
    return f"{100 * share.value:.2f} [{100 * share.low:.1f}, {100 * share.high:.1f}]" if share.num else "-"


_JUDGED = ("method", "cameras", "judged", "safe", "of these collided", "in known space", "not evaluable")


def _judged(trials: Sequence[Trial]) -> Iterator[Sequence[str]]:
    for method in METHODS:
        for num in CAMERAS:
            of = [t for t in trials if t.method == method and t.cameras == num and t.verdict]
            if of:
                counts = (
                    sum(t.verdict == "safe" for t in of),
                    sum(t.is_false_green for t in of),
                    sum(t.in_known_space is True for t in of),
                    sum(t.verdict == "not evaluable" for t in of),
                )
                yield NAMES[method], str(num), str(len(of)), *map(str, counts)


def _causes(trials: Sequence[Trial]) -> Iterator[Sequence[str]]:
    for method in METHODS:
        of = [trial for trial in trials if trial.method == method and trial.cause]
        for cause in sorted({trial.cause for trial in of}):
            counts = [sum(t.cause == cause and t.cameras in (0, num) for t in of) for num in CAMERAS]
            yield NAMES[method], *map(str, counts), cause


_PAIRED = ("first", "second", "pairs", "only first", "only second", "p (McNemar)")


def _tests(trials: Sequence[Trial]) -> Rows:
    """Our method against every other, all cameras together, and more cameras against fewer."""
    found = {(t.environment, t.number, t.cameras, t.method): t.success for t in trials}
    rows: list[Sequence[str]] = []
    for method in METHODS:
        if method != OURS:
            pairs = [
                (ours, found[e, n, 0 if method == TRUTH else c, method])
                for (e, n, c, name), ours in found.items()
                if name == OURS and (e, n, 0 if method == TRUTH else c, method) in found
            ]
            rows += _tested(NAMES[OURS], NAMES[method], paired(pairs))
    for more in CAMERAS[1:]:
        few = CAMERAS[0]
        pairs = [
            (found[e, n, more, OURS], success)
            for (e, n, c, name), success in found.items()
            if name == OURS and c == few and (e, n, more, OURS) in found
        ]
        rows += _tested(f"ours, {more} cameras", f"ours, {few} cameras", paired(pairs))
    return rows


def _tested(first: str, second: str, test: Paired) -> Rows:
    counts = (test.num, test.only_first, test.only_second)
    return [(first, second, *map(str, counts), f"{test.p_value:.3g}")] if test.num else []
