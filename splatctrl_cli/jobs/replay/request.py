"""A replay's request, inputs and result, with its trace in files."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from dataclasses import field as made_by
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import Config, fixed
from splatctrl_cli.control.columns import Event, NamedColumns
from splatctrl_cli.control.goals import LoggedMotion
from splatctrl_cli.control.outside import STEP_LIMIT, OutsideController
from splatctrl_cli.control.preconditions import StaticViolation
from splatctrl_cli.control.replay import ReplayTrace
from splatctrl_cli.control.separation import DeclaredSeparation
from splatctrl_cli.evaluate.conformal import ConformalBound
from splatctrl_cli.evaluate.verdict import Reason
from splatctrl_cli.files.spilled_rows import ObjectFile, RowFile, Rows
from splatctrl_cli.jobs.reconstruct.verdict import LONGEST_BLIND
from splatctrl_cli.jobs.replay.hindsight import LaterDepth
from splatctrl_cli.jobs.replay.known_scene import KnownScene
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.device import RunOptions
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RecordSource, Stamps
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_margins import KeptMargin, SelfSurfaces
from splatctrl_cli.simulate.truth import Truth

BLOCK = 1024  # states that are replayed at once


class Trace(Mapping[str, Any]):
    """T states as `NamedColumns`, appended in blocks.

    Word columns name spheres or places: `nearest_exact` belongs to `clearance_exact`.
    """

    def __init__(self) -> None:
        self._columns: dict[str, RowFile | ObjectFile[Any]] = {}

    def append(self, columns: NamedColumns) -> None:
        """Append a block to some columns."""
        for name, values in columns.items():
            if name not in self._columns:
                dtype = np.int64 if name == "stamp_ns" else np.float64
                is_words = isinstance(values, list)
                self._columns[name] = ObjectFile() if is_words else RowFile(values.shape[1:], dtype=dtype)
            if isinstance(file := self._columns[name], RowFile):
                file.append(values)
            else:
                file.extend(values)

    def __len__(self) -> int:
        """Number of columns."""
        return len(self._columns)

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __getitem__(self, name: str) -> Any:
        """All numbers (T, ...) of a column, or its words (T,), read when indexed."""
        column = self.rows(name)
        return np.asarray(column) if isinstance(column, Rows) else column

    def rows(self, name: str) -> Any:
        """Column (T, ...), read when indexed: `Rows` of numbers, or words."""
        file = self._columns[name]
        return Rows(file) if isinstance(file, RowFile) else file

    @property
    def stamp_ns(self) -> Stamps:
        """Stamps (T,) [ns]."""
        return np.asarray(self["stamp_ns"], dtype=np.int64)

    def seconds(self, index: int) -> float:
        """Time [s] of a state since the first."""
        stamps = self.rows("stamp_ns")
        return float(stamps[index] - stamps[0]) * 1e-9


MODES = ("audit", "open-loop", "closed-loop")
JUDGE, OCCUPIED = "judge", "occupied"  # space that no camera saw free: judged by a table, or an obstacle


@dataclass(frozen=True, kw_only=True)
class ReplayRequest(RobotOptions, RunOptions):
    """Options of ``splatctrl replay``, by name.

    log: read with `options`. urdf: None for the robot of the log. The map is `scene` (a reconstruction), `field` (a
    baked grid), or `lockstep` (reconstructed meanwhile, on `device`). real_time: a lockstep's map is known once it is
    computed. Times are in seconds; start_time may be "first-map". evidence: a held-out camera, or k to hold out each
    k-th frame set. require_evidence: no pass without evidence. require_proof: no pass with space assumed free.
    unseen: `JUDGE` or `OCCUPIED`. controller: a user's class ``module:Class``, a policy server's URL, or "recorded"
    for the log's commands; controller_command: a program (docs/controllers.md). separation: a TOML file of declared
    inputs (docs/separation.md). report_only: only the gates `require` set the verdict's exit code.
    """

    log: Path
    out: Path = Path("replay")
    urdf: Path | None = None
    options: SourceOptions = made_by(default_factory=SourceOptions)
    scene: Path | None = None
    field: Path | None = None
    lockstep: bool = False
    latency: float = 0.0
    real_time: bool = False
    allow_disagreement: bool = False
    max_pose_jump: float = fixed.POSE_JUMP
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
    separation: Path | None = None
    require: tuple[str, ...] = ()
    report_only: bool = False


@dataclass(frozen=True, kw_only=True)
class ReplayInputs:
    """All inputs of a replay; states in the model's joint order.

    surfaces: of links, None if unreadable. pair_margins: lowered margins of link pairs.
    """

    source: RecordSource
    states: StateColumns
    model: RobotModel
    scene: KnownScene
    truth: Truth | None
    digests: dict[str, str]
    mismatches: tuple[Reason, ...] = ()
    declared: Declarations = made_by(default_factory=Declarations)
    surfaces: SelfSurfaces | None = None
    pair_margins: tuple[KeptMargin, ...] = ()
    separation: DeclaredSeparation | None = None

    def motion(self) -> LoggedMotion:
        states = self.states
        return LoggedMotion(stamp_ns=states.stamp_ns, position=states.position, velocity=states.velocity)


@dataclass(frozen=True, kw_only=True)
class MapError:
    """Map error by held-out frame sets; `bound` is None for too few sets.

    num_sets: in the judged time; num_seen: sets with points near the motion. time_s (since the first judged state),
    place (3,) [m]: of the point whose error is the bound. A negative bound is set to 0.
    """

    source: str
    num_sets: int
    num_seen: int
    num_points: int
    bound: ConformalBound | None
    time_s: float | None = None
    place: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class SeparationInput:
    """Input of the protective separation distance; source: measured, declared or assumed."""

    symbol: str
    value: float | None = None
    unit: str
    source: str
    how: str


@dataclass(frozen=True, kw_only=True)
class SceneChange:
    """Newer scene; before, after: least clearance [m] of the unmoved arm's surface without and with it."""

    stamp_ns: int
    before: float
    after: float

    @property
    def is_hit(self) -> bool:
        """True if the arm is in collision in the newer scene only."""
        return self.after < 0 <= self.before


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Finished replay of T states in one of MODES; fields: names of distances.

    trace: columns of `ReplayRecord`, with a controller also those of `step_columns` or `open_loop`. A closed loop
    adds `divergence_*` from the log (joints [rad], position [m], rotation [rad]); a truth adds `clearance_true`.
    num_before_scene: states left out before the first scene, over lead_in_s [s]. start_time_s: of the first state.
    statics: first and least clearance [m] of fixed spheres. closest: as in `ReplayRecord`. unwatched, overtaken:
    states that later depth contradicts. separation: inputs of the protective distance. outside: a user's controller.
    """

    model: RobotModel
    config: Config
    mode: str
    fields: tuple[str, ...]
    trace: Trace
    num_before_scene: int
    lead_in_s: float
    median_radius: float
    static_violations: tuple[StaticViolation, ...]
    start_time_s: float
    unwatched: tuple[LaterDepth, ...]
    overtaken: tuple[LaterDepth, ...]
    statics: Mapping[str, tuple[float, float]]
    closest: Mapping[KeptMargin, tuple[float, int]]
    closed_loop: ReplayTrace | None = None
    scene_changes: tuple[SceneChange, ...] = ()
    agreement: Mapping[str, Mapping[str, float | None]] = made_by(default_factory=dict)
    events: tuple[Event, ...] = ()
    twist_figures: Mapping[str, float | None] = made_by(default_factory=dict)
    map_error: MapError | None = None
    separation: tuple[SeparationInput, ...] | None = None
    outside: OutsideController | None = None

    @property
    def num_states(self) -> int:
        return len(self.trace.rows("stamp_ns"))

    @property
    def margin(self) -> float:
        """Least clearance allowed [m]."""
        return self.config.control.margin
