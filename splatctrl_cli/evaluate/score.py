"""Scores of rendered against recorded views, their changes and verdict.

A score covers all pixels and, separately, pixels seen in training. A report is ``score.json``: ``metrics`` by flat
name, ``protocol``, ``warnings``, and ``views`` or, by scan, ``results``.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import IN_FRONT, OTHER_VIEW_CLEARLY, SAME_PLACE_DEGREES, SAME_PLACE_METRES
from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_if
from splatctrl_cli.evaluate.held_out_depth import CLOUD_SCALES
from splatctrl_cli.evaluate.metrics import (
    BAD_SHARE,
    DECIBELS,
    DESCRIBES,
    FAULTS,
    GOOD_SHARE,
    SIMILARITY,
    Better,
    Scale,
)
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, gate_reasons, note, plural, verdict_of
from splatctrl_cli.evaluate.views import View, depth_errors, psnr, published_ssim, ssim_map
from splatctrl_cli.geometry import compare_poses
from splatctrl_cli.records import Bool, Float32, Float64, Label, RgbdFrame, SplatSet
from splatctrl_cli.voxels import OccupancyGrid

PROTOCOL = {
    "average": "mean over views of each view's own figure; a view without a pixel of the region is left out",
    "all": "every pixel of the view that its lens saw",
    "seen": "pixels whose reference depth, back-projected, lies within 2 cm of a depth that the newest frame of some "
    "training camera measured (any training frame where the recording has no clock)",
    "mask": "only pixels of the region enter a sum or a share; nothing is zero-filled",
    "psnr": "-10 log10(mean squared error over pixels and RGB), colours in [0, 1], render clipped to [0, 1]",
    "ssim": "11x11 Gaussian window, sigma 1.5, C1 = 0.01^2, C2 = 0.03^2, border mirrored, mean of the map over "
    "pixels of the region and RGB",
    "depth": "absolute difference of the normalised depth (blended depth / accumulated opacity, where that opacity "
    "is at least 0.5) and the reference depth, over pixels of the region that have both [m]; depth_coverage is their "
    "share of the region's pixels that have a reference depth",
    "in_front": "share of those pixels whose normalised depth is nearer than the reference by more than 3 cm",
    "masked": "the pixels that the mask rule selects; its share of the view is mask_share",
    "ssim_published": "of the whole view with render and photo set to one colour outside the mask, as scikit-image's "
    "default has it: 7x7 box, sample moments, data range 2, border of 3 pixels left out; without a mask as 3D "
    "Gaussian splatting has it: as ssim, but zeros beyond the border",
    "corrected": "the same figures with the view's pose or exposure corrected by depth and colour of the training "
    "views, and its depth freed of its camera's bend, where theirs were; the render takes no part in it",
    "free_mass": "share of the mass of the final splats (opacity times radius squared, the robot's left out) whose "
    "centre lies in a voxel that was observed free; null where the scene has no occupancy grid",
}


REGION = {
    "psnr": DECIBELS,
    "ssim": SIMILARITY,
    "depth_pixels": DESCRIBES,
    **dict.fromkeys(
        ("depth_median", "depth_mean", "depth_p90"),
        Scale(unit="m", better=Better.LOWER, absolute=5e-4, relative=0.02),
    ),
    **dict.fromkeys(("depth_within_1cm", "depth_within_2cm", "depth_coverage"), GOOD_SHARE),
    "in_front": BAD_SHARE,
}  # of the pixels of a region
REGIONS = ("seen", "all", "masked")
CORRECTED = "_corrected"  # ends the name of a view's figure with corrected pose, exposure or depth
CORRECTABLE = tuple(f"{name}_{region}" for name in REGION if name != "depth_pixels" for region in REGIONS)


def score_view(
    *,
    color: Float32,
    depth: Float32,
    frame: RgbdFrame,
    seen: Bool,
    mask: Bool | None = None,
    fill: float = 0.0,
    is_zero_padded: bool = False,
) -> dict[str, float]:
    """Score a rendering against `frame`, by `PROTOCOL`.

    Returns figures by flat name (``psnr_seen`` [dB], ``depth_median_all`` [m]), nan for an empty region. color (H, W,
    3) in [0, 1]; depth (H, W) [m], normalised by accumulated opacity, 0 = none. seen, mask (H, W): pixels seen in
    training, pixels of the mask rule. The published SSIM has grey `fill` outside the mask; without a mask, it exists
    only if is_zero_padded. Invalid pixels of `frame` are in no region.
    """
    rendered = np.clip(color.astype(np.float64), 0.0, 1.0)
    photo = frame.color.astype(np.float64) / 255.0
    valid = np.ones(frame.depth.shape, dtype=np.bool_) if frame.valid is None else frame.valid
    rendered[~valid] = photo[~valid]  # so that windows across the border see no difference there
    similarity = ssim_map(rendered, photo).mean(axis=-1)
    figures = {"valid_share": float(np.mean(frame.depth > 0)), "seen_share": float((seen & valid).mean())}
    if mask is not None:
        figures["mask_share"] = float((mask & valid).mean())
        figures["ssim_published"] = published_ssim(rendered, photo, mask, fill)
    elif is_zero_padded:
        figures["ssim_published"] = float(ssim_map(rendered, photo, is_zero_padded=True).mean())
    for name, pixels in {"seen": seen, "all": valid, "masked": mask}.items():
        if pixels is None:
            continue
        region = pixels & valid
        errors = depth_errors(depth, frame.depth, region)
        num_reference = int(np.count_nonzero(region & (frame.depth > 0)))
        scores = {
            "psnr": psnr(rendered, photo, region),
            "ssim": float(similarity[region].mean()) if region.any() else math.nan,
            **errors,
            "depth_coverage": errors["depth_pixels"] / num_reference if num_reference else math.nan,
            "in_front": share_in_front(depth, frame.depth, region),
        }
        figures |= {f"{figure}_{name}": value for figure, value in scores.items()}
    return figures


def free_mass(splats: SplatSet, grid: OccupancyGrid, free_below: float) -> float:
    """Share of the splats' mass with centres in voxels observed free; nan without mass.

    Mass is opacity times squared radius. The robot's splats are left out. free_below: occupancy below which a seen
    voxel is free.
    """
    mass = np.where(splats.labels == Label.ROBOT, 0.0, splats.opacities * splats.radii.astype(np.float64) ** 2)
    is_free = (grid.num_updates > 0) & (grid.log_odds < math.log(free_below / (1.0 - free_below)))
    cell = np.floor((splats.centers - grid.origin) / grid.voxel + 0.5)
    is_inside = np.all((cell >= 0) & (cell < is_free.shape), axis=1)
    i, j, k = np.where(is_inside[:, None], cell, 0).astype(np.int64).T
    return float(mass[is_inside & is_free[i, j, k]].sum() / mass.sum()) if mass.sum() > 0 else math.nan


def share_in_front(depth: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool) -> float:
    """Share of masked pixels whose `depth` is nearer than `reference` by more than IN_FRONT.

    Only pixels with both depths count; nan without any.
    """
    both = mask & (depth > 0) & (reference > 0)
    return float(np.mean(depth[both] < reference[both] - IN_FRONT)) if both.any() else math.nan


def metric_scales() -> dict[str, Scale]:
    """Scales of all figures of `total_score`, for comparing runs; some exist only with a mask."""
    of_regions = {f"{name}_{region}": scale for region in REGIONS for name, scale in REGION.items()}
    return {
        **dict.fromkeys(("num_views", "valid_share", "seen_share", "mask_share"), DESCRIBES),
        "ssim_published": SIMILARITY,
        **of_regions,
        **{f"{name}{CORRECTED}": of_regions[name] for name in CORRECTABLE},
    }


def total_score(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Each figure's mean over views that have it, or nan. Raises NotEvaluableError without a view."""
    refuse_if(not rows, "no view was scored: expected at least one, got 0", error=NotEvaluableError)
    totals: dict[str, float] = {"num_views": len(rows)}
    for name in rows[0]:
        values = [row[name] for row in rows if not math.isnan(row[name])]
        totals[name] = float(np.mean(values)) if values else math.nan
    return totals


