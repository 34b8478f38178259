"""The shape of what `check` says about a recording, and what each later command would lack."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from splatctrl_cli.checks.check_times import Rate
from splatctrl_cli.checks.finding import ORDER, Finding, Severity, warning, worst_first
from splatctrl_cli.records import RgbdFrame


@dataclass(frozen=True, kw_only=True)
class Need:
    """A later command, and what keeps this recording from it; empty where it can start."""

    command: str
    lacks: tuple[str, ...]


_LATER = ("reconstruct", "score", "replay")
_ALL = ("ingest", *_LATER)
BLOCKED = {  # commands that refuse a recording with an error of this code, or whose result would be wrong
    **dict.fromkeys(["agreement", "pose-jump", "views-scale", "depth-empty", "alignment", "principal-point"], _LATER),
    **dict.fromkeys(["missing", "refused", "pairing", "pose-missing", "undecodable"], _ALL),
    **dict.fromkeys(["depth-scale", "camera-info-size", "distortion", "stamp-zero", "tf-roots"], _ALL),
    **dict.fromkeys(["joints", "joints-degrees", "end-effector"], ("replay",)),
}


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """A checked recording: findings, rates by topic, needs by command; frames: reduced views, without colour, of
    every camera that has poses.
    """

    path: str
    kind: str
    duration_s: float
    num_messages: int
    start_ns: int | None
    findings: Sequence[Finding]
    rates: Sequence[Rate] = ()
    needs: Sequence[Need] = ()
    frames: Sequence[RgbdFrame] = field(default=(), repr=False)

    @property
    def unit(self) -> str:
        """What `num_messages` counts."""
        return "frames and states" if self.kind in {"capture", "image folder"} else "messages"

    @property
    def sorted_findings(self) -> list[Finding]:
        """Worst first."""
        return worst_first(list(self.findings))

    def lacks(self, need: Need) -> tuple[str, ...]:
        """What keeps a command from this recording, the errors among the findings included."""
        return (*need.lacks, *(f"{f.where}: {f.what} [{f.code}]" for f in self.refusing(need)))

    def refusing(self, need: Need) -> list[Finding]:
        """The errors among the findings that keep a command from this recording."""
        errors = [f for f in self.sorted_findings if f.severity is Severity.ERROR]
        return [f for f in errors if need.command in BLOCKED.get(f.code, ())]

    @property
    def counts(self) -> dict[str, int]:
        """Findings by severity."""
        return {str(s): sum(f.severity is s for f in self.findings) for s in ORDER}

    def seconds(self, finding: Finding) -> float | None:
        """When a finding was first met, from the start of the recording."""
        if finding.stamp_ns is None or self.start_ns is None:
            return None
        return round((finding.stamp_ns - self.start_ns) * 1e-9, 3)

    def as_dict(self) -> Mapping[str, object]:
        """Plain values for JSON."""
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
            "commands": {need.command: list(self.lacks(need)) for need in self.needs},
        }


def needs(*, num_cameras: int, num_frames: int, states_lack: str) -> list[Need]:
    """One for each later command, errors among the findings apart. states_lack: why there are no joint states."""
    scoring: tuple[str, ...] = ()
    if num_cameras == 1 and 0 < num_frames < 3:
        scoring = ("one camera and less than three frames: nothing can be held out; record more views",)
    return [
        Need(command="ingest", lacks=()),
        Need(command="reconstruct", lacks=()),
        Need(command="score", lacks=scoring),
        Need(command="replay", lacks=(states_lack,) if states_lack else ()),
    ]


def damage_findings(where: str, notes: Sequence[str]) -> list[Finding]:
    """One for each kind of damage, with how often it is met."""
    remedy = "copy the file again; if it stays, look at what wrote these messages"
    return [
        warning("damaged", where, text if num == 1 else f"{text} ({num} times)", remedy, value=num)
        for text, num in Counter(notes).items()
    ]


def usable_frames(frames: Sequence[RgbdFrame], findings: Sequence[Finding]) -> list[RgbdFrame]:
    """The frames of cameras whose own lens and depth are right: of others a comparison would blame the pose."""
    wrong = {f.where for f in findings if f.severity is Severity.ERROR and f.code in {"alignment", "principal-point"}}
    return [frame for frame in frames if f"camera {frame.camera}" not in wrong]
