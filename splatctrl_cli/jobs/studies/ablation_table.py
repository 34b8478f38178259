"""What each mechanism gives, as a table: what its absence changes, over the same recordings."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from splatctrl_cli.evaluate.proportions import mean_between
from splatctrl_cli.jobs.studies.ablation import ALL, NUM_PROBLEMS, OF_MOTION, OFF, SCAN, TABLE, Measured

TITLES = {TABLE: "A motion past a visitor", SCAN: "Held-out views of a still scan"}
HEADER = ("without", "runs", "dB", "depth error [mm]", "in front [%]", "fit [times]")
OF_TABLE = ("audit: false collisions", "false greens", "loop: reached", "loop time [s]", "least true clearance [mm]")
NOTHING = 0.5  # of an effect's own interval: what includes zero and moves no verdict is no effect

Rows = Sequence[Sequence[str]]
Value = Callable[[Measured], float | None]


def sections(trials: Sequence[Measured]) -> Iterator[tuple[str, Sequence[str], Rows]]:
    """Title, header and rows for each kind of recording: absolute figures with everything on, then differences."""
    for environment, title in TITLES.items():
        of = [trial for trial in trials if trial.environment == environment]
        if of:
            count = len({trial.number for trial in of})
            header = (*HEADER, *(OF_TABLE if environment == TABLE else ()))
            yield f"{title} ({count} of {NUM_PROBLEMS[environment]}); differences to all of it", header, _rows(of)


def notes(trials: Sequence[Measured]) -> Iterator[str]:
    """How to read it, and what gives nothing."""
    yield "In brackets: 95 % intervals of the mean difference, over the same recordings (Student's t)."
    yield "False greens and collisions: of the audit and the closed loop, by the map alone, against the truth."
    without = sorted({trial.method for trial in trials} - {ALL}, key=list(OFF).index)
    idle = [method for method in without if not _gives(trials, method)]
    if idle:
        yield f"Nothing changes beyond chance without: {', '.join(idle)}."
    failed = [trial for trial in trials if trial.error]
    yield from (f"{trial.label}: {trial.error}" for trial in failed[:5])


def _rows(trials: Sequence[Measured]) -> Rows:
    by_method = {m: {t.number: t for t in trials if t.method == m} for m in OFF}
    everything = by_method.pop(ALL)
    rows = [_row(ALL, list(everything.values()), None)] if everything else []
    for method, found in by_method.items():
        if found:
            rows.append(_row(method, list(found.values()), everything))
    return rows


def _row(method: str, found: Sequence[Measured], beside: Mapping[int, Measured] | None) -> Sequence[str]:
    has_fit = method not in OF_MOTION
    cells = [
        _cell(found, beside, lambda t: t.psnr, ".2f") if has_fit else "",
        _cell(found, beside, lambda t: _mm(t.depth), ".2f") if has_fit else "",
        _cell(found, beside, lambda t: None if t.in_front is None else 100 * t.in_front, ".1f") if has_fit else "",
        _times(found, beside) if has_fit else "",
    ]
    if found[0].environment == TABLE:
        cells += [
            str(sum(t.false_collisions() for t in found)),
            str(sum(t.false_greens() for t in found)),
            f"{sum(t.success for t in found)}",
            _cell(found, beside, lambda t: t.loop_s, ".2f"),
            _cell(found, beside, lambda t: _mm(t.loop_clearance), ".1f"),
        ]
    return (method, str(len(found)), *cells)


def _cell(found: Sequence[Measured], beside: Mapping[int, Measured] | None, value: Value, form: str) -> str:
    """The mean, or the mean difference with its interval."""
    if beside is None:
        values = [v for v in map(value, found) if v is not None]
        return f"{np.mean(values):{form}}" if values else "-"
    mean, low, high = mean_between(_differences(found, beside, value))
    if np.isnan(mean):
        return "-"
    return f"{mean:+{form}}" if np.isnan(low) else f"{mean:+{form}} [{low:+{form}}, {high:+{form}}]"


def _differences(found: Sequence[Measured], beside: Mapping[int, Measured], value: Value) -> list[float]:
    pairs = [(value(t), value(beside[t.number])) for t in found if t.number in beside]
    return [a - b for a, b in pairs if a is not None and b is not None]


def _times(found: Sequence[Measured], beside: Mapping[int, Measured] | None) -> str:
    """Seconds of the fit, or how many times as long it takes."""
    if beside is None:
        values = [t.fit_s for t in found if t.fit_s is not None]
        return f"{np.median(values):.1f} s" if values else "-"
    pairs = [(t.fit_s, beside[t.number].fit_s) for t in found if t.number in beside]
    ratios = [a / b for a, b in pairs if a and b]
    return f"{np.median(ratios):.2f}" if ratios else "-"


def _gives(trials: Sequence[Measured], method: str) -> bool:
    """Whether anything but time differs without it, beyond chance, on any kind of recording."""
    values: tuple[Value, ...] = (lambda t: t.psnr, lambda t: t.depth, lambda t: t.in_front, lambda t: t.loop_s)
    for environment in TITLES:
        beside = {t.number: t for t in trials if t.environment == environment and t.method == ALL}
        found = [t for t in trials if t.environment == environment and t.method == method and t.number in beside]
        same = [beside[t.number] for t in found]
        if any(_faults(t) != _faults(s) for t, s in zip(found, same, strict=True)):
            return True
        for value in values:
            mean, low, high = mean_between(_differences(found, beside, value))
            if not np.isnan(mean) and (low > 0 or high < 0):
                return True
    return False


def _faults(trial: Measured) -> tuple[int, int, bool]:
    return trial.false_collisions(), trial.false_greens(), trial.success


def _mm(length: float | None) -> float | None:
    return None if length is None else 1e3 * length
