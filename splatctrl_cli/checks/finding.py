"""Results of `check`: the table of checks, findings, obstacles to later commands."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Any

from splatctrl_cli.records import RgbdFrame


class Severity(StrEnum):
    """Error: a later command fails or errs. Warning: loss or doubt. Note: no fault."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


ORDER = tuple(Severity)  # worst first
LATER = ("reconstruct", "score", "replay")
ALL = ("ingest", *LATER)


@dataclass(frozen=True, kw_only=True)
class Check:
    """One kind of finding: meaning, severities, commands blocked by its error, default remedy."""

    code: str
    severities: tuple[Severity, ...]
    meaning: str
    blocked: tuple[str, ...] = ()
    remedy: str = ""

    @property
    def docs(self) -> str:
        """The row in docs/check.md: code and severity, a bar, meaning."""
        return f"`{self.code}` ({'/'.join(self.severities)}) | {self.meaning}"


_TABLE = """
# code | severities | commands that an error blocks | meaning | what to do, where a finding does not say
damaged | warning |  | part of the file cannot be read | copy the file again; if it stays,
    look at what wrote these messages
remark | note |  | how data was interpreted, or messages that are not read
loss | note |  | topics and frames left out
missing | error | all | depth, CameraInfo or tf that `ingest` needs
refused | error | all | the capture or folder cannot be read as described
gap | warning |  | a topic pauses for over 0.1 s and three median intervals | record fewer topics or to a faster disk;
    what moved meanwhile is unknown
part | note, warning |  | a topic begins over 1 s late or ends over 1 s early; a warning if over a tenth of the
    log is missing | start and stop all drivers with the recorder, or cut the log there
files-apart | warning |  | over 60 s between two files | are they one recording? if not, give each alone
stamp-repeats | warning |  | repeated header stamps | look for a driver that publishes twice, or a topic recorded
    twice
stamp-back | warning |  | header stamps go back | two publishers on one topic, a clock that was set, or a loop
    of a played log: record again
stamp-zero | warning, error | all | header stamps of 0; an error if all | give --stamps log to take the times
    of logging, and let the driver stamp the next recording
clock | note |  | all stamps are shifted alike against the log's clock
clock-offset | warning |  | stamps over 20 ms after or 1 s before their log time, or 0.2 s off most topics, or 60 ms
    off other cameras
clock-drift | warning |  | stamps drift by over 20 ms against the log's clock | synchronise the clocks (chrony, PTP)
    and record again
robot-clock | note, warning |  | the offset of cameras and robot: a warning beyond 40 ms with `--urdf`, else beyond 30
    ms and twice its uncertainty
sampled | note |  | not every image was decoded
undecodable | note, warning, error | all | undecodable images; an error if all | they are left out;
    record a supported encoding, or copy the file again if it is damaged too
encoding | note, warning |  | an encoding that is not read, or changes
image-size | note, warning |  | images of several sizes on one topic | record one size; frames of another than the
    camera's are left out
pairing | warning, error | all | under 95 % of images find a partner; an error if none
rates-differ | note |  | colour and depth differ in number by a factor of 1.5 | record both at one rate; more frames
    show more, and what moves is seen sooner
pair-offset | note |  | depth over 10 ms from its colour image | let the driver synchronise colour and depth: what
    moves is in two places
depth-scale | note, error | all | median depth outside 0.05 to 20 m; a note outside 0.15 to 8 m
depth-share | note, warning |  | under half of the pixels have depth; a warning below a tenth | the rest stays unseen:
    dark or shiny objects, too near, or warped depth with holes
depth-empty | warning, error | later | images without depth; an error if all | is the projector on, and the
    scene within its range?
depth-invalid | note |  | NaN, infinite, negative or no-return pixels
depth-constant | warning |  | many pixels have one largest depth, far behind the others: an undeclared
    no-return code | let the driver write 0 or NaN for no return; as it stands, it is a surface
depth-repeats | warning |  | repeated depth images | look for a driver that publishes its last image
    again; repeated depth is no new evidence, and only depth that was made without noise may repeat
principal-point | warning, error | later | over 15 % of the size off the middle; an error where it fits another image
    size
focal-ratio | warning |  | fx and fy differ by over 5 %
field-of-view | warning |  | outside 20 to 140 degrees, horizontally
uncalibrated | note, warning |  | K is zero | calibrate it, or record the driver's factory values
camera-info-size | error | all | another size than the images | record the CameraInfo of this stream, or name it with
    --camera
camera-info-changes | warning |  | CameraInfo changes | split the log there, or record with one setting
camera-info-two | warning |  | a second K for the same frame and size
distortion | note, warning, error | all | distorted images (note); a wrong number of coefficients (warning); an
    unknown model (error)
tf-gap | warning |  | a moving transform pauses
tf-ends | warning |  | a moving transform ends over 1 s before the last image | record /tf to the end; if it stands
    still, publish it on /tf_static or give --camera-pose
tf-roots | note, error | all | separate trees; an error if cameras are in several
tf-parents | warning |  | a frame with two parents
pose-missing | warning, error | all | images without a pose; an error if all | tf starts late, ends early, or
    has a gap of more than 1 s; if it stands still give --camera-pose
pose-jump | error | later | a camera moves over 0.2 m and ten times its median step in one frame | two publishers of
    one frame, or a localisation that was corrected; reconstruct refuses it
alignment | error | later | edges of depth and colour are over 1.5 % of the width apart, or match another camera's
views-scale | warning, error | later | depths fit only with a factor; a warning at little overlap
views-pose | warning |  | views fit only after a camera moves (by 12 mm or 0.8 deg)
agreement | note, error | later | how far apart views place one surface [mm]; an error beyond 30 mm (3 % of depth
    above 1 m)
views-agreement | error | later | the same for views of one camera
exposure | note |  | a surface's brightness or colour differs by over 5 % between images
exposure-rows | note |  | exposure differs by over 20 % between rows of one image (flicker)
joints | note, error | replay | topics and velocities in use; an error if joints of the robot are missing
joints-nan | warning |  | positions that are not finite | they are left out; look at the driver
joints-degrees | error | replay | positions that no joint can reach in radians
joints-velocity | note, warning |  | missing (note) or zero velocities
joints-still | note |  | no joint moves
joints-limits | warning |  | states beyond the URDF's limits | is it the right URDF, are the joints in its units, or
    were its limits lowered?
end-effector | note, error | replay | logged poses against the robot's kinematics
arm | note, warning |  | measured minus rendered depth of the robot [mm]; a warning beyond 30 mm (mean 25 mm), a scale
    error of 4 %, or a quarter of its pixels on the background
robot-model | warning |  | `--urdf` is another mechanism than the log's
quick | note |  | only the first images were read
"""
_BLOCKED = {"": (), "all": ALL, "later": LATER, "replay": ("replay",)}


