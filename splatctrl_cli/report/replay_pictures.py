"""Pictures of a replay: clearance, events, commands, divergence; long curves as ranges."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.files.spilled_rows import BLOCK
from splatctrl_cli.records import Float64, FloatRows
from splatctrl_cli.report.pictures import CURVE_COLORS, INK, drawn_figure, set_grid, span_of
from splatctrl_cli.voxels import EvidenceClass

Intervals = Sequence[tuple[float, float]]
"""First and last time [s] of each interval."""

SMALLEST = 0.01  # [rad/s] half the height of a velocity's axis, at least: rounding shows no difference
QUIET = "#9a9a9a"
KIND_COLORS = {  # by what happened; Okabe and Ito
    "below-margin": "#e69f00",
    "in-collision": "#d55e00",
    "without-distance": "#555555",
    "unknown-space": "#cc79a7",
    "outside-limits": "#56b4e9",
    "stale-map": "#8a6d3b",
    "scene": "#0072b2",
    "self": "#009e73",
    "limit": "#cc79a7",
    "relaxed": "#e69f00",
    "minimum-violation": "#d55e00",
    "hold": "#222222",
    "scaled-back": "#56b4e9",
    "cannot-act": "#8a6d3b",
}
EVIDENCE_COLORS = {  # what is known green and blue, what is assumed grey, what is warned of red
    EvidenceClass.FREE: "#009e73",
    EvidenceClass.SWEPT: "#56b4e9",
    EvidenceClass.STALE: "#8a6d3b",
    EvidenceClass.HIDDEN_BY_ARM: "#c8c8c8",
    EvidenceClass.HIDDEN_BY_THING: "#a0a0a0",
    EvidenceClass.OUT_OF_VIEW: "#787878",
    EvidenceClass.NO_RETURN: "#505050",
    EvidenceClass.CONTRADICTED: "#e69f00",
    EvidenceClass.UNANSWERED: "#d55e00",
    EvidenceClass.OUTSIDE: "#cc79a7",
    EvidenceClass.SURFACE: "#111111",
}
FIELD_STYLES: Mapping[str, tuple[str, Any, float]] = {  # colour, dashes, width
    "exact": (CURVE_COLORS[0], "-", 2.6),
    "barrier": (CURVE_COLORS[5], (0, (4, 2)), 1.5),
    "certified": (CURVE_COLORS[2], "-", 1.2),
    "truth": (INK, "-", 1.2),
}
FIELD_NAMES = {
    "exact": "to the splats",
    "barrier": "by the controller's field",
    "certified": "certified bound",
    "truth": "truth",
}
SHORTEST = 1.0 / 400.0  # share of the axis: an interval is drawn no shorter


def clearance_picture(
    path: Path,
    seconds: Float64,
    curves: Mapping[str, FloatRows],
    margin: float,
    title: str,
    events: Mapping[str, Intervals],
) -> None:
    """Write clearance curves (T,) [m] over `seconds` (T,), with margin [m] and event strips.

    NaN leaves gaps. Space below the margin is shaded, minima are marked.
    """
    shown = {kind: intervals for kind, intervals in events.items() if intervals}
    with drawn_figure(path, 4.8 + _strip_height(shown)) as figure:
        axes, strip = figure.subplots(2, 1, sharex=True, height_ratios=[4.4, max(_strip_height(shown), 0.05)])
        lowest = min(0.0, *[_clearance_curve(axes, seconds, values, name) for name, values in curves.items()])
        bottom = lowest * 1.15 - 0.2 if lowest < 0 else 0.0
        axes.axhspan(bottom, 100 * margin, color="#000000", alpha=0.06, linewidth=0)
        axes.axhline(100 * margin, color=INK, linewidth=1.0, linestyle=(0, (6, 3)))
        axes.annotate(
            f"margin {100 * margin:g} cm",
            (1.0, 100 * margin),
            xycoords=("axes fraction", "data"),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            annotation_clip=False,
        )
        if bottom < 0:
            axes.axhline(0.0, color=KIND_COLORS["in-collision"], linewidth=1.0)
        axes.set(ylabel="clearance [cm]", ylim=(bottom, None))
        axes.set_title(title, pad=30)
        axes.legend(
            frameon=False, loc="lower left", bbox_to_anchor=(-0.01, 0.99), ncols=4, fontsize=10, borderaxespad=0.2
        )
        _tidy(axes, seconds)
        _draw_strip(strip, axes, shown, seconds)


def evidence_picture(path: Path, seconds: Float64, shares: Float64) -> None:
    """Write stacked shares (T, C) by `EvidenceClass` of the space within the margin.

    Rows with NaN are left out.
    """
    is_asked = np.isfinite(shares).all(axis=1)
    there = [kind for kind in EVIDENCE_COLORS if shares[is_asked, kind].any()]
    with drawn_figure(path, 3.6) as figure:
        axes = figure.subplots()
        axes.stackplot(
            seconds[is_asked],
            *(100 * shares[is_asked, kind] for kind in there),
            colors=[EVIDENCE_COLORS[kind] for kind in there],
            labels=[kind.name.lower().replace("_", " ") for kind in there],
            linewidth=0,
        )
        axes.set(ylabel="space within the margin [%]", ylim=(0, 100), xlabel="time [s]")
        axes.set_title("What cameras knew of the space near the arm", pad=44)
        axes.legend(
            frameon=False, loc="lower left", bbox_to_anchor=(-0.01, 0.99), ncols=4, fontsize=10, borderaxespad=0.2
        )
        _tidy(axes, seconds)


def commands_picture(
    path: Path,
    seconds: Float64,
    velocity: FloatRows,
    joints: Sequence[str],
    limits: Float64,
    interventions: Mapping[str, Intervals],
    logged: FloatRows | None = None,
) -> None:
    """Write commanded velocities (T, J) [rad/s] with limits (J,), over strips of interventions.

    logged (T, J): velocities drawn behind.
    """
    height = 0.78 * len(joints)
    with drawn_figure(path, height + 0.6 + _strip_height(interventions)) as figure:
        *rows, strip = figure.subplots(
            len(joints) + 1, 1, sharex=True, height_ratios=[0.78] * len(joints) + [_strip_height(interventions)]
        )
        for j, (axes, joint) in enumerate(zip(rows, joints, strict=True)):
            under = None if logged is None else column(logged, j)
            beneath = 0.0 if under is None else _curve(axes, seconds, under, color=QUIET, width=2.6)
            peak = _curve(axes, seconds, column(velocity, j), color=CURVE_COLORS[0], width=1.5)
            _limit_axis(axes, joint, float(limits[j]), peak, beneath)
            _tidy(axes, seconds)
        legend = "" if logged is None else "; grey: as logged"
        rows[0].set_title(
            f"Commanded joint velocity [rad/s]; dashed: its limit, where it is in sight{legend}", pad=10
        )
        _draw_strip(strip, rows[-1], interventions, seconds)
        figure.align_ylabels(rows)


def open_loop_picture(
    path: Path, seconds: Float64, difference: FloatRows, joints: Sequence[str], margin: FloatRows, shaped: Intervals
) -> None:
    """Write commanded minus logged velocity (T, J) [rad/s], above the logged velocity's margin (T,) [m/s].

    shaped: shaded intervals [s] in which a barrier row changed the command.
    """
    room, largest = np.asarray(margin), 0.0
    times, lowest, _ = envelope(seconds, room)
    with drawn_figure(path, 7.2) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for color, style, (j, joint) in zip(
            cycle(CURVE_COLORS), cycle(["-"] * 6 + ["--"] * 6), enumerate(joints), strict=False
        ):
            largest = max(
                largest,
                _curve(above, seconds, column(difference, j), color=color, width=1.5, style=style, label=joint),
            )
        above.set_title("Commanded less logged joint velocity; shaded: a row shapes the command", pad=10)
        most = max(1.1 * largest, SMALLEST)
        above.set(ylabel="difference [rad/s]", ylim=(-most, most))
        above.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        _curve(below, seconds, room, color=CURVE_COLORS[0], width=1.8)
        below.fill_between(times, lowest, 0.0, where=lowest < 0, color=CURVE_COLORS[1], alpha=0.35, linewidth=0)
        below.axhline(0.0, color=INK, linewidth=1.2, linestyle=(0, (6, 3)))
        below.set_title(
            "Room that the logged velocity left in the tightest barrier row; below 0 it breaks it", pad=10
        )
        below.set(xlabel="time [s]", ylabel="h - G v [m/s]")
        for axes in (above, below):
            for start, length in spans(shaped, span_of(seconds)):
                axes.axvspan(start, start + length, color="#000000", alpha=0.06, linewidth=0)
            _tidy(axes, seconds)


def divergence_picture(
    path: Path, seconds: Float64, joints: FloatRows, position: FloatRows, rotation: FloatRows
) -> None:
    """Write distance from the log (T,): joints [rad], a frame's position [m] and rotation [rad]."""
    curves = (
        ("all joints [rad]", joints, 1.0),
        ("frame, position [cm]", position, 100.0),
        ("frame, rotation [degrees]", rotation, float(np.degrees(1.0))),
    )
    with drawn_figure(path, 7.8) as figure:
        for color, axes, (label, values, factor) in zip(
            CURVE_COLORS, figure.subplots(3, 1, sharex=True), curves, strict=False
        ):
            _curve(axes, seconds, factor * np.asarray(values), color=color, width=1.8)
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
            _tidy(axes, seconds)
        figure.axes[0].set_title("Distance of the driven arm from the log at the same time", pad=10)
        figure.axes[-1].set_xlabel("time [s]")


