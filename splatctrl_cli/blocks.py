"""Parts for custom programs: robot, scene, fields, planner, controller, simulation.

These names may change with a minor version.
"""

from splatctrl_cli.config import ControlConfig, PlannerConfig, fixed
from splatctrl_cli.config.fixed import START_ROOM
from splatctrl_cli.config.ranges import checked_pose
from splatctrl_cli.control.audit import DistanceFunction, DistancesAt, audit
from splatctrl_cli.control.barriers import SceneStep, rate_of
from splatctrl_cli.control.columns import is_shaped, runs_of
from splatctrl_cli.control.goals import Detour, Guide, LoggedMotion, PlanDetour, TimedPath, guided_goal, pose_error
from splatctrl_cli.control.replay import Outcome as MotionOutcome
from splatctrl_cli.control.replay import ReplayTask, closed_loop, is_at_goal
from splatctrl_cli.control.step import ControlStep, QpIkController
from splatctrl_cli.evaluate.protocols import SURFACE_SCANS
from splatctrl_cli.evaluate.verdict import verdict_of
from splatctrl_cli.field.baker import Baker, Planes
from splatctrl_cli.field.clusters import Spheres, field_splats, obstacle_spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.field.grid_cells import HALF_DIAGONAL, GridField, GridLayout
from splatctrl_cli.files.output import (
    Stopwatch,
    output_path,
    write_json,
    write_run,
)
from splatctrl_cli.formats.splat.gaussian_ply import write_gaussian_ply
from splatctrl_cli.formats.splat.splats import nearest_splats
from splatctrl_cli.geometry import (
    back_project,
    frame_along,
    invert_transform,
    look_at,
    pose_at,
    project,
    transform_from,
    transform_points,
    turn_about_z,
)
from splatctrl_cli.jobs.replay.criteria import Judged
from splatctrl_cli.jobs.replay.goal import goal_waypoints
from splatctrl_cli.jobs.replay.inputs import LoggedStates, MeasuredRobot, measured_robot
from splatctrl_cli.jobs.replay.known_scene import (
    ROUNDING,
    Certified,
    KnownFields,
    KnownScene,
    certified_distance,
    fields_at,
    known_space,
    seen_of,
    splat_fields,
)
from splatctrl_cli.jobs.replay.metrics import metrics_of
from splatctrl_cli.jobs.replay.modes import replayed
from splatctrl_cli.jobs.replay.replay import replay_verdict
from splatctrl_cli.jobs.replay.request import ReplayInputs
from splatctrl_cli.jobs.running.progress import SILENT
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, simulate
from splatctrl_cli.kernels import native, num_threads
from splatctrl_cli.kernels import raster as gaussian_kernels
from splatctrl_cli.kernels.points import solid_distance
from splatctrl_cli.kernels.raster import ImageLoss, LossTerms
from splatctrl_cli.kernels.surface_image import BALL, BOX, CAPSULE, CYLINDER
from splatctrl_cli.libraries import import_extra as of_extra
from splatctrl_cli.libraries import is_installed, mpl
from splatctrl_cli.planner.birrt import plan
from splatctrl_cli.planner.configuration_clearance import Clearance, HasDistance, check_edges
from splatctrl_cli.planner.planned import (
    GOAL_BLOCKED,
    START_BLOCKED,
    PlannedPath,
    goal_postures,
    planned_detours,
    planned_path,
)
from splatctrl_cli.planner.planned import resample as resampled
from splatctrl_cli.recording.calibrated import Perturbation
from splatctrl_cli.recording.folder.dtu import scan_folders
from splatctrl_cli.recording.folder.idr import idr_scans
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.records import (
    Bool,
    DistanceField,
    DistanceGrid,
    Float32,
    Float64,
    GaussianSet,
    Intrinsics,
    LossReport,
    Record,
    RgbdFrame,
    SplatSet,
    Stamps,
    UInt8,
)
from splatctrl_cli.report.pictures import CURVE_COLORS, INK, drawn_figure
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import random_postures
from splatctrl_cli.robot.sphere_files import sphere_names
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import Shape
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import View
from splatctrl_cli.scene.posture import RobotPosture, posture_of
from splatctrl_cli.scene.render import loss_weights, mean_loss, psnr_of
from splatctrl_cli.scene.scale import RecordedDepth, fitted_to
from splatctrl_cli.scene.self_mask import PixelKind, self_mask, self_mask_metrics
from splatctrl_cli.scene.time_steps import AuditRow, depth_box
from splatctrl_cli.simulate.arm import PEAK, Motion, arm_spheres_yaml, arm_urdf
from splatctrl_cli.simulate.primitives import Primitive, Texture, Track, box, solid
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions, Scene
from splatctrl_cli.simulate.render import Camera, DepthNoise, Renderer
from splatctrl_cli.simulate.tabletop import PALETTE, arm_solids, cameras, furniture, texture
from splatctrl_cli.simulate.truth import closest_of, distance_to
from splatctrl_cli.voxels import Balls, OccupancyGrid, SeenVoxels, VoxelState

