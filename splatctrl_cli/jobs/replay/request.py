"""What a replay is asked for, and what it reads of it."""

from dataclasses import dataclass
from dataclasses import field as made_by
from pathlib import Path

from splatctrl_cli.config.fixed import POSE_JUMP
from splatctrl_cli.control.goals import LoggedMotion
from splatctrl_cli.control.outside import STEP_LIMIT
from splatctrl_cli.jobs.replay.known_scene import KnownScene
from splatctrl_cli.jobs.replay.provenance import Mismatch
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.device import RunOptions
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RecordSource
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
    max_map_age: float = 1.0
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
    """Everything a replay reads; states in the model's joint order. mismatches: of what does not belong together.
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
