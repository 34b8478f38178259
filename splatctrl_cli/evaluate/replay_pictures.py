"""Pictures of a replay: what a controller would have changed, and how far a driven arm leaves the log."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.evaluate.pictures import CURVE_COLORS, INK, drawn_figure, save_figure, span_of
from splatctrl_cli.records import Float64

SMALLEST = 0.01  # [rad/s] half the height of the difference's axis, at least: rounding is no difference


def open_loop_picture(
    path: Path,
    seconds: Float64,
    difference: Float64,
    joints: Sequence[str],
    margin: Float64,
    shaped: Sequence[tuple[float, float]],
) -> None:
    """Write commanded less logged velocity (T, J) [rad/s] over the room (T,) [m/s] that the logged velocity left.

    shaped: intervals [s] in which a row shaped the command, shaded.
    """
    with drawn_figure(7.2) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for color, style, (joint, curve) in zip(
            cycle(CURVE_COLORS), cycle(["-"] * 6 + ["--"] * 6), zip(joints, difference.T, strict=True), strict=False
        ):
            above.plot(seconds, curve, style, color=color, linewidth=1.5, label=joint)
        above.set_title("Commanded less logged joint velocity; shaded: a row shapes the command", pad=10)
        above.set_ylabel("difference [rad/s]")
        largest = float(np.nanmax(np.abs(difference), initial=0.0))
        above.set_ylim(-max(1.1 * largest, SMALLEST), max(1.1 * largest, SMALLEST))
        above.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        below.plot(seconds, margin, color=CURVE_COLORS[0], linewidth=1.8)
        below.fill_between(seconds, margin, 0.0, where=margin < 0, color=CURVE_COLORS[1], alpha=0.35, linewidth=0)
        below.axhline(0.0, color=INK, linewidth=1.2, linestyle=(0, (6, 3)))
        below.set_title(
            "Room that the logged velocity left in the tightest barrier row; below 0 it breaks it", pad=10
        )
        below.set(xlabel="time [s]", ylabel="h - G v [m/s]")
        for axes in (above, below):
            for start, end in shaped:
                axes.axvspan(start, max(end, start + 1e-3), color="#000000", alpha=0.06, linewidth=0)
            _tidy(axes, seconds)
        save_figure(figure, path)


def divergence_picture(path: Path, seconds: Float64, joints: Float64, position: Float64, rotation: Float64) -> None:
    """Write how far the arm is from the log (T,): joints [rad], its frame's position [m] and rotation [rad]."""
    curves = (
        ("all joints [rad]", joints),
        ("frame, position [cm]", 100.0 * position),
        ("frame, rotation [degrees]", np.degrees(rotation)),
    )
    with drawn_figure(7.8) as figure:
        for color, axes, (label, values) in zip(
            CURVE_COLORS, figure.subplots(3, 1, sharex=True), curves, strict=False
        ):
            axes.plot(seconds, values, color=color, linewidth=1.8)
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
            _tidy(axes, seconds)
        figure.axes[0].set_title("Distance of the driven arm from the log at the same time", pad=10)
        figure.axes[-1].set_xlabel("time [s]")
        save_figure(figure, path)


def _tidy(axes: Any, seconds: Float64) -> None:
    axes.set_xlim(span_of(seconds))
    axes.grid(axis="y", color="#e4e4e4", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
