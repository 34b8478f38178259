"""Whether a camera shows one surface alike in all its images: automatic exposure and white balance do not."""

from collections.abc import Sequence

from splatctrl_cli.calibration.exposure import exposure_gains
from splatctrl_cli.checks import limits
from splatctrl_cli.checks.finding import Finding, note
from splatctrl_cli.config.fixed import SCALE_DEPTH
from splatctrl_cli.records import RgbdFrame, spread
from splatctrl_cli.scene.scale import RecordedDepth


def exposure_findings(frames: Sequence[RgbdFrame]) -> list[Finding]:
    """By camera, the ratio of its brightest to its darkest image of what both show, where it is beyond chance."""
    cameras = sorted({frame.camera for frame in frames})
    whole = [frame for frame in frames if frame.depth.shape == frame.color.shape[:2]]
    chosen = [f for c in cameras for f in spread([f for f in whole if f.camera == c], limits.EXPOSURE_FRAMES)]
    depth = RecordedDepth.of(chosen)
    if depth is None:
        return []
    gains = exposure_gains(chosen, depth.median / SCALE_DEPTH)
    findings = []
    for camera in cameras:
        own = gains[[frame.camera == camera for frame in chosen]]
        ratio = float((own.max(axis=0) / own.min(axis=0)).max()) - 1
        if ratio > limits.EXPOSURE_RATIO:
            what = f"one image shows a surface up to {100 * ratio:.0f} % brighter or more coloured than another"
            remedy = (
                "fix exposure and white balance in its driver; 'reconstruct --refine-exposure' corrects a still scene"
            )
            findings.append(note("exposure", f"camera {camera}", what, remedy, value=round(100 * ratio, 1), unit="%"))
    return findings
