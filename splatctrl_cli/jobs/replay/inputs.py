"""A replay's robot with its sphere coverage, and a log's states."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatctrl_cli.checks.check_states import PoseAgreement, check_angles, check_states, pose_agreement
from splatctrl_cli.checks.clock_offset import (
    ClockOffset,
    ImageMotion,
    estimate_clock_offset,
    select_states,
)
from splatctrl_cli.config import ControlConfig
from splatctrl_cli.config.fixed import COVERED_COARSE, SELF_POSTURES
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError, refuse_if, require
from splatctrl_cli.evaluate.metrics import DESCRIBES, LENGTH, TIME, Scale
from splatctrl_cli.geometry import transform_points
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.robot.logged_robot import add_self_model, other_frame, urdf_of
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.log.stored_frame import FrameSource
from splatctrl_cli.recording.state.state_source import StateSource, open_states
from splatctrl_cli.records import Box, Float64, RecordSource
from splatctrl_cli.robot.coverage import LinkCoverage, coverage_of_solids
from splatctrl_cli.robot.declared_contact import DeclaredContact
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import drop_disabled, read_srdf
from splatctrl_cli.robot.self_margins import (
    KeptMargin,
    SelfSurfaces,
    apply_kept_margins,
    fixture_margins,
    kept_margins,
)
from splatctrl_cli.robot.self_model import ALWAYS

MAX_NOTES = 10  # printed
GRASPING = 1.0  # [s] before and after a grasp in which the hand may touch the object
ANGLE = Scale(unit="rad")
LOG_FIGURES = {  # they describe the log
    "num_poses": DESCRIBES,
    "max_pose_position": LENGTH,
    "max_pose_rotation": ANGLE,
    "max_pose_rest_position": LENGTH,
    "max_pose_rest_rotation": ANGLE,
    **dict.fromkeys(("clock_offset_s", "clock_uncertainty_s"), TIME),
}


def open_log(request: ReplayRequest, progress: Progress = SILENT) -> tuple[RobotModel, FrameSource | StateSource]:
    """Open the log and its robot; fingers that the log does not move are locked.

    Raises InputError for a log without joint states, UsageError for an unknown robot.
    """
    lacks_robot = request.urdf is None and not request.log.exists()
    refuse_if(lacks_robot, f"{request.log}: no such file or folder", remedy="check the path")
    urdf = require(
        urdf_of(request.urdf, (request.log,), progress),
        f"replay: {request.log} does not describe the robot",
        remedy="give it with --urdf FILE",
        error=UsageError,
    )
    model = request.posed(urdf)
    source = open_states(request.log, request.options, model.joint_names)
    refuse_if(
        not source.joint_names,
        f"{request.log}: expected joint states, got none",
        remedy="replay needs a log with /joint_states",
    )
    if request.urdf is None and request.base is None and (words := other_frame(urdf, source)):
        progress.log(f"warning: the robot is placed at the origin: {words}; give --base if it stood elsewhere")
    model = model.moved_by(source.joint_names, source.tf_frames)
    return add_self_model(model, request.self_model, request.scene), source


@dataclass(frozen=True, kw_only=True)
class MeasuredRobot:
    """Robot with measured coverage, link surfaces (None if unreadable), and lowered pair margins."""

    model: RobotModel
    surfaces: SelfSurfaces | None
    pair_margins: tuple[KeptMargin, ...] = ()


def measured_robot(
    request: ReplayRequest, model: RobotModel, config: ControlConfig, recorded: Float64 | None = None
) -> MeasuredRobot:
    """Measure sphere coverage, drop the SRDF's pairs, and give a controller margins it can keep.

    recorded: `recorded_postures`. Raises InputError if `config.coverage` is "margin" and coverage is unbounded.
    """
    disabled: Collection[frozenset[str]] = ()
    if request.srdf is not None:
        disabled, _ = read_srdf(request.srdf, model.urdf)
        model = model.replace_self_pairs(drop_disabled(model, disabled))
    try:
        solids = read_solids(model.urdf, list(request.packages))
    except InputError as error:
        model, surfaces = model.replace_coverage(None, str(error)), None
    else:
        model = model.replace_coverage(
            coverage_of_solids(model.urdf, solids, model.sphere_set, resolution=COVERED_COARSE)
        )
        surfaces = SelfSurfaces(model, solids, disabled, recorded)
    if config.coverage == "margin":
        refuse_if(
            model.coverage is None,
            f"control.coverage = margin: {model.coverage_unknown}",
            remedy="or set control.coverage = report, which needs no meshes",
        )
        refuse_if(
            bare := bare_moving_links(model),
            f"control.coverage = margin: expected spheres on every link that moves, got none on {', '.join(bare)}",
            remedy=f"fit a set that covers them: splatctrl robot spheres --urdf {model.urdf.path.name}",
        )
    pair_margins = () if request.mode == "audit" else kept_margins(model, config.self_margin, surfaces)
    fixtures = () if surfaces is None else fixture_margins(model, surfaces, config.margin)
    model = apply_kept_margins(model, config.self_margin, pair_margins)
    return MeasuredRobot(model=model, surfaces=surfaces, pair_margins=(*pair_margins, *fixtures))


def doubts_of(request: ReplayRequest, robot: MeasuredRobot, config: ControlConfig) -> list[str]:
    model = robot.model
    if request.mode == "audit":
        return list(model.doubts)
    of_fr3 = (
        "an FR3 refuses speeds near its position limits that its URDF allows; set control.velocity_limits = fr3 to"
        " keep the published ones"
    )
    is_fr3 = all(name.startswith("fr3_joint") for name in model.joint_names)
    return [
        *model.doubts,
        *([of_fr3] if is_fr3 and config.velocity_limits == "urdf" else []),
        *(
            f"{' and '.join(pair.links)}: their spheres overlap in every posture sampled, and nothing tells whether "
            "they touch: fit finer spheres (splatctrl robot spheres), or leave the pair out (--srdf)"
            for pair in robot.pair_margins
            if pair.margin is None and not pair.is_fixture
        ),
    ]


def words_of(robot: MeasuredRobot, config: ControlConfig, by_surface: Sequence[str] = ()) -> dict[str, str]:
    """Sentences on what the robot's spheres cover, by subject. by_surface: that of `ReplayTrace`."""
    words = {"coverage": coverage_words(robot.model, config)}
    if own_margins := [pair for pair in robot.pair_margins if pair.margin is not None]:
        words["self_margins"] = _self_margin_words(robot, own_margins, config)
    if by_surface:
        links = ", ".join(dict.fromkeys(name.partition("[")[0] for name in by_surface))
        words["by_surface"] = (
            f"{len(by_surface)} spheres come within the margin, but their links' surfaces do not: of {links}"
        )
    if robot.surfaces is not None and robot.surfaces.fused:
        pairs = ", ".join(" and ".join(pair) for pair in robot.surfaces.fused)
        words["fused"] = f"contact not judged of links that overlap in every recorded and sampled posture: {pairs}"
    return words


