"""How far the clearances of a motion agree with a known truth, where a camera saw the surface."""

import numpy as np

from splatctrl_cli.config.fixed import CLEARANCE_NEAR, MAP_ALLOWANCE
from splatctrl_cli.evaluate.views import seen_by
from splatctrl_cli.files.spilled_rows import BLOCK
from splatctrl_cli.records import Bool, Float64, FloatRows, RgbdFrame, Stamps

FIGURES = ("num_compared", "median", "p95", "largest", "largest_over", "tolerance", "share_within")


def clearance_agreement(
    clearance: Float64, truth: Float64, is_seen: Bool, median_radius: float
) -> dict[str, float | None]:
    """Clearance (T,) against the truth (T,) [m], over states nearer than 10 cm to a surface that was seen (T,).

    By the names of `FIGURES`: how many states are compared; |clearance - truth| as median, 95 % and largest [m]; the
    largest over-estimate [m]; the share of states within the tolerance [m]. None where no state is compared.
    """
    tolerance = MAP_ALLOWANCE + median_radius
    compared = (truth < CLEARANCE_NEAR) & is_seen & np.isfinite(clearance)
    error = clearance[compared] - truth[compared]
    if not len(error):
        return dict.fromkeys(FIGURES) | {"num_compared": 0, "tolerance": tolerance}
    size = np.abs(error)
    over, share = max(error.max(), 0.0), np.mean(size <= tolerance)
    found = (len(error), np.median(size), np.percentile(size, 95), size.max(), over, tolerance, share)
    return {
        name: value if name == "num_compared" else float(value) for name, value in zip(FIGURES, found, strict=True)
    }


def mark_seen(
    seen: Bool, points_world: FloatRows, stamp_ns: Stamps, frame: RgbdFrame, *, has_clock: bool = True
) -> None:
    """Set `seen` (T,) where a surface point (T, 3) [m], asked for at a stamp (T,), was seen in a frame not later.

    The points are read a block at a time, and only where some were not seen yet.
    """
    for first in range(0, len(seen), BLOCK):
        part = slice(first, first + BLOCK)
        asked = first + np.flatnonzero(~seen[part] & ((stamp_ns[part] >= frame.stamp_ns) | (not has_clock)))
        if len(asked):
            seen[asked] = seen_by(points_world[asked], [frame])


def least(values: Float64) -> float | None:
    """The smallest finite value, None without one."""
    finite = values[np.isfinite(values)]
    return float(finite.min()) if len(finite) else None
