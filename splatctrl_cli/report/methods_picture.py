"""The clearance of several motions of one task over time."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from splatctrl_cli.records import Float64
from splatctrl_cli.report.pictures import CURVE_COLORS, INK, drawn_figure, save_figure


def methods_picture(path: Path, clearance: Mapping[str, Float64], period: float, margin: float) -> None:
    """Write a curve [cm] for the clearance (T,) [m] of each method, a state every `period` [s], with its least value
    marked, the end of each as a bar, and the margin [m] as a line. Gaps (NaN) stay gaps.
    """
    with drawn_figure(4.8) as figure:
        axes = figure.subplots()
        for number, (name, values) in enumerate(clearance.items()):
            color, centimetres = CURVE_COLORS[number % len(CURVE_COLORS)], 100.0 * np.asarray(values)
            seconds = period * np.arange(len(values))
            label = f"{name}, no value"
            if np.isfinite(centimetres).any():
                at = int(np.nanargmin(centimetres))
                label = f"{name}, least {centimetres[at]:.1f} cm"
                axes.plot(seconds[at], centimetres[at], "o", color=color, markersize=6, markeredgecolor="white")
                axes.plot(seconds[-1], centimetres[-1], "|", color=color, markersize=14, markeredgewidth=2)
            style = (0, (3, 2)) if number == len(clearance) - 1 else "-"  # what it covers shows between its dashes
            axes.plot(seconds, centimetres, color=color, linewidth=2.0, linestyle=style, label=label)
        axes.axhline(
            100 * margin, color=INK, linewidth=1.0, linestyle=(0, (6, 3)), label=f"margin {100 * margin:g} cm"
        )
        axes.axhline(0.0, color="#cccccc", linewidth=0.8, zorder=0)
        axes.set(xlabel="time since the start [s]", ylabel="clearance [cm]")
        axes.set_title("Clearance of every method, by the controller's field")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=10, loc="center left", bbox_to_anchor=(1.0, 0.5))
        save_figure(figure, path)
