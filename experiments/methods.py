"""Methods side by side: every figure of each by name, as a table, ``methods.json`` and ``methods.png``."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.standstill import Separation
from experiments.tables import aligned, shown
from experiments.yardstick import MotionFigures
from splatctrl_cli.blocks import CURVE_COLORS, INK, Float64, PlannedPath, drawn_figure

MOTION = (
    *("success", "goal_reached", "duration_s", "joint_path_rad", "effector_path_m", "effector_path_deg"),
    *("min_clearance_barrier", "min_clearance", "min_clearance_proved", "min_clearance_true", "num_interventions"),
)
PLAN = ("planning_time_s", "planned_margin", "planned_self_margin", "num_edges", "num_edges_proved")
Values = Mapping[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Method:
    """The figures of a motion, None without a path, and the plan of a method that plans."""

    figures: MotionFigures | None = None
    plan: PlannedPath | None = None

    def values(self) -> Values:
        """Every figure by name (`MOTION`, and `PLAN` of a plan); None if it has no value."""
        return _motion_values(self.figures) | ({} if self.plan is None else _plan_values(self.plan))


def _motion_values(figures: MotionFigures | None) -> dict[str, float | None]:
    if figures is None:
        return dict.fromkeys(MOTION) | {"success": 0, "goal_reached": 0}
    values = (
        int(figures.is_success),
        int(figures.has_arrived),
        figures.duration,
        figures.joint_path,
        figures.effector_path,
        figures.effector_turn,
        _finite(figures.clearance["barrier"]),
        _finite(figures.clearance["exact"]),
        _finite(figures.proved),
        None if figures.true_clearance is None else _finite(figures.true_clearance),
        figures.num_interventions,
    )
    return dict(zip(MOTION, values, strict=True))


def _plan_values(plan: PlannedPath) -> dict[str, float | None]:
    values = (plan.seconds, _finite(plan.margin), _finite(plan.self_margin), plan.num_edges, plan.num_proved)
    return dict(zip(PLAN, values, strict=True))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


@dataclass(frozen=True, kw_only=True)
class SideBySide:
    """Methods by name, in the order in which they stand side by side, at a controller's period [s]; beside_people: of
    a standstill and the closed loop, the distances to people.
    """

    methods: Mapping[str, Method]
    period: float
    beside_people: Mapping[str, Separation]

    def people(self) -> Mapping[str, Values]:
        """The figures of `beside_people` by motion."""
        return {name: of.figures(self.period) for name, of in self.beside_people.items()}

    def figures(self) -> Mapping[str, Values]:
        """The figures of every method."""
        return {name: method.values() for name, method in self.methods.items()}

    def metrics(self) -> Values:
        """Every figure as METHOD_NAME."""
        tables = (self.people(), self.figures())
        return {f"{name}_{key}": x for table in tables for name, of in table.items() for key, x in of.items()}

    def document(self) -> dict[str, Any]:
        """``methods.json``: figures by method, and what was planned."""
        plans = {name: method.plan for name, method in self.methods.items() if method.plan is not None}
        return {
            "units": "m, rad, s, degrees where the name says so",
            "methods": self.figures(),
            "plans": {
                name: {"outcome": str(plan.outcome), "waypoints": plan.path.waypoints.tolist() if plan.path else []}
                for name, plan in plans.items()
            },
            "people": self.people(),
        }

    def lines(self) -> Iterator[str]:
        """The tables, and a line for each plan that was not found."""
        if self.beside_people:
            yield from ("Beside people, from the same moment:", *_table(self.people()), "")
        yield "Side by side, from the same state to the same goal:"
        yield from _table(self.figures())
        for name, method in self.methods.items():
            if method.plan is not None and method.plan.path is None:
                yield f"{name}: no path: {method.plan.outcome}"

    def draw(self, path: Path, margin: float) -> None:
        """Write ``methods.png``: `clearance_picture` of every method by the controller's field."""
        curves = {name: of.figures.barrier for name, of in self.methods.items() if of.figures is not None}
        clearance_picture(path, curves, self.period, margin)


def clearance_picture(path: Path, clearance: Mapping[str, Float64], period: float, margin: float) -> None:
    """Write a curve [cm] for the clearance (T,) [m] of each method, a state every `period` [s]. Its least value is
    marked; each motion's end is a bar, and the margin [m] a line. NaN leaves gaps.
    """
    with drawn_figure(path, 4.8) as figure:
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
            style: Any = (
                (0, (3, 2)) if number == len(clearance) - 1 else "-"
            )  # what it covers shows between its dashes
            axes.plot(seconds, centimetres, color=color, linewidth=2.0, linestyle=style, label=label)
        axes.axhline(
            100 * margin, color=INK, linewidth=1.0, linestyle=(0, (6, 3)), label=f"margin {100 * margin:g} cm"
        )
        axes.axhline(0.0, color="#cccccc", linewidth=0.8, zorder=0)
        axes.set(xlabel="time since the start [s]", ylabel="clearance [cm]")
        axes.set_title("Clearance of every method, by the controller's field")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=10, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _table(columns: Mapping[str, Values]) -> list[str]:
    """Lines of a table: a column per method, a row per figure that any method has."""
    names = dict.fromkeys(name for values in columns.values() for name in values)
    found = {name: [values.get(name) for values in columns.values()] for name in names}
    there = {name: values for name, values in found.items() if any(value is not None for value in values)}
    return aligned(("", *columns), ((name, *(shown(value, ".4g") for value in of)) for name, of in there.items()))
