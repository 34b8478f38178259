"""The figures of studies: panels in which every trial is a line over the methods, and each method a box.

M methods, T trials.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.libraries import mpl
from splatctrl_cli.records import Float64
from splatctrl_cli.report.pictures import CURVE_COLORS, INK, drawn_figure, save_figure

HEIGHT = 4.6  # inches
SPREAD = 0.16  # of the space between two methods, over which the trials of one lie


@dataclass(frozen=True, kw_only=True)
class Panel:
    """values (T, M) of the trials by method, NaN where a method has none; level: a value to draw a line at, and what
    it is.
    """

    title: str
    values: Float64
    level: tuple[float, str] | None = None


def trials_picture(
    path: Path, methods: Sequence[str], panels: Sequence[Panel], groups: Sequence[str], title: str
) -> None:
    """Write panels side by side; groups (T,): what the trials are told apart by, a colour each."""
    colors = dict(zip(dict.fromkeys(groups), CURVE_COLORS, strict=False))
    with drawn_figure(HEIGHT) as figure:
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            _draw(axes, panel, methods, [colors[group] for group in groups])
        figure.suptitle(title, fontsize=12, x=0.01, ha="left")
        if len(colors) > 1:
            marks = [mpl.lines.Line2D([], [], color=color, marker="o", label=name) for name, color in colors.items()]
            figure.legend(handles=marks, frameon=False, loc="outside lower center", ncols=len(colors))
        save_figure(figure, path)


def _draw(axes: "mpl.axes.Axes", panel: Panel, methods: Sequence[str], colors: Sequence[str]) -> None:
    num = len(methods)
    middles = np.arange(1, num + 1)
    shift = SPREAD * np.linspace(-1, 1, len(panel.values)) if len(panel.values) > 1 else np.zeros(1)
    for values, by, color in zip(panel.values, shift, colors, strict=True):
        axes.plot(middles + by, values, "o-", color=color, alpha=0.55, linewidth=0.6, markersize=3.5)
    line: dict[str, Any] = {"color": INK, "linewidth": 1.2}
    axes.boxplot(
        [column[np.isfinite(column)] for column in panel.values.T],
        positions=middles,
        widths=0.5,
        showfliers=False,
        medianprops=line | {"linewidth": 2.2},
        boxprops=line,
        whiskerprops=line,
        capprops=line,
    )
    if panel.level is not None:
        value, words = panel.level
        axes.axhline(value, color=INK, linestyle=":", linewidth=1)
        axes.annotate(words, (0.5, value), (0, 3), textcoords="offset points", fontsize=9)
    axes.set_xticks(middles, methods, fontsize=9)
    axes.set_xlim(0.5, num + 0.5)
    low, high = axes.get_ylim()
    axes.set_ylim(min(0.0, low), high)
    axes.set_title(panel.title, fontsize=10, pad=6)
    axes.spines[["top", "right"]].set_visible(False)
