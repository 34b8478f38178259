"""What is wrong with a recording, from what one pass over it has left: the same for logs, captures and folders."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.calibration.exposure import BandRatios, band_ratios
from splatctrl_cli.checks import limits
from splatctrl_cli.checks.check_arm import motion_findings
from splatctrl_cli.checks.check_images import alignment_findings
from splatctrl_cli.checks.check_views import are_far, check_views
from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.checks.finding import CheckReport, Finding, Rate, Severity, needs, note
from splatctrl_cli.config.fixed import SCALE_DEPTH
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.records import Float64, RgbdFrame, spread
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.scale import RecordedDepth


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What is kept of a recording, in bounded memory.

    start_ns: None without a clock; num_frames: of the camera that has most. frames: reduced, a few of each camera
    whose poses are known; depth_units: [m] per count by camera, None where depth is stored as floats; motion: of the
    first images. states: joint states to compare, in the model's order where there is one; states_lack: what keeps
    `replay` from them. cut: says that not all was read. is_guessed: the unit of its lengths.
    """

    path: Path
    kind: str
    duration_s: float
    num_messages: int
    start_ns: int | None
    num_cameras: int
    num_frames: int
    rates: Sequence[Rate]
    frames: Sequence[RgbdFrame]
    depth_units: Mapping[str, float | None]
    motion: ImageMotion
    states: StateColumns | None
    states_lack: str
    cut: str = ""
    is_guessed: bool = False


def judged(evidence: Evidence, found: Sequence[Finding], model: RobotModel | None) -> CheckReport:
    """With what was found on the way, and what the frames and states say of each other."""
    findings = [*found, *alignment_findings(evidence.frames)]
    frames, is_still = usable_frames(evidence.frames, findings), evidence.start_ns is None
    is_sure = not is_still or not (evidence.is_guessed or are_far(frames))
    views = check_views(frames, evidence.depth_units, is_sure=is_sure)
    findings += views.findings
    findings += exposure_findings(views.corrected)
    if evidence.states is not None and not any(finding.code == "joints-degrees" for finding in findings):
        findings += motion_findings(views.corrected, evidence.motion, evidence.states, model)
    findings += [note("quick", evidence.path.name, evidence.cut)] if evidence.cut else []
    return CheckReport(
        path=str(evidence.path),
        kind=evidence.kind,
        duration_s=evidence.duration_s,
        num_messages=evidence.num_messages,
        start_ns=evidence.start_ns,
        findings=findings,
        rates=evidence.rates,
        needs=needs(
            num_cameras=evidence.num_cameras, num_frames=evidence.num_frames, states_lack=evidence.states_lack
        ),
        frames=views.scaled,
    )


def usable_frames(frames: Sequence[RgbdFrame], findings: Sequence[Finding]) -> list[RgbdFrame]:
    """The frames of cameras whose own lens and depth are right: of others a comparison would blame the pose."""
    wrong = {f.where for f in findings if f.severity is Severity.ERROR and f.code in {"alignment", "principal-point"}}
    return [frame for frame in frames if f"camera {frame.camera}" not in wrong]


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