def _self_margin_words(robot: MeasuredRobot, pair_margins: Sequence[KeptMargin], config: ControlConfig) -> str:
    each = ", ".join(
        f"{' and '.join(pair.links)} {1e3 * (pair.margin or 0.0):.1f} mm{_gap_words(pair)}" for pair in pair_margins
    )
    judged = "" if robot.surfaces is None else "; contact is judged by surfaces"
    return f"self-collision margin: {1e3 * config.self_margin:g} mm, but of pairs with near spheres {each}{judged}"


def _gap_words(pair: KeptMargin) -> str:
    if pair.surface_gap is None:
        return ""
    if pair.surface_gap <= 0:
        return " (surfaces may touch then)"
    return f" (surfaces then {1e3 * pair.surface_gap:.1f} mm apart)"


def coverage_words(model: RobotModel, config: ControlConfig) -> str:
    """Uncovered surface, or why it is unknown, and the resulting surface margin."""
    report = model.coverage
    if report is None:
        return f"how much of the surface the spheres cover is not known: {model.coverage_unknown}"
    if not report.bare_links and report.max_deficit == 0:
        return "the spheres cover all of the collision surface (proven): the margin is that of the surface"
    far = max((link for link in report.links if link.deficit is not None), key=_proven, default=None)
    words = "no link has spheres" if far is None else f"the spheres leave up to {1e3 * _proven(far):.2f} mm uncovered"
    words += "" if far is None else f" ({far.link})"
    if config.coverage == "margin":
        words += (
            f"; their rows keep that much more, link by link, so that the surface keeps {1e3 * config.margin:g} mm"
        )
    else:
        left = 1e3 * (config.margin - (0.0 if far is None else _proven(far)))
        words += f"; where they keep {1e3 * config.margin:g} mm the surface keeps " + (
            f"{left:.2f} mm" if left > 0 else "nothing for certain"
        )
    bare = f", and nothing of {', '.join(report.bare_links)}, which have no sphere" if report.bare_links else ""
    return words + bare


def bare_moving_links(model: RobotModel) -> list[str]:
    """Moving links with a body but no sphere; empty if coverage was not measured."""
    if model.coverage is None:
        return []
    bodies = model.urdf.rigid_bodies()
    children = {joint.child for joint in model.urdf.joints}
    return [link for link in model.coverage.bare_links if bodies[link][0] in children]


def _proven(link: LinkCoverage) -> float:
    return 0.0 if link.deficit is None else max(0.0, link.deficit.proven)