def _curve(
    axes: Any, seconds: Float64, values: Float64, *, color: str, width: float, style: Any = "-", label: str = ""
) -> float:
    """Draw a curve, or a long one's band; return its largest size."""
    times, lowest, highest = envelope(seconds, values)
    there = np.isfinite(lowest)
    height = float(np.max(highest[there]) - np.min(lowest[there])) if there.any() else 0.0
    is_thin = not there.any() or float(np.median((highest - lowest)[there])) <= 0.05 * height
    if is_thin:
        axes.plot(times, lowest, linestyle=style, color=color, linewidth=width, label=label or "_")
    if lowest is not highest:
        name = "_" if is_thin else label or "_"
        axes.fill_between(times, lowest, highest, color=color, alpha=0.45, linewidth=0.7, label=name)
    return float(np.nanmax(np.abs([lowest, highest]), initial=0.0))


def _clearance_curve(axes: Any, seconds: Float64, metres: FloatRows, name: str) -> float:
    """Draw a curve; return its minimum [cm], or inf."""
    centimetres = 100.0 * np.asarray(metres, dtype=np.float64)
    color, style, width = FIELD_STYLES.get(name, (CURVE_COLORS[3], "-", 1.5))
    label = FIELD_NAMES.get(name, name)
    if not np.isfinite(centimetres).any():
        axes.plot([], [], color=color, label=f"{label}, no value")
        return np.inf
    at = int(np.nanargmin(centimetres))
    label = f"{label}, least {centimetres[at]:.1f} cm"
    _curve(axes, seconds, centimetres, color=color, width=width, style=style, label=label)
    axes.plot(seconds[at], centimetres[at], "o", color=color, markersize=6, markeredgecolor="white", clip_on=False)
    return float(centimetres[at])


