"""The shape of what `check` says about a recording, and what each later command would lack."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from splatctrl_cli.io.check_times import Rate
from splatctrl_cli.io.finding import ORDER, Finding, Severity, worst_first
from splatctrl_cli.records import RgbdFrame


@dataclass(frozen=True, kw_only=True)
class Need:
    """A later command, and what keeps this recording from it; empty where it can start."""

    command: str
    lacks: tuple[str, ...]


_LATER = ("reconstruct", "score", "replay")
BLOCKED = {  # commands that refuse a recording with an error of this code
    "agreement": _LATER,
    "pose-jump": _LATER,
    **dict.fromkeys(["depth-scale", "camera-info-size", "refused"], ("ingest", *_LATER)),
    "joints-degrees": ("replay",),
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
        refused = [
            f"{f.where}: {f.code}; {f.remedy}"
            for f in self.findings
            if f.severity is Severity.ERROR and need.command in BLOCKED.get(f.code, ())
        ]
        return tuple(dict.fromkeys([*need.lacks, *refused]))

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


def needs(
    *, lacks: Sequence[str], num_cameras: int, num_frames: int, has_joints: bool, states_lack: str
) -> list[Need]:
    """One line for each later command. lacks: what a reconstruction would; states_lack: why there are no states."""
    scoring = list(lacks)
    if not scoring and num_cameras < 2 and num_frames < 3:
        scoring = ["one camera and less than three frames: nothing can be held out; record more views"]
    driving = [] if has_joints else [states_lack]
    return [
        Need(command="ingest", lacks=tuple(lacks)),
        Need(command="reconstruct", lacks=tuple(lacks)),
        Need(command="score", lacks=tuple(scoring)),
        Need(command="replay", lacks=tuple([*lacks, *driving] if lacks else driving)),
    ]
