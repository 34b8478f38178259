"""What the criteria of a replay's verdict look at, and how they put it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import SLIGHTLY_UNDER
from splatctrl_cli.control.events import Event, EventKind
from splatctrl_cli.jobs.replay.inputs import LoggedStates
from splatctrl_cli.jobs.replay.metrics import Metrics
from splatctrl_cli.jobs.replay.request import ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replay.result import Replay
from splatctrl_cli.records import Float64

SAFE, MARGIN, CONTACT, LIMITS, CONTROL = "safe", "margin broken", "contact", "limits broken", "controller failed"
BROKEN, UNKNOWN = "failed", "*not evaluable*"  # as the table of the criteria has them
SLOW = "log joint states more often"


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What the criteria look at."""

    request: ReplayRequest
    inputs: ReplayInputs
    logged: LoggedStates
    replay: Replay
    metrics: Metrics

    @property
    def threshold(self) -> float:
        """The margin [m], less what solver and rounding may leave."""
        return self.replay.margin - SLIGHTLY_UNDER

    @property
    def num_states(self) -> int:
        """That were judged."""
        return len(self.replay.audit.stamp_ns)

    @property
    def past_end_s(self) -> float:
        """How long a driven motion goes on after the log's last state [s]."""
        return max(int(self.replay.audit.stamp_ns[-1]) - int(self.inputs.states.stamp_ns[-1]), 0) * 1e-9


def events_of(replay: Replay, kind: EventKind, source: str = "") -> Sequence[Event]:
    return [event for event in replay.events if event.kind is kind and event.source == source]


def least_of(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float | None:
    there = values[~np.isnan(values)]
    return float(there.min()) if len(there) else None


def time_of_least(judged: Judged, values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    return seconds_at(judged, int(np.nanargmin(values)))


def seconds_at(judged: Judged, index: int) -> float:
    """Of a state, since the first."""
    stamps = judged.replay.audit.stamp_ns
    return float(stamps[index] - stamps[0]) * 1e-9


def mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"


def nearby(judged: Judged, values: Float64) -> tuple[float, float, int] | None:
    """The largest of values (T,) about the arm, when [s], and over how many states; None without one."""
    num = int(np.isfinite(values).sum())
    return (float(np.nanmax(values)), seconds_at(judged, int(np.nanargmax(values))), num) if num else None
