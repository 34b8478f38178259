"""Inline SVG of clearance over time, in the colours of the replay's pictures."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

import numpy as np
from markupsafe import Markup, escape

from splatctrl_cli.records import Float64
from splatctrl_cli.report.pictures import CURVE_COLORS, span_of
from splatctrl_cli.report.replay_pictures import (
    FIELD_NAMES,
    FIELD_STYLES,
    KIND_COLORS,
    QUIET,
    Intervals,
    envelope,
    spans,
)

WIDTH, LEFT, RIGHT = 1000, 160, 70  # pixels
TOP, HEIGHT, STRIP = 12, 230, 20
COLUMNS = 500  # of a curve
SOLVED = "#b7cde0"  # a step that was plainly taken
DASHES = {"barrier": "6 4"}


def timeline(
    seconds: Float64,
    curves: Mapping[str, Float64],
    margin: float,
    events: Mapping[str, Intervals],
    rungs: Sequence[str] = (),
) -> Markup:
    """Clearance curves (T,) [m] over `seconds` (T,), in cm, with the margin [m] and strips.

    Strips show each kind of event by its intervals [s], and a controller's `rungs` (T,).
    """
    axis = _Axis(seconds, curves, margin)
    strips = {kind: [(*span, KIND_COLORS.get(kind.split(" (")[0], QUIET), kind) for span in spans(of, axis.span)]
              for kind, of in events.items() if of}  # fmt: skip
    if any(rungs):
        strips["QP rung"] = [
            (start, max(end - start, 0.0), KIND_COLORS.get(rung, SOLVED), rung)
            for rung, start, end in runs_of(rungs, seconds)
        ]
    parts = [*axis.ticks(), *axis.margin_line(), *_curves(axis, seconds, curves), *_strips(axis, strips)]
    height = axis.bottom + 34 + STRIP * len(strips)
    facts = {
        **{"left": LEFT, "right": WIDTH - RIGHT, "start": axis.span[0], "end": axis.span[1]},
        **{"top": TOP, "bottom": axis.bottom, "high": axis.high, "low": axis.low},
    }
    data = " ".join(f'data-{name}="{value:.6g}"' for name, value in facts.items())
    start = (
        f'<svg class="timeline" viewBox="0 0 {WIDTH} {height}" role="img" aria-label="clearance over time" {data}>'
    )
    return Markup("".join([start, *parts, "</svg>"]))  # every text in it was escaped


def runs_of(rungs: Sequence[str], seconds: Float64) -> list[tuple[str, float, float]]:
    """Runs of equal rungs: rung, first time [s], and the next run's first time [s]."""
    runs, first = [], 0
    for rung, group in groupby(rungs):
        behind = first + len(list(group))
        end = seconds[behind] if behind < len(seconds) else seconds[-1]
        if rung:
            runs.append((rung, float(seconds[first]), float(end)))
        first = behind
    return runs


class _Axis:
    """Time to the right [s], clearance upwards [cm], in pixels."""

    def __init__(self, seconds: Float64, curves: Mapping[str, Float64], margin: float) -> None:
        self.span = span_of(seconds)
        self.margin = 100 * margin
        known = [100 * values[np.isfinite(values)] for values in curves.values()]
        values = np.concatenate([np.array([0.0, 1.5 * self.margin]), *known])
        self.high, self.low = 1.05 * float(values.max()), min(0.0, 1.1 * float(values.min()))
        self.bottom = TOP + HEIGHT

    def x(self, seconds: Float64 | float) -> Float64:
        start, end = self.span
        return np.asarray(LEFT + (WIDTH - LEFT - RIGHT) * (seconds - start) / (end - start))

    def y(self, centimetres: Float64 | float) -> Float64:
        return np.asarray(TOP + HEIGHT * (self.high - centimetres) / (self.high - self.low))

    def ticks(self) -> Iterator[str]:
        for value in _steps(self.low, self.high, 5):
            y = float(self.y(value))
            yield f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>'
            yield f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>'
        turned = f'x="18" y="{TOP + HEIGHT / 2}" transform="rotate(-90 18 {TOP + HEIGHT / 2})"'
        yield f'<text {turned} text-anchor="middle">clearance [cm]</text>'
        for value in _steps(*self.span, 8):
            x = float(self.x(value))
            yield f'<text x="{x:.1f}" y="{self.bottom + 16}" text-anchor="middle">{value:g}</text>'
        yield f'<text x="{WIDTH - RIGHT + 14}" y="{self.bottom + 16}">s</text>'

    def margin_line(self) -> Iterator[str]:
        y = float(self.y(self.margin))
        box = f'x="{LEFT}" y="{y:.1f}" width="{WIDTH - LEFT - RIGHT}" height="{self.bottom - y:.1f}"'
        yield f'<rect class="below" {box}/>'
        yield f'<path class="margin" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>'
        yield f'<text x="{WIDTH - RIGHT + 4}" y="{y + 4:.1f}">{self.margin:g} cm</text>'
        if self.low < 0:
            zero = float(self.y(0.0))
            yield f'<path class="contact" d="M{LEFT} {zero:.1f}H{WIDTH - RIGHT}"/>'