__all__ = [
    "BALL",
    "BOX",
    "CAPSULE",
    "CURVE_COLORS",
    "CYLINDER",
    "GOAL_BLOCKED",
    "HALF_DIAGONAL",
    "INK",
    "PALETTE",
    "PEAK",
    "ROUNDING",
    "SILENT",
    "START_BLOCKED",
    "START_NS",
    "START_ROOM",
    "SURFACE_SCANS",
    "AuditRow",
    "Baker",
    "Balls",
    "Bool",
    "Camera",
    "Certified",
    "Clearance",
    "ControlConfig",
    "ControlStep",
    "DepthNoise",
    "Detour",
    "DistanceField",
    "DistanceFunction",
    "DistanceGrid",
    "DistancesAt",
    "Float32",
    "Float64",
    "GaussianSet",
    "GridField",
    "GridLayout",
    "Guide",
    "HasDistance",
    "ImageLoss",
    "Intrinsics",
    "Judged",
    "KnownFields",
    "KnownScene",
    "LoggedMotion",
    "LoggedStates",
    "LossReport",
    "LossTerms",
    "MeasuredRobot",
    "Motion",
    "MotionOutcome",
    "OccupancyGrid",
    "Perturbation",
    "PixelKind",
    "PlanDetour",
    "Planes",
    "PlannedPath",
    "PlannerConfig",
    "Primitive",
    "QpIkController",
    "Record",
    "RecordedDepth",
    "Recording",
    "RecordingOptions",
    "Renderer",
    "ReplayInputs",
    "ReplayTask",
    "RgbdFrame",
    "RobotModel",
    "RobotPosture",
    "RobotSurface",
    "Scene",
    "SceneFitter",
    "SceneStep",
    "SeenVoxels",
    "Shape",
    "SimulateRequest",
    "SphereField",
    "Spheres",
    "SplatSet",
    "Stamps",
    "StateColumns",
    "Stopwatch",
    "Texture",
    "TimedPath",
    "Track",
    "UInt8",
    "View",
    "VoxelState",
    "arm_solids",
    "arm_spheres_yaml",
    "arm_urdf",
    "audit",
    "back_project",
    "box",
    "cameras",
    "certified_distance",
    "check_edges",
    "checked_pose",
    "closed_loop",
    "closest_of",
    "depth_box",
    "distance_to",
    "drawn_figure",
    "field_splats",
    "fields_at",
    "fitted_to",
    "fixed",
    "frame_along",
    "furniture",
    "gaussian_kernels",
    "goal_postures",
    "goal_waypoints",
    "guided_goal",
    "idr_scans",
    "invert_transform",
    "is_at_goal",
    "is_installed",
    "is_shaped",
    "known_space",
    "look_at",
    "loss_weights",
    "mean_loss",
    "measured_robot",
    "metrics_of",
    "mpl",
    "native",
    "nearest_splats",
    "num_threads",
    "obstacle_spheres",
    "of_extra",
    "output_path",
    "plan",
    "planned_detours",
    "planned_path",
    "pose_at",
    "pose_error",
    "posture_of",
    "project",
    "psnr_of",
    "random_postures",
    "rate_of",
    "replay_verdict",
    "replayed",
    "resampled",
    "runs_of",
    "scan_folders",
    "seen_of",
    "self_mask",
    "self_mask_metrics",
    "simulate",
    "solid",
    "solid_distance",
    "sphere_names",
    "splat_fields",
    "texture",
    "transform_from",
    "transform_points",
    "turn_about_z",
    "verdict_of",
    "write_gaussian_ply",
    "write_json",
    "write_run",
]