@dataclass(frozen=True, kw_only=True)
class LoggedStates:
    """States in the model's joint order, their source, and checks.

    poses: logged poses against forward kinematics, None without any. clock: offset between cameras and robot.
    """

    source: RecordSource
    states: StateColumns
    poses: PoseAgreement | None
    clock: ClockOffset | None = None

    def as_dict(self) -> Mapping[str, Any]:
        return {
            "num_states": len(self.states),
            "loss": asdict(self.source.loss),
            "end_effector_poses": None
            if self.poses is None
            else asdict(self.poses) | {"offset": self.poses.offset.tolist()},
            "clock_offset": None if self.clock is None else asdict(self.clock),
        }

    def metrics(self) -> dict[str, float | None]:
        """Values of `LOG_FIGURES`."""
        poses, clock = self.poses, self.clock
        values = (
            0 if poses is None else poses.num_poses,
            None if poses is None else poses.difference.max_position,
            None if poses is None else poses.difference.max_rotation,
            None if poses is None else poses.rest.max_position,
            None if poses is None else poses.rest.max_rotation,
            None if clock is None else clock.offset_s,
            None if clock is None else clock.uncertainty_s,
        )
        return dict(zip(LOG_FIGURES, values, strict=True))

    def counts(self) -> dict[str, int]:
        """Number of poses or intervals behind each metric but `num_poses`."""
        num_poses = 0 if self.poses is None else self.poses.num_poses
        num_intervals = 0 if self.clock is None else self.clock.num_intervals
        return {name: num_intervals if name.startswith("clock_") else num_poses for name in [*LOG_FIGURES][1:]}

    def lines(self) -> list[str]:
        notes = self.source.loss.notes
        more = [f"and {len(notes) - MAX_NOTES} more notes in states.json"] if len(notes) > MAX_NOTES else []
        sentences = [check.sentence for check in (self.poses, self.clock) if check is not None]
        return [f"log: {line}" for line in (*notes[:MAX_NOTES], *more, *sentences)]


def read_states(source: FrameSource | StateSource, model: RobotModel) -> LoggedStates:
    """Read the robot's states; their clock offset needs frames, too (`clock_of`).

    Raises InputError if the states cannot be the robot's.
    """
    states = source.states.convert_joints(*model.joint_columns(source.joint_names))
    check_states(states, model.joint_names)
    check_angles(model, states, source.name)
    return LoggedStates(source=source, states=states, poses=pose_agreement(model, states))


def grasp_contacts(model: RobotModel, states: StateColumns) -> Iterator[DeclaredContact]:
    """Contact of a hand's links with a grasped part, where it is taken and left.

    It may begin `GRASPING` before taking, and lasts `GRASPING` after taking and leaving: the map still shows the
    part.
    """
    bodies = model.urdf.rigid_bodies(set(model.joint_names) - set(model.urdf.grippers))
    first_ns = int(states.stamp_ns[0])
    for part in [] if model.self_model is None else model.self_model.temporary:
        for stamp, before in ((part.start_ns, GRASPING), (part.end_ns, 0.0)):
            if stamp in ALWAYS:
                continue
            q = states.position[int(np.abs(states.stamp_ns - stamp).argmin())]
            corners = transform_points(model.frame_pose(q, part.link), part.triangles.reshape(-1, 3))
            box = Box(lower=corners.min(axis=0) - part.voxel, upper=corners.max(axis=0) + part.voxel)
            time, reason = 1e-9 * (stamp - first_ns), part.words(first_ns)
            for link in [link for link in bodies if bodies[link][0] == bodies[part.link][0]]:
                yield DeclaredContact(
                    link=link, box=box, start=time - before, end=time + GRASPING, reason=reason, is_learned=True
                )


def recorded_postures(states: StateColumns) -> Float64:
    """Every k-th posture (R, J) of the log: SELF_POSTURES to twice that number, or all."""
    return states.position[np.arange(0, len(states), max(len(states) // SELF_POSTURES, 1))]


def check_inside(model: RobotModel, q: Float64, box: Box) -> None:
    """Raise NotEvaluableError if no moving sphere at q (J,) is in a baked field's box."""
    centers = model.sphere_centers(q)[np.flatnonzero(model.moving_spheres)]
    beyond = np.maximum(box.lower - centers, centers - box.upper).max(axis=1)
    if not len(centers) or beyond.min() <= 0:
        return
    lower, upper = ("(" + ", ".join(f"{v:.2f}" for v in corner) + ")" for corner in (box.lower, box.upper))
    raise NotEvaluableError(
        f"--field: expected the robot in the grid from {lower} to {upper} m, got all {len(centers)} moving spheres "
        f"outside it, the nearest by {beyond.min():.2f} m",
        remedy="check --base and the frame of the field, or bake a --box around the robot",
    )


def clock_of(model: RobotModel, logged: LoggedStates, motion: ImageMotion) -> ClockOffset | None:
    """Estimate the cameras' clock offset from image changes; None without images, times or states."""
    states = logged.states
    if not motion.cameras or not logged.source.has_clock or not len(states):
        return None
    selected = states.select(select_states(states.stamp_ns, motion))
    centers = model.sphere_centers_batch(selected.position[: len(selected)])
    moving = model.moving_spheres
    return estimate_clock_offset(selected, motion, (centers[:, moving], model.sphere_set.radii[moving]))