def _checks() -> Iterator[Check]:
    for row in re.findall(r"^[a-z].*(?:\n +.*)*", _TABLE, flags=re.MULTILINE):
        code, severities, blocked, meaning, *remedy = (cell.strip() for cell in " ".join(row.split()).split("|"))
        yield Check(
            code=code,
            severities=tuple(Severity(word) for word in severities.split(", ")),
            meaning=meaning,
            blocked=_BLOCKED[blocked],
            remedy="".join(remedy),
        )


CHECKS: Mapping[str, Check] = {check.code: check for check in _checks()}


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One finding: `code` is its entry in `CHECKS`, `where` the topic, camera or joint.

    value: the figure, in `unit`, or None. stamp_ns: first occurrence, or None.
    """

    severity: Severity
    code: str
    where: str
    what: str
    remedy: str = ""
    value: float | None = None
    unit: str = ""
    stamp_ns: int | None = None


def _finding(
    severity: Severity,
    code: str,
    where: str,
    what: str,
    remedy: str | None = None,
    *,
    value: float | None = None,
    unit: str = "",
    stamp_ns: int | None = None,
) -> Finding:
    return Finding(
        severity=severity,
        code=code,
        where=where,
        what=what,
        remedy=CHECKS[code].remedy if remedy is None else remedy,
        value=None if value is None else round(float(value), 6),
        unit=unit,
        stamp_ns=None if stamp_ns is None else int(stamp_ns),
    )


error, warning, note = (partial(_finding, severity) for severity in ORDER)
ERROR, WARNING, NOTE = ORDER


def judge(severity: Severity | None, code: str, where: str, what: str, *remedy: str, **figure: Any) -> list[Finding]:
    """One finding, or none without a severity; `remedy` and `figure` (value, unit, stamp_ns): fields of `Finding`."""
    return [] if severity is None else [_finding(severity, code, where, what, *remedy, **figure)]


@dataclass(frozen=True, kw_only=True)
class Rate:
    """A topic's timing. is_read: by later commands. hz: from the median interval.

    longest_s: interval between stamps. delay_s: median log time minus stamp.
    """

    topic: str
    is_read: bool
    messages: int
    hz: float | None
    longest_s: float | None
    delay_s: float | None


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """A checked recording.

    lacks: missing data by later command, "" for none. frames: reduced views, without colour, of posed cameras.
    """

    path: str
    kind: str
    duration_s: float
    num_messages: int
    start_ns: int | None
    findings: Sequence[Finding]
    rates: Sequence[Rate] = ()
    lacks: Mapping[str, str] = field(default_factory=dict)
    frames: Sequence[RgbdFrame] = field(default=(), repr=False)

    @property
    def unit(self) -> str:
        return "frames and states" if self.kind in {"capture", "image folder"} else "messages"

    @property
    def sorted_findings(self) -> list[Finding]:
        return sorted(self.findings, key=lambda finding: ORDER.index(finding.severity))

    def blockers(self, command: str) -> list[Finding]:
        return [f for f in self.sorted_findings if f.severity is ERROR and command in CHECKS[f.code].blocked]

    def obstacles(self, command: str) -> list[str]:
        """Missing data and errors that block a command; empty if it can start."""
        blocking = (f"{f.where}: {f.what} [{f.code}]" for f in self.blockers(command))
        return [*filter(None, [self.lacks[command]]), *blocking]

    @property
    def counts(self) -> dict[str, int]:
        return {str(s): sum(f.severity is s for f in self.findings) for s in ORDER}

    def seconds(self, finding: Finding) -> float | None:
        """Time [s] of the first occurrence since the recording's start, None if unknown."""
        if finding.stamp_ns is None or self.start_ns is None:
            return None
        return round((finding.stamp_ns - self.start_ns) * 1e-9, 3)

    def as_dict(self) -> Mapping[str, object]:
        return {
            "path": self.path,
            "kind": self.kind,
            "duration_s": self.duration_s,
            "messages": self.num_messages,
            "counts": self.counts,
            "findings": [
                {
                    "severity": str(f.severity),
                    "code": f.code,
                    "where": f.where,
                    "what": f.what,
                    "value": f.value,
                    "unit": f.unit,
                    "at_s": self.seconds(f),
                    "stamp_ns": f.stamp_ns,
                    "remedy": f.remedy,
                }
                for f in self.sorted_findings
            ],
            "rates": [vars(rate) for rate in self.rates],
            "commands": {command: self.obstacles(command) for command in self.lacks},
        }


def find_lacks(*, num_cameras: int, num_frames: int, states_lack: str) -> dict[str, str]:
    """Missing data by later command. states_lack: why states are missing."""
    is_too_short = num_cameras == 1 and 0 < num_frames < 3
    few = "one camera and less than three frames: nothing can be held out; record more views" if is_too_short else ""
    return dict.fromkeys(ALL, "") | {"score": few, "replay": states_lack}


def damage_findings(where: str, notes: Sequence[str]) -> list[Finding]:
    return [
        warning("damaged", where, text if num == 1 else f"{text} ({num} times)", value=num)
        for text, num in Counter(notes).items()
    ]
