"""What ``sdf-bake`` says of a field: the summary, ``field.json``, the figures that a gate can name, the pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import table
from splatctrl_cli.cli.field_truth import FIELDS
from splatctrl_cli.evaluate import field_accuracy
from splatctrl_cli.evaluate.field_accuracy import FieldAccuracy, band_name
from splatctrl_cli.evaluate.gates import gate_reasons
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, noted, verdict_of
from splatctrl_cli.field.incremental import Changes
from splatctrl_cli.field.layout import LOSS
from splatctrl_cli.field.report import GridStatistics
from splatctrl_cli.records import DistanceGrid
from splatctrl_cli.report.field_pictures import gradient_picture, probability_picture, slices_picture
from splatctrl_cli.report.reliability import Reliability, reliability_picture

SUMMARY_METRICS = (
    *("num_splats", "num_splats_left_out", "num_cells", "voxel", "length_scale", "median_radius", "median_spacing"),
    *("never_seen_share", "over_estimating_share", "num_warnings"),
)
FAR = 1.0  # [m] a grid whose every cell is farther from the splats than this is warned about


@dataclass(frozen=True, kw_only=True)
class FieldReport:
    """A baked grid with its statistics and the warnings; accuracy: plain values, by what it was compared with;
    reliability: of each form of the probability, by the truth.
    """

    grid: "DistanceGrid"
    statistics: "GridStatistics"
    warnings: tuple[str, ...]
    changes: "Changes | None" = None
    accuracy: Mapping[str, Any] | None = None
    reliability: "Mapping[str, Reliability]" = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as written to ``field.json``: the grid's header and place first."""
        grid = self.grid
        place = {"shape": grid.channels["sdf"].shape, "first_cell": grid.origin, "voxel": grid.voxel}
        update = None if self.changes is None else _update(self.changes)
        return {
            **grid.header,
            **place,
            "channels": list(grid.channels),
            "statistics": self.statistics.as_dict(),
            "warnings": self.warnings,
            **({} if update is None else {"update": update}),
            **({} if not self.accuracy else {"accuracy": self.accuracy}),
        }

    def _over_estimating_share(self) -> float | None:
        """Of the cells where the kernel field of sdf, alone, exceeds the exact distance; None without one."""
        counts, name = self.grid.header["kernel_counts"], {"safe": "se", "safe_gpdf": "gpdf"}
        assert isinstance(counts, dict)
        distance = str(self.grid.header["distance"])
        count = counts.get(f"{name.get(distance, distance)}_over_estimates")
        return None if count is None else count / self.statistics.num_cells

    def summary(self) -> dict[str, Any]:
        """What is printed, and what --json has beside the accuracy."""
        header, used = self.grid.header, self.grid.header["splats_used"]
        health, given = header["health"], header["splats_given"]
        assert isinstance(used, dict) and isinstance(health, dict) and isinstance(given, dict)
        summary = {
            "num_splats": sum(used.values()),
            "num_splats_left_out": sum(given.values()) - sum(used.values()),
            "shape": list(self.grid.channels["sdf"].shape),
            "num_cells": self.statistics.num_cells,
            "voxel": self.grid.voxel,
            "distance": header["distance"],
            "length_scale": header["length_scale"],
            "median_radius": health["radius"],
            "median_spacing": health["spacing"],
            "never_seen_share": self.statistics.never_seen_share,
            "over_estimating_share": self._over_estimating_share(),
            "num_warnings": len(self.warnings),
        }
        if self.changes is not None:
            summary["blocks_baked"] = f"{self.changes.num_baked} of {self.changes.num_blocks}"
        return summary


def summary_lines(summary: Mapping[str, Any]) -> list[str]:
    """The summary as a table."""
    return table(("field", ""), [(name.replace("_", " "), _shown(value)) for name, value in summary.items()])


def warnings_of(header: Mapping[str, Any], statistics: "GridStatistics") -> tuple[str, ...]:
    """Those on the splats' health, and on a box that no splat is near."""
    found = list(header["health"]["warnings"])
    if statistics.lowest is not None and statistics.lowest > FAR:
        found.append(f"the box holds no splat: the nearest is {statistics.lowest:.3g} m from every cell; check --box")
    return tuple(found)


