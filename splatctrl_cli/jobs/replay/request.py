"""The request of a replay, its inputs, and its result: audit, trace and their references."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as made_by
from pathlib import Path

from splatctrl_cli.config import Config
from splatctrl_cli.config.fixed import POSE_JUMP
from splatctrl_cli.control.events import Event
from splatctrl_cli.control.goals import LoggedMotion
from splatctrl_cli.control.outside import STEP_LIMIT, OutsideController
from splatctrl_cli.control.preconditions import StaticViolation
from splatctrl_cli.control.replay import ReplayTrace
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.evaluate.conformal import ConformalBound
from splatctrl_cli.jobs.reconstruct.verdict import LONGEST_BLIND
from splatctrl_cli.jobs.recordings.provenance import Mismatch
from splatctrl_cli.jobs.replay.hindsight import LaterDepth
from splatctrl_cli.jobs.replay.known_scene import KnownScene
from splatctrl_cli.jobs.replay.state_store import Figures, StoredAudit, StoredOpenLoop, StoredSteps
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.device import RunOptions
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import FloatRows, RecordSource
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_margins import KeptMargin, SelfSurfaces
from splatctrl_cli.simulate.truth import Truth

MODES = ("audit", "open-loop", "closed-loop")
FIRST_MAP = "first-map"  # a start time: that of the first map
JUDGE, OCCUPIED = "judge", "occupied"  # space that no camera saw free: judged by a table, or an obstacle


@dataclass(frozen=True, kw_only=True)
class ReplayRequest(RobotOptions, RunOptions):
    """One replay: the options of ``splatctrl replay``, by their names.

    log: a log or capture with joint states, read as `options` say. urdf: the robot, None for the one that the log
    describes itself. One of `scene` (a reconstruction), `field` (a baked grid) and `lockstep` (reconstruct the log on
    the way, on `device`) says what is known of the scene. Times in seconds; start_time may be FIRST_MAP. evidence: a
    camera, or every how many frame sets, that did not train the scene and bounds its error; with require_evidence no
    verdict passes without, with require_proof none where space about the arm was assumed to be free; unseen: `JUDGE`
    or `OCCUPIED`. controller: a user's own class, ``module:Class``, or controller_command: a program
    (docs/controllers.md). report_only: the verdict alone does not set the exit code.
    """

    log: Path
    out: Path
    urdf: Path | None = None
    options: SourceOptions = made_by(default_factory=SourceOptions)
    scene: Path | None = None
    field: Path | None = None
    lockstep: bool = False
    latency: float = 0.0
    allow_disagreement: bool = False
    max_pose_jump: float = POSE_JUMP
    self_model: Path | None = None
    srdf: Path | None = None
    mode: str = "audit"
    frame: str | None = None
    goal: tuple[float, ...] | None = None
    goal_joints: tuple[float, ...] | None = None
    waypoints: Path | None = None
    follow: bool = False
    twist_topic: str | None = None
    twist_frame: str | None = None
    start_time: float | str | None = None
    re_anchor: float | None = None
    truth: Path | None = None
    max_unknown: float = 0.05
    max_map_age: float = LONGEST_BLIND
    evidence: str | None = None
    require_evidence: bool = False
    require_proof: bool = False
    unseen: str = JUDGE
    controller: str | None = None
    controller_command: str | None = None
    controller_step_limit: float = STEP_LIMIT
    controller_twice: bool = False
    worst_frames: int = 3
    declare: Path | None = None
    require: tuple[str, ...] = ()
    report_only: bool = False
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class ReplayInputs:
    """Everything a replay reads; states in the model's joint order. mismatches: inputs that do not belong together.
    surfaces: of the robot's links, None where they cannot be read; kept: what pairs of them keep of the margin.
    """

    source: RecordSource
    states: StateColumns
    model: RobotModel
    scene: KnownScene
    truth: Truth | None
    digests: dict[str, str]
    mismatches: tuple[Mismatch, ...] = ()
    declared: Declarations = made_by(default_factory=Declarations)
    surfaces: SelfSurfaces | None = None
    kept: tuple[KeptMargin, ...] = ()

    def motion(self) -> LoggedMotion:
        """Every logged state, whether a scene was known or not."""
        states = self.states
        return LoggedMotion(stamp_ns=states.stamp_ns, position=states.position, velocity=states.velocity)


@dataclass(frozen=True, kw_only=True)
class MapError:
    """What held-out frame sets say of the map: `bound` is None where they are too few.

    source: which frames, in words; num_sets: those within the judged time, num_seen of them with points near the
    motion, num_points in all; time_s, place (3,) [m]: when (since the first judged state) and where the map misses as
    much as the bound says. A bound below 0, of a map that is fatter than what it shows everywhere, is given as 0.
    """

    source: str
    num_sets: int
    num_seen: int
    num_points: int
    bound: ConformalBound | None
    time_s: float | None = None
    place: tuple[float, float, float] | None = None


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
    unwatched: tuple[LaterDepth, ...]
    overtaken: tuple[LaterDepth, ...]
    strain: Figures
    statics: Mapping[str, tuple[float, float]]
    closest: Mapping[KeptMargin, tuple[float, int]]
    open_loop: StoredOpenLoop | None = None
    closed_loop: ReplayTrace | None = None
    divergence: Figures | None = None
    kept_steps: StoredSteps | None = None
    true_clearance: FloatRows | None = None
    agreement: Mapping[str, Mapping[str, float | None]] = made_by(default_factory=dict)
    events: tuple[Event, ...] = ()
    twist_figures: Mapping[str, float | None] = made_by(default_factory=dict)
    map_error: MapError | None = None
    outside: OutsideController | None = None

    @property
    def margin(self) -> float:
        """The least clearance [m] that is allowed."""
        return self.config.control.margin

    @property
    def mode(self) -> str:
        """The mode, named as by --mode."""
        return "closed-loop" if self.closed_loop else "open-loop" if self.open_loop else "audit"

    @property
    def steps(self) -> Sequence[ControlStep | None]:
        """What the controller decided at each state; empty in an audit."""
        trace = self.closed_loop or self.open_loop
        return () if trace is None else trace.steps