def _limit_axis(axes: Any, joint: str, limit: float, peak: float, beneath: float) -> None:
    height = max(1.25 * max(peak, beneath), SMALLEST)
    axes.set_ylim(-height, height)
    for side in (-limit, limit):
        if abs(side) <= height:
            axes.axhline(side, color=KIND_COLORS["in-collision"], linewidth=1.0, linestyle=(0, (6, 3)))
    axes.axhline(0.0, color="#cccccc", linewidth=0.8, zorder=0)
    axes.set_ylabel(joint, rotation=0, ha="right", va="center")
    axes.annotate(
        f"limit {limit:.3g}\npeak {peak:.3g}, {100 * peak / limit:.0f} %",
        (1.0, 0.5),
        xycoords="axes fraction",
        xytext=(8, 0),
        textcoords="offset points",
        va="center",
        fontsize=9,
    )
    axes.locator_params(axis="y", nbins=3)


def _strip_height(events: Mapping[str, Intervals]) -> float:
    return 0.28 * len(events) + 0.55 if events else 0.4


def _draw_strip(axes: Any, above: Any, events: Mapping[str, Intervals], seconds: Float64) -> None:
    axes.set(xlabel="time [s]", xlim=span_of(seconds), ylim=(max(len(events), 1) - 0.4, -0.6))
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.set_yticks(range(len(events)), [f"{kind}  ({len(of)})" for kind, of in events.items()])
    axes.tick_params(axis="y", length=0)
    above.tick_params(axis="x", labelbottom=False)
    for row, (kind, intervals) in enumerate(events.items()):
        axes.axhline(row, color="#eeeeee", linewidth=6, zorder=0)
        axes.broken_barh(
            spans(intervals, span_of(seconds)), (row - 0.32, 0.64), color=KIND_COLORS.get(kind, QUIET), linewidth=0
        )
    if not events:
        axes.text(0.0, 0.5, "no event", transform=axes.transAxes, va="center", color=QUIET)


def _tidy(axes: Any, seconds: Float64) -> None:
    axes.set_xlim(span_of(seconds))
    set_grid(axes)


def envelope(seconds: Float64, values: Float64, columns: int = 1000) -> tuple[Float64, Float64, Float64]:
    """Ranges of values (T,) in `columns` equal parts of time (T,).

    Returns middle times (K,) [s], lowest and highest values (K,), NaN in empty parts. With at most two states per
    column, both are the array `values`.
    """
    values = np.asarray(values, dtype=np.float64)
    if len(values) <= 2 * columns:
        return seconds, values, values
    edges = np.linspace(seconds[0], seconds[-1], columns + 1)
    first = np.searchsorted(seconds, edges[:-1], side="left")
    is_filled = np.append(first[1:], len(values)) > first
    starts = first[is_filled]
    lowest, highest = np.full(columns, np.nan), np.full(columns, np.nan)
    lowest[is_filled], highest[is_filled] = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return 0.5 * (edges[:-1] + edges[1:]), lowest, highest


def column(rows: FloatRows, number: int) -> Float64:
    """A column (T,) of rows (T, K), in blocks."""
    parts = [rows[first : first + BLOCK][:, number] for first in range(0, len(rows), BLOCK)]
    return np.concatenate([np.zeros(0), *parts])


def spans(intervals: Sequence[tuple[float, float]], span_s: tuple[float, float]) -> list[tuple[float, float]]:
    """Start and length [s] of intervals on the axis `span_s`.

    Lengths are at least `SHORTEST` of it. Touching intervals are joined.
    """
    least = SHORTEST * (span_s[1] - span_s[0])
    drawn: list[tuple[float, float]] = []
    for start, end in sorted(intervals):
        end = max(end, start + least)  # noqa: PLW2901
        if drawn and start <= drawn[-1][1]:
            drawn[-1] = drawn[-1][0], max(end, drawn[-1][1])
        else:
            drawn.append((start, end))
    return [(start, end - start) for start, end in drawn]