def _steps(low: float, high: float, count: int) -> list[float]:
    rough = (high - low) / count
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * min((1, 2, 5, 10), key=lambda factor: abs(factor * power - rough))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [round(number * step, 9) for number in range(first, last + 1)]


def _curves(axis: _Axis, seconds: Float64, curves: Mapping[str, Float64]) -> Iterator[str]:
    for name, metres in curves.items():
        color, _, width = FIELD_STYLES.get(name, (CURVE_COLORS[3], "-", 1.5))
        dash = f' stroke-dasharray="{DASHES[name]}"' if name in DASHES else ""
        times, lowest, highest = envelope(seconds, 100 * metres, COLUMNS)
        x = axis.x(times)
        title = escape(FIELD_NAMES.get(name, name))
        for part in _pieces(lowest):
            low = _points(x[part], axis.y(lowest[part]))
            if lowest is not highest:
                back = _points(x[part][::-1], axis.y(highest[part])[::-1])
                yield f'<polygon points="{low} {back}" fill="{color}" opacity="0.3"/>'
            yield (
                f'<polyline points="{low}" data-name="{title}" stroke="{color}" stroke-width="{width}"{dash}>'
                f"<title>{title}</title></polyline>"
            )
        if np.isfinite(metres).any():
            least = int(np.nanargmin(metres))
            at = axis.x(seconds[[least]])[0], axis.y(100 * metres[[least]])[0]
            yield f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="4" fill="{color}" stroke="white"/>'


def _pieces(values: Float64) -> list[slice]:
    there = np.concatenate([[False], np.isfinite(values), [False]])
    edges = np.flatnonzero(there[1:] != there[:-1])
    return [slice(first, last) for first, last in zip(edges[::2], edges[1::2], strict=True)]


def _points(x: Float64, y: Float64) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def _strips(axis: _Axis, strips: Mapping[str, Sequence[tuple[float, float, str, str]]]) -> Iterator[str]:
    """Rows by kind: name, and bars (start [s], length [s], colour, title)."""
    for row, (kind, bars) in enumerate(strips.items()):
        top = axis.bottom + 28 + STRIP * row
        yield f'<rect class="row" x="{LEFT}" y="{top}" width="{WIDTH - LEFT - RIGHT}" height="{STRIP - 6}"/>'
        yield f'<text x="{LEFT - 8}" y="{top + 11}" text-anchor="end">{escape(kind)}</text>'
        for start, length, color, title in bars:
            first, last = axis.x(np.array([start, min(start + length, axis.span[1])]))
            words = f"{escape(title)}, {start:.2f} to {start + length:.2f} s"
            yield (
                f'<rect x="{first:.1f}" y="{top}" width="{max(last - first, 1.0):.1f}" height="{STRIP - 6}"'
                f' fill="{color}"><title>{words}</title></rect>'
            )
            if title != kind and last - first > 8 * len(title):  # pixels of a letter
                yield f'<text class="named" x="{first + 4:.1f}" y="{top + 11}">{escape(title)}</text>'


def legend(curves: Mapping[str, Float64]) -> list[tuple[str, str, str]]:
    rows = []
    for name, metres in curves.items():
        known = metres[np.isfinite(metres)]
        least = f"least {1e3 * known.min():.1f} mm" if known.size else "no value"
        rows.append((str(FIELD_STYLES.get(name, (CURVE_COLORS[3], "-", 1.5))[0]), FIELD_NAMES.get(name, name), least))
    return rows