def bake_verdict(
    report: FieldReport,
    max_loss: float,
    require: Sequence[str],
    figures: Mapping[str, float | None],
    *,
    has_occupancy: bool,
) -> "Verdict":
    """The verdict on a field: what its cells may lose [m], that a camera saw some of it, and each ``--require``.

    has_occupancy: whether it is known what cameras saw.
    """
    summary = report.summary()
    num_cells, unseen, loss = summary["num_cells"], summary["never_seen_share"], LOSS * summary["voxel"]
    reasons = [
        Reason(
            criterion="loss",
            outcome=Outcome.PASSED,
            sentence=f"cells read at most {1e3 * loss:.1f} mm too little of the distance to the splats",
            value=loss,
            threshold=max_loss,
            unit="m",
            count=num_cells,
        )
    ]
    if has_occupancy and unseen == 1:
        reasons.append(
            Reason(
                criterion="known space",
                outcome=Outcome.NOT_EVALUABLE,
                sentence="no cell of the grid was ever seen by a camera",
                value=unseen,
                threshold=1.0,
                remedy="give a --box that the cameras saw",
                count=num_cells,
            )
        )
    cells, counts = " x ".join(map(str, summary["shape"])), counts_of(figures)
    return verdict_of(
        "sdf-bake",
        [*reasons, *(noted("field", text) for text in report.warnings), *gate_reasons(require, figures, counts)],
        scope=f"{cells} cells of {summary['voxel']:g} m, {summary['num_splats']} splats",
        counts=counts,
    )


def metric_names(*, with_truth: bool) -> tuple[str, ...]:
    """The names of `metrics`, known before anything is baked."""
    return (*SUMMARY_METRICS, *(field_accuracy.metric_names(FIELDS) if with_truth else ()))


def metrics(summary: Mapping[str, Any], accuracy: Mapping[str, Any] | None) -> dict[str, float | None]:
    """Numbers a gate can name: those of the summary, ``seen.hard.0_2cm.rmse`` and so on, ``over_estimate.*``.

    accuracy: of the comparison with the truth, None without one.
    """
    figures: dict[str, float | None] = {name: summary[name] for name in SUMMARY_METRICS}
    if accuracy is None:
        return figures
    for where in ("everywhere", "seen"):
        for name, bands in accuracy[where].items():
            for band in bands:
                place = f"{where}.{name}.{band_name(band['lower'], band['upper'])}"
                figures |= {f"{place}.{key}": band[key] for key in band if key not in {"lower", "upper"}}
    return figures | {f"over_estimate.{name}": value for name, value in accuracy["over_estimate"].items()}


def counts_of(figures: Mapping[str, float | None]) -> dict[str, int]:
    """The cells that each of `metrics` rests on: those of its band or of the over-estimate, else all."""
    num_cells = int(figures["num_cells"] or 0)
    counts = {}
    for name in figures:
        place, _, figure = name.rpartition(".")
        is_told = figure == "count" or f"{place}.count" not in figures
        counts[name] = num_cells if is_told else int(figures[f"{place}.count"] or 0)
    return counts


def reference_lines(accuracy: "FieldAccuracy", what: str) -> list[str]:
    """A short table of the errors against `what`, everywhere."""
    header = ("field", f"from {what} cm", "count", "mean mm", "rmse mm", "95 % mm", "max mm")
    rows: list[Sequence[object]] = []
    for name, bands in accuracy.everywhere.items():
        for band in bands:
            values = (band.mean, band.rmse, band.over_95, band.over_max)
            shown = ["-" if value is None else f"{value * 1e3:.1f}" for value in values]
            rows.append((name, f"{band.lower * 100:g}-{band.upper * 100:g}", band.count, *shown))
    return table(header, rows)


def write_pictures(folder: Path, report: FieldReport, point: Sequence[float]) -> None:
    """Slices through `point` [m], the gradient, and what else the grid has, into ``folder/report``."""
    pictures = folder / "report"
    pictures.mkdir()
    grid = report.grid
    slices_picture(pictures / "slices.png", grid, point)
    lengths = report.statistics.gradient
    if lengths is not None:
        gradient_picture(pictures / "gradient.png", grid, lengths.histogram, lengths.bin_width, point)
    if "probability" in grid.channels:
        probability_picture(pictures / "probability.png", grid, point)
    if report.reliability:
        reliability_picture(pictures / "reliability.png", report.reliability, "Probability against the truth")


def _update(changes: "Changes") -> dict[str, Any]:
    said = {"blocks_baked": changes.num_baked, "blocks": changes.num_blocks}
    return said | ({"why_all": changes.reason} if changes.reason else {})


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    return " x ".join(map(str, value)) if isinstance(value, list) else str(value)
