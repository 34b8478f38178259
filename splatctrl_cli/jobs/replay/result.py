"""What a replay found: the audit of its states, the trace of its mode, and what stands beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from splatctrl_cli.config import Config
from splatctrl_cli.control.events import Event
from splatctrl_cli.control.outside import Failure
from splatctrl_cli.control.preconditions import StaticViolation
from splatctrl_cli.control.replay import ReplayTrace
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.evaluate.clearance_agreement import ClearanceAgreement
from splatctrl_cli.jobs.replay.evidence import MapError
from splatctrl_cli.jobs.replay.hindsight import Overtaken, Unwatched
from splatctrl_cli.jobs.replay.state_store import Figures, StoredAudit, StoredOpenLoop, StoredSteps
from splatctrl_cli.records import FloatRows
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_margins import KeptMargin


@dataclass(frozen=True, kw_only=True)
class OutsideRun:
    """A user's own controller: what people call it, how often it answered as it should, and what ended it."""

    name: str
    num_answers: int
    failure: Failure | None


@dataclass(frozen=True, kw_only=True)
class Replay:
    """One finished replay of T states: their audit, the trace of its mode, and the truth where it is known.

    num_before_scene: requested states earlier than the first scene, left out, over lead_in_s [s]; start_time_s: of
    the first state in the log [s]; between, near, strain, statics and closest: as `ReplayRecord` has them; unwatched,
    overtaken: what later depth showed; obstacles (T,): what is nearest to the nearest sphere, in words; map_age_s
    (T,): of the scene in use; kept_steps: of a controller; divergence: of a closed loop from the log, by columns
    joints [rad], position [m], rotation [rad]; map_error: where the request names evidence of it; outside: of a
    user's own controller.
    """

    model: RobotModel
    config: Config
    audit: StoredAudit
    num_before_scene: int
    lead_in_s: float
    median_radius: float
    static_violations: tuple[StaticViolation, ...]
    obstacles: Sequence[str]
    map_age_s: FloatRows
    start_time_s: float
    between: Figures
    near: Figures
    unwatched: tuple[Unwatched, ...]
    overtaken: tuple[Overtaken, ...]
    strain: Figures
    statics: Mapping[str, tuple[float, float]]
    closest: Mapping[KeptMargin, tuple[float, int]]
    open_loop: StoredOpenLoop | None = None
    closed_loop: ReplayTrace | None = None
    divergence: Figures | None = None
    kept_steps: StoredSteps | None = None
    true_clearance: FloatRows | None = None
    agreement: Mapping[str, ClearanceAgreement] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    twist_figures: Mapping[str, float | None] = field(default_factory=dict)
    map_error: MapError | None = None
    outside: OutsideRun | None = None

    @property
    def margin(self) -> float:
        """Of clearance [m]."""
        return self.config.control.margin

    @property
    def mode(self) -> str:
        """As --mode has it."""
        return "closed-loop" if self.closed_loop else "open-loop" if self.open_loop else "audit"

    @property
    def steps(self) -> Sequence[ControlStep | None]:
        """What the controller decided at each state; empty in an audit."""
        trace = self.closed_loop or self.open_loop
        return () if trace is None else trace.steps