def as_json(figures: dict[str, float]) -> dict[str, Any]:
    """The figures, None if not finite."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


PREFIX = "change_"
SUMS = ("num_views", "num_skipped", "num_warnings", "num_points", "num_reference")
AVERAGING = "mean over the views"
SCALES = {
    **metric_scales(),
    **CLOUD_SCALES,
    "free_mass": BAD_SHARE,
    "num_skipped": DESCRIBES,
    "num_warnings": FAULTS,
    "num_scans": DESCRIBES,
}
NAMES = tuple(SCALES)
NAMES_WITH_CHANGES = (*NAMES, *(PREFIX + name for name in NAMES))  # since a baseline


def read_baseline(path: Path) -> dict[str, Any]:
    """An earlier score's report. Raises InputError for another file."""
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(earlier["metrics"], dict) and isinstance(earlier["protocol"], dict):
            return dict(earlier)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError):
        pass
    raise InputError(f"{path}: expected the score.json of an earlier score, got another file")


def changes(report: Mapping[str, Any], path: Path) -> dict[str, float | None]:
    """New minus old figures, None if either is missing. Raises InputError if not comparable."""
    earlier = read_baseline(path)
    now, then = ({**one["protocol"], "scans": one.get("scans")} for one in (report, earlier))
    for name in ("name", "split", "mask_rule", "resolution", "averaging", "scans"):
        refuse_if(
            now.get(name) != then.get(name),
            f"{path}: not comparable: {name}: expected {now.get(name)}, got {then.get(name)}",
            remedy="score the baseline anew, in the same way",
        )
    old: Mapping[str, Any] = earlier["metrics"]
    return {
        PREFIX + name: value - old[name] if value is not None and isinstance(old.get(name), int | float) else None
        for name, value in report["metrics"].items()
    }


