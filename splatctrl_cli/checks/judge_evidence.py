"""What is wrong with a recording, from what one pass over it has left: the same for logs, captures and folders."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.checks.check_arm import motion_findings
from splatctrl_cli.checks.check_exposure import exposure_findings
from splatctrl_cli.checks.check_images import alignment_findings
from splatctrl_cli.checks.check_views import are_far, check_views
from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.checks.finding import CheckReport, Finding, Rate, Severity, needs, note
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.robot.model import RobotModel


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
