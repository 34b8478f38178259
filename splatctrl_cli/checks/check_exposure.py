"""Whether a camera shows one surface alike in all its images and rows: automatic exposure and flicker do not."""

from collections.abc import Sequence

import numpy as np

from splatctrl_cli.calibration.exposure import BandRatios, band_ratios
from splatctrl_cli.checks import limits
from splatctrl_cli.checks.finding import Finding, note
from splatctrl_cli.config.fixed import SCALE_DEPTH
from splatctrl_cli.records import Float64, RgbdFrame, spread
from splatctrl_cli.scene.scale import RecordedDepth


def exposure_findings(frames: Sequence[RgbdFrame]) -> list[Finding]:
    """By camera, the ratio of its brightest to its darkest image of what both show, and of rows within an image."""
    cameras = sorted({frame.camera for frame in frames})
    whole = [frame for frame in frames if frame.depth.shape == frame.color.shape[:2]]
    chosen = [f for c in cameras for f in spread([f for f in whole if f.camera == c], limits.EXPOSURE_FRAMES)]
    depth = RecordedDepth.of(chosen)
    if depth is None:
        return []
    scale = depth.median / SCALE_DEPTH
    is_free = np.ones(len(chosen), np.bool_)
    gains = band_ratios(chosen, scale, is_free, 1).gains(is_free)
    rows = _rows(band_ratios(chosen, scale, is_free, limits.EXPOSURE_BANDS), gains)
    findings = []
    for camera in cameras:
        is_own = [frame.camera == camera for frame in chosen]
        own = gains[is_own, 0]
        ratio = float((own.max(axis=0) / own.min(axis=0)).max()) - 1
        if ratio > limits.EXPOSURE_RATIO:
            what = f"one image shows a surface up to {100 * ratio:.0f} % brighter or more coloured than another"
            remedy = (
                "fix exposure and white balance in its driver; 'reconstruct --refine-exposure' corrects a still scene"
            )
            findings.append(note("exposure", f"camera {camera}", what, remedy, value=round(100 * ratio, 1), unit="%"))
        uneven = float(np.exp(np.ptp(rows[is_own] - np.median(rows[is_own], axis=0), axis=1).max())) - 1
        if uneven > limits.EXPOSURE_UNEVEN:
            what = f"rows of one image differ in exposure by up to {100 * uneven:.0f} %, unlike those of its others"
            remedy = (
                "set the driver's anti-flicker to the mains frequency, or expose for whole periods of the lamp;"
                " 'reconstruct --refine-exposure' has one gain for a whole image and leaves this as it is"
            )
            value = round(100 * uneven, 1)
            findings.append(note("exposure-rows", f"camera {camera}", what, remedy, value=value, unit="%"))
    return findings


def _rows(bands: BandRatios, gains: Float64) -> Float64:
    """Logarithms (N, B) of the brightness of an image's bands of rows, less a parabola; 0 where bands explain little.

    Shadows and poses that are off make bands differ, too, but do not follow the rows; gloss and a lens that is darker
    at its edge change slowly over an image, and the light of a lamp on mains in 10 or 8 ms.
    """
    found = bands.gains(np.ones(bands.num_images, np.bool_))
    logs = np.log(found).mean(axis=2)
    if bands.misfit(found) > limits.EXPOSURE_LEFT * bands.misfit(gains):
        return np.zeros_like(logs)
    curves = np.linalg.qr(np.vander(np.arange(bands.num_bands), 3).astype(np.float64))[0]
    return np.asarray(logs - logs @ curves @ curves.T)