def report_of_scans(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Report of several scans: means, sums of `SUMS`, None for figures missing in one."""
    each, scans = list(results.values()), list(results)
    metrics = {
        name: (sum_of if name in SUMS else mean_of)([one["metrics"].get(name) for one in each])
        for name in each[0]["metrics"]
    }
    protocols = [result["protocol"] for result in each]
    warnings = [f"{scan}: {line}" for scan, result in results.items() for line in result["warnings"]]
    return {
        "scans": scans,
        "protocol": _common(protocols) | {"averaging": f"{AVERAGING} of a scan, then over the scans"},
        "metrics": metrics | {"num_scans": len(results)},
        "warnings": [*warnings, *other_scans(protocols[0], scans)],
        "results": dict(results),
    }


def sum_of(values: Sequence[float | None]) -> float | None:
    """The sum; None if any value is missing."""
    known = [value for value in values if value is not None]
    return sum(known) if len(known) == len(values) else None


def mean_of(values: Sequence[float | None]) -> float | None:
    total = sum_of(values)
    return None if total is None else total / len(values)


def _common(protocols: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The scans' common protocol; differing values are joined."""
    first = protocols[0]
    common = {}
    for name, value in first.items():
        others = list(dict.fromkeys(str(protocol[name]) for protocol in protocols))
        common[name] = value if len(others) == 1 else " | ".join(others)
    sizes = [size for protocol in protocols for size in protocol["resolution"]]
    return common | {"resolution": sorted(set(sizes)), "background": first["background"]}


def other_scans(protocol: Mapping[str, Any], scans: Sequence[str]) -> list[str]:
    """Warning of scans that differ from the published mean's."""
    published = protocol["published_scans"]
    missing = [number for number in published or () if f"scan{number}" not in scans]
    others = [name for name in scans if name not in {f"scan{number}" for number in published or ()}]
    if not published or not (missing or others):
        return []
    parts = [
        *([f"lacks scans {', '.join(map(str, missing))}"] if missing else []),
        *([f"has {', '.join(others)} more"] if others else []),
    ]
    return [f"{protocol['name']}: this mean {' and '.join(parts)}; the published one is of {len(published)} scans"]


def score_verdict(report: Mapping[str, Any], require: Sequence[str], *, is_damaged: bool) -> Verdict:
    metrics, counts = report["metrics"], counts_of(report)
    num_views, num_scans = metrics["num_views"], metrics.get("num_scans")
    compared = Reason(
        criterion="views",
        outcome=Outcome.PASSED if num_views else Outcome.NOT_EVALUABLE,
        sentence=f"{plural(num_views, 'view')} compared",
        value=float(num_views),
        threshold=1.0,
        count=int(num_views),
    )
    notes = [note(criterion="score", sentence=line) for line in report["warnings"]]
    return verdict_of(
        "score",
        [compared, *notes, *gate_reasons(require, dict.fromkeys(NAMES_WITH_CHANGES, None) | metrics, counts)],
        scope=plural(num_views, "view") + ("" if num_scans is None else f" of {plural(num_scans, 'scan')}"),
        is_damaged=is_damaged,
        counts=counts,
    )


def counts_of(report: Mapping[str, Any]) -> dict[str, int]:
    metrics = report["metrics"]
    each = [report] if "views" in report else list(report["results"].values())
    views = [view for one in each for view in one["views"]]
    num_views = int(metrics["num_views"])
    counts = {}
    for name in metrics:
        figure = name.removeprefix(PREFIX)
        counts[name] = sum(view[figure] is not None for view in views) if figure in views[0] else num_views
    return counts


THUMBNAIL = (16, 12)  # pixels


@dataclass(kw_only=True)
class Doubts:
    """Collected oddities of views: inverted masks, training views, wrong poses.

    is_still: a static scene; may_train: training views are scored on purpose.
    """

    is_still: bool
    may_train: bool = False
    mask_rule: str = "none"
    _thumbnails: list[tuple[str, Float64, Float64]] = field(default_factory=list)
    _masks: list[str] = field(default_factory=list)
    _twins: list[str] = field(default_factory=list)

    def look(self, view: View, render: NDArray[np.floating], mask: Bool | None) -> None:
        """Check a view, its render (H, W, 3) in [0, 1] and mask (H, W).

        Raises InputError for an empty mask.
        """
        if mask is not None and not mask.any():
            raise InputError(
                f"{view.name}: mask rule '{self.mask_rule}': expected pixels to score, got none of {mask.size}",
                remedy="the masks have to be this scan's, 255 on the object",
            )
        if mask is not None and self.mask_rule == "object mask":
            self._masks += [f"{view.name} {doubt}"] if (doubt := _mask_doubt(mask)) else []
        if not self.is_still:
            return
        self._twins += [] if self.may_train else _twin(view)
        photo, drawn = _thumbnail(view.frame.color / 255.0), _thumbnail(np.clip(render, 0.0, 1.0))
        self._thumbnails.append((view.name, photo, drawn))

    def lines(self) -> list[str]:
        lines = []
        if self._masks:
            lines.append(
                f"{self._masks[0]}{_and_more(self._masks)}: is the mask turned inside out? it has to be 255 on the"
                " object and 0 around it"
            )
        if self._twins:
            lines.append(
                f"{self._twins[0]}{_and_more(self._twins)}: a view that trained says nothing about others; is a view"
                " there twice?"
            )
        if strangers := _strangers(self._thumbnails):
            lines.append(
                f"{strangers[0]}{_and_more(strangers)}: do the cameras belong to these images, and in this order?"
            )
        return lines


def _and_more(lines: Sequence[str]) -> str:
    return "" if len(lines) == 1 else f" (and {len(lines) - 1} more)"


def _mask_doubt(mask: Bool) -> str:
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    at_border, share = float(border.mean()), float(mask.mean())
    if at_border > 0.5 and at_border >= share:
        return f"has its mask on {100 * at_border:.0f}% of the image's border and {100 * share:.0f}% of the image"
    return ""


def _twin(view: View) -> list[str]:
    for other in view.training:
        metres, degrees = compare_poses(view.frame.T_world_camera, other.T_world_camera)
        if metres <= SAME_PLACE_METRES and degrees <= SAME_PLACE_DEGREES:
            return [f"{view.name} stands {1e3 * metres:.1f} mm and {degrees:.2f} degrees from a training view"]
    return []


def _thumbnail(image: NDArray[np.floating]) -> Float64:
    small = cv2.resize(np.asarray(image, np.float32), THUMBNAIL, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float64).ravel()


def _strangers(thumbnails: Sequence[tuple[str, Float64, Float64]]) -> list[str]:
    """Views whose photo is clearly nearer another view's render."""
    if len(thumbnails) < 2:
        return []
    names, photos, renders = zip(*thumbnails, strict=True)
    x, y = np.stack(photos), np.stack(renders)
    squared = np.square(x).sum(axis=1)[:, None] + np.square(y).sum(axis=1) - 2 * x @ y.T
    decibels = -10 * np.log10(np.maximum(squared / x.shape[1], 1e-8))
    own, best = np.diag(decibels), decibels.argmax(axis=1)
    size = "{}x{}".format(*THUMBNAIL)
    return [
        f"{name}'s photo is nearer the render of {names[j]} ({decibels[i, j]:.1f} dB at {size}) than its own"
        f" ({own[i]:.1f} dB)"
        for i, (name, j) in enumerate(zip(names, best, strict=True))
        if decibels[i, j] > own[i] + OTHER_VIEW_CLEARLY
    ]
