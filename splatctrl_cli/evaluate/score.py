"""Scores of rendered against recorded views, over all pixels and those seen in training."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import IN_FRONT
from splatctrl_cli.errors import NotEvaluableError, refuse_if
from splatctrl_cli.evaluate.metrics import (
    BAD_SHARE,
    DECIBELS,
    DESCRIBES,
    GOOD_SHARE,
    SIMILARITY,
    Better,
    Scale,
)
from splatctrl_cli.evaluate.views import depth_errors, psnr, published_ssim, ssim_map
from splatctrl_cli.records import Bool, Float32, Label, RgbdFrame, SplatSet
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
CORRECTED = "_corrected"  # of a figure of a view whose pose, exposure or depth was
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
    training, and of the mask rule. The published SSIM has grey `fill` outside the mask; without a mask, it exists
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
        found = {
            "psnr": psnr(rendered, photo, region),
            "ssim": float(similarity[region].mean()) if region.any() else math.nan,
            **errors,
            "depth_coverage": errors["depth_pixels"] / num_reference if num_reference else math.nan,
            "in_front": share_in_front(depth, frame.depth, region),
        }
        figures |= {f"{figure}_{name}": value for figure, value in found.items()}
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
    """Share of masked pixels with both depths whose `depth` is nearer by more than IN_FRONT.

    nan without such pixels.
    """
    both = mask & (depth > 0) & (reference > 0)
    return float(np.mean(depth[both] < reference[both] - IN_FRONT)) if both.any() else math.nan


def metric_scales() -> dict[str, Scale]:
    """Scales of all names of `total_score`, for comparing runs; a mask's occur only with one."""
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
