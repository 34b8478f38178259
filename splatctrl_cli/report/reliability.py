"""Reliability curves: how often points of a predicted collision probability do collide."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.records import Bool, Float64
from splatctrl_cli.report.pictures import CURVE_COLORS, INK, drawn_figure, save_figure, set_grid


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """Of B bins of predicted probability: edges (B + 1,), mean prediction (B,) and share that collided (B,), NaN in
    an empty bin, count (B,); calibration_error is the mean of their difference, weighted by count.
    """

    edges: Float64
    predicted: Float64
    observed: Float64
    count: NDArray[np.int64]
    calibration_error: float


def reliability(probability: Float64, is_colliding: Bool, bins: int = 10) -> Reliability:
    """How often points (Q,) of a predicted probability do collide; bins equal in width.

    Raises NotEvaluableError without points, UsageError for a probability outside [0, 1].
    """
    if not len(probability):
        raise NotEvaluableError("reliability: expected at least one point, got none")
    if not ((probability >= 0) & (probability <= 1)).all():
        i = int(np.argmin((probability >= 0) & (probability <= 1)))
        raise UsageError(f"reliability: point {i}: expected a probability in [0, 1], got {probability[i]}")
    edges = np.linspace(0.0, 1.0, bins + 1)
    which = np.minimum((probability * bins).astype(np.int64), bins - 1)
    count = np.bincount(which, minlength=bins)
    total, collided = (
        np.bincount(which, weights=values, minlength=bins)
        for values in (probability, is_colliding.astype(np.float64))
    )
    return Reliability(
        edges=edges,
        predicted=np.divide(total, count, out=np.full(bins, np.nan), where=count > 0),
        observed=np.divide(collided, count, out=np.full(bins, np.nan), where=count > 0),
        count=count,
        calibration_error=float(np.abs(total - collided).sum() / len(probability)),
    )


def reliability_picture(path: Path, curves: Mapping[str, Reliability], title: str = "Reliability") -> None:
    """Write the share that collided over the predicted probability, a curve a form, and how many points each bin has.

    A probability that means what it says lies on the diagonal.
    """
    with drawn_figure(5.6) as figure:
        axes, bars = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1, 1]})
        axes.plot([0, 1], [0, 1], color=INK, linewidth=1.0, linestyle=(0, (6, 3)))
        axes.annotate(
            "as predicted", (0.42, 0.36), rotation=45, rotation_mode="anchor", color=INK, fontsize=10, va="top"
        )
        for index, (name, curve) in enumerate(curves.items()):
            color = CURVE_COLORS[index % len(CURVE_COLORS)]
            label = f"{name}  calibration error {curve.calibration_error:.3f}"
            axes.plot(curve.predicted, curve.observed, "o-", color=color, linewidth=1.8, label=label)
            width = np.diff(curve.edges) / (len(curves) + 1)
            bars.bar(curve.edges[:-1] + (index + 1) * width, curve.count, width, color=color)
        axes.set(xlabel="predicted probability", ylabel="share that collides", xlim=(0, 1), ylim=(-0.02, 1.02))
        axes.set_aspect("equal")
        axes.set_title(title, pad=12)
        bars.set(xlabel="predicted probability", ylabel="points", xlim=(0, 1), yscale="log")
        for panel in (axes, bars):
            set_grid(panel, "both")
        figure.legend(frameon=False, loc="outside lower center", ncols=2)
        save_figure(figure, path)
