"""Every number of the method, by section of the paper. The paper's value is the default where it gives one."""

import dataclasses
import difflib
import math
import tomllib
import types
import typing
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from splatctrl_cli.errors import InputError, UsageError


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """III-B and III-C: splats, losses, add and relocate."""

    max_splats: int = 5000  # IV-C
    initial_opacity: float = 0.5  # III-C
    min_radius: float = 0.002  # [m]
    max_radius: float = 0.02  # [m] r_max; the paper gives none, one voxel
    lambda_dssim: float = 0.2  # III-C, eq. 4
    lambda_color: float = 1.0
    lambda_depth: float = 1.0
    lambda_reg: float = 0.005  # of the mean opacity; 0.02 in the paper loses 0.3 dB on views held out
    background: str = "median"  # behind the splats: the colour of what has no depth; or "black"
    lambda_opacity: float = 0.1  # of the mean transmittance where there is depth; 0 in the paper
    depth_loss: str = "normalised"  # by accumulated opacity; "printed" (eq. 3) sets surfaces 12 mm too deep
    lambda_mde: float = 50.0  # III-C eq. 5 gives none; its source (SplaTAM) uses 50
    min_depth_error: float = 0.02  # [m] floor of lambda_mde * MDE, so that a perfect map is not re-seeded
    max_depth_error: float = 0.04  # [m] ceiling of it: above, a box on a table would never be added
    hole_opacity: float = 0.5  # accumulated opacity below which a pixel is a hole in the map
    min_opacity: float = 0.1  # III-C, alpha_min
    radius_per_edge: float = 0.45  # of a seed, in edges of its cube
    max_gap: float = 0.018  # [m] from a measured point to the nearest splat's sphere; beyond, one is added
    contact_radius: float = 0.010  # [m] of splats of objects within 2 cm of the moving robot, which hides contact
    gap_reserve: float = 0.02  # share of the budget that only such gaps may use
    when_idle: str = "detail"  # refining with nothing to add: seed where colours are wrong; or "clone", "leave"
    weak_share: float = 0.03  # of the splats, those that show least, given up for such detail after each block
    fill: float = 0.85  # share of the budget that the first time step may use; all of it where nothing comes later
    iterations_per_step: int = 30  # K optimiser steps per time step
    first_iterations: int = 300  # optimiser steps on the first time step
    coarse_share: float = 0.0  # of them, on images of half the size
    refine_iterations: int = 2000  # more of them, with annealed rates, where nothing moves (an image folder)
    lr_center: float = 2e-4  # [m]
    lr_log_radius: float = 6e-3
    lr_color: float = 1e-2
    lr_logit_opacity: float = 5e-2
    refine_geometry: float = 5.0  # factor on the rates of centre and radius while refining
    final_rate: float = 0.1  # share of the learning rates left at the end of refining
    noise: float = 5e5  # lambda_noise of 3DGS-MCMC; a step is capped at half a radius
    window: int = 12  # keyframes kept beside the newest frame of each camera
    keyframe_distance: float = 0.05  # [m] a camera that moved further than this makes a keyframe
    keyframe_angle: float = 5.0  # [deg] or turned further than this
    snapshot_every: int = 1  # time steps between snapshots
    snapshot_period: float = 0.0  # [s] of the log between snapshots, beside snapshot_every; 0: no matter
    checkpoint_period: float = 10.0  # [s] between checkpoints, or 50 times what one takes to write; 0: each time step


@dataclass(frozen=True, kw_only=True)
class GaussianConfig:
    """The baseline, `reconstruct --method 3dgs`: 3D Gaussian splatting (Kerbl et al. 2023), with its numbers. Shares
    are of `iterations`, of which it had 30,000.
    """

    iterations: int = 3000
    max_gaussians: int = 500_000  # 3DGS has no limit
    max_degree: int = 3  # of the spherical harmonics, 0 to 3
    degree_every: float = 1 / 30  # share of the iterations after which the degree rises by one
    initial_opacity: float = 0.1
    lr_center: float = 1.6e-4  # times the extent of the scene [m]
    lr_center_final: float = 1.6e-6  # at the end; falls exponentially
    lr_log_scale: float = 5e-3
    lr_quat: float = 1e-3
    lr_color: float = 2.5e-3  # of the constant harmonic
    lr_harmonics: float = 1.25e-4  # of the others, a twentieth
    lr_logit_opacity: float = 5e-2
    densify_from: int = 500  # iterations before the first round of adding and removing
    densify_until: float = 0.5  # share of the iterations after which their number is fixed
    densify_every: int = 100  # iterations
    densify_gradient: float = 2e-4  # mean screen gradient, in half images, from which a Gaussian is cloned or split
    dense_share: float = 0.01  # of the scene's extent: a Gaussian up to this size is cloned, a larger one split
    split_shrink: float = 1.6  # the sigmas of a split Gaussian's parts are divided by this
    min_opacity: float = 0.005  # a fainter one is removed
    max_screen_radius: float = 20.0  # [px] a larger one is removed once opacities have been reset
    max_size_share: float = 0.1  # of the scene's extent: the same for sigmas
    reset_every: float = 0.0  # share of the iterations after which opacities are reset; 0.1 of few costs over 1 dB
    reset_opacity: float = 0.01


@dataclass(frozen=True, kw_only=True)
class OccupancyConfig:
    """III-C: occupancy grid, free-space filter, robot labels."""

    voxel: float = 0.02  # [m], at least the largest radius
    free_below: float = 0.3  # III-C
    occupied_above: float = 0.7  # III-C
    rule: str = "observed"  # or "literal": all below occupied_above goes, seen or not
    log_odds_hit: float = 0.85
    log_odds_miss: float = -0.4
    log_odds_limit: float = 2.0  # three cameras turn a full voxel free in two time steps
    min_range: float = 0.2  # [m]; nearer depth is what carries the camera, or noise
    max_range: float = 3.0  # [m]; farther depth is no hit, it frees what is nearer
    see_through: float = 0.015  # [m] by which a splat must stand before every depth around its pixel to be floating
    uncertain_patience: int = 10  # time steps a splat may stand in uncertain voxels
    self_mask_tolerance: float = 0.004  # [m] of calibration: how far the robot may be from where its joints put it
    depth_error: float = 0.0015  # [m] sigma of depth at 1 m, growing with its square: 0.05 px of a D435's disparity


@dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """III-D: distance field."""

    distance: str = "safe"  # min(se, hard); or safe_gpdf: min(gpdf, hard), hard, se, gpdf (the paper's)
    weights: str = "rowsum"  # eq. 15; or voxel: density on a voxel grid (III-D), cg: the full GP of eq. 8
    length_scale: float = 0.02  # [m] l, IV-C
    noise: float = 1e-6  # epsilon of eq. 8
    truncation: float = 5e-5  # [m] by how much leaving out or merging small terms may change a kernel distance
    unknown: str = "free"  # never-seen space: free, obstacle or nan
    probability: str = "calibrated"  # of collision, Phi((error_mean - sdf) / error); or paper: eq. 13 and 14, a score
    error_mean: float = 0.0015  # [m] what the calibrated form takes off sdf, measured near solids as error was
    error: float = 0.002  # [m] sigma of the calibrated form: splats 1 to 2 cm apart, 2 mm of noise
    voxel: float = 0.02  # [m], IV-B
    padding: float = 0.20  # [m] around the splats where no workspace is given


@dataclass(frozen=True, kw_only=True)
class ControlConfig:
    """III-E: QP inverse kinematics with control barrier functions."""

    preset: str = "reduced"  # or paper: III-E as printed, with barrier_gain = 1 and without a second look
    solver: str = "clarabel"  # of the QP; or daqp: an active-set method, several times as fast
    margin: float = 0.02  # [m] epsilon, IV-C
    human_margin: float = 0.0  # [m] the same to people (label human), where it is larger
    coverage: str = "report"  # of the spheres: say what they leave uncovered; or margin: keep that much more, too
    period: float = 0.01  # [s] dt; the paper solves at more than 100 Hz
    barrier_gain: float = 10.0  # [1/s] alpha of every limit and barrier row; 1 (as printed) takes 1.4 times as long
    self_margin: float = 0.02  # [m] epsilon of the self-collision rows, III-E
    weight_linear: float = 10.0  # Q of III-E, linear part; III-E gives no weights
    weight_angular: float = 1.0  # Q of III-E, angular part
    weight_kinematics: float = 100.0  # R of III-E as a multiple of Q: (1/Q + 1/R)^-1 is then 0.99 Q
    weight_slack: float = 100.0  # S of III-E
    slack_cost: float = 1e3  # L1 cost of an external slack [1 / (m/s)]: above every multiplier met, so exact
    self_slack_cost: float = 1e5  # the same for self-collision rows: given up last
    posture_weight: float = 1e-3  # lambda on joint velocity; without it 7 joints on a 6-D task are undetermined
    smoothness_weight: float = 0.0  # weight on the change of joint velocity since the last step; see replay.md
    posture_gain: float = 0.5  # [1/s] pull towards the home posture, under posture_weight
    pose_gain: float = 2.0  # [1/s] pose error to end-effector velocity
    max_linear_speed: float = 0.25  # [m/s] cap of the reference: a usual speed beside people
    max_angular_speed: float = 1.0  # [rad/s]
    twist_timeout: float = 0.5  # [s] a logged twist holds; then the arm is asked to stand still
    max_acceleration: float | tuple[float, ...] = 0.0  # [rad/s^2] of every joint, or one for each; 0: no limit
    velocity_limits: str = "urdf"  # or fr3: also those published for the Franka Research 3, by position
    distance_rate: str = "snapshots"  # dd/dt of the rows: what distances lost between the two newest scenes; or none
    max_distance_rate: float = 1.6  # [m/s] that a scene is taken to approach with at most: a walking person
    max_residual: float = 1e-5  # a solution whose relative KKT residual exceeds this is not used
    slack_tolerance: float = 1e-4  # [m/s] slack above which a row counts as relaxed
    promise_tolerance: float = 1e-4  # [m] a step may fall short of what its rows promised before it is scaled back
    limit_tolerance: float = 1e-3  # [rad] a start this far outside a joint limit is encoder noise
    goal_position: float = 0.01  # [m] the goal counts as reached
    goal_rotation: float = 0.0175  # [rad] 1 degree
    max_time: float = 30.0  # [s] of a closed-loop replay
    stall_time: float = 2.0  # [s] a local minimum: over this long ...
    stall_speed: float = 2e-3  # [rad/s] ... the joints moved on average slower than this
    max_cuts: int = 3  # rounds of further rows against what a solution would have met beside its rows
    max_detours: int = 0  # planned ways out of a local minimum that a closed loop may take ([planner])
    stop_acceleration: float = 7.5  # [rad/s^2] a monitored standstill brakes and starts with, the Panda's; 0: at once


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """IV: the sampling-based planner (BiRRT) that the controller is compared with."""

    seed: int = 0  # of samples and shortcuts; the same seed, the same path
    goal_postures: int = 8  # of a goal pose, sought from twice as many guesses; a path may end in any
    contact: float = 1e-4  # [m] clearance above the margin that a posture needs; bounds the checks of a grazing edge
    batch: int = 8  # samples per iteration, whose edges are checked together
    reach: float = 1.5  # [rad] longest edge grown towards a sample, in joint space
    shortest: float = 0.1  # [rad] shortest edge that is worth a node
    max_iterations: int = 4000  # then a search ends as out-of-iterations
    max_time: float = 10.0  # [s], then as out-of-time: the only thing here that depends on the machine
    shortcut_rounds: int = 4  # of random shortcuts, after the greedy ones
    shortcut_batch: int = 8  # shortcuts tried per round
    max_acceleration: float = 7.5  # [rad/s^2] of every joint: the least of the Panda's
    follow_gain: float = 10.0  # [1/s] joint error to joint velocity, where a path is followed in joint space
    wait_distance: float = 0.05  # [m] the reference waits while the end effector is this far behind it
    limit_tolerance: float = 1e-3  # [rad] a start or goal this far outside a joint limit is encoder noise


@dataclass(frozen=True, kw_only=True)
class HumanConfig:
    """People (label 10 of III-C)."""

    memory: float = 5.0  # [s] what no camera sees any more stays human; then it is unknown


@dataclass(frozen=True, kw_only=True)
class Config:
    """The whole configuration, one table per section in TOML."""

    scene: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    gaussians: GaussianConfig = dataclasses.field(default_factory=GaussianConfig)
    occupancy: OccupancyConfig = dataclasses.field(default_factory=OccupancyConfig)
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    control: ControlConfig = dataclasses.field(default_factory=ControlConfig)
    planner: PlannerConfig = dataclasses.field(default_factory=PlannerConfig)
    human: HumanConfig = dataclasses.field(default_factory=HumanConfig)

    def as_dict(self) -> dict[str, Any]:
        """Nested plain values, as written to ``run.json``."""
        return asdict(self)


T = TypeVar("T")


def load_config(path: Path | None, assignments: typing.Sequence[str]) -> Config:
    """Defaults, then the TOML file, then each ``section.key=value``.

    Raises UsageError for an unknown section or key (naming the nearest), a value of the wrong type or out of range,
    or TOML that does not parse; InputError for a file that is not there.
    """
    config = Config()
    if path is not None:
        config = _merge(config, _read_toml(path), where=str(path))
    for assignment in assignments:
        key, separator, text = assignment.partition("=")
        section, dot, name = key.strip().partition(".")
        if not separator or not dot:
            raise UsageError(
                f"--set {assignment}: expected section.key=value", remedy="write it like --set scene.max_splats=3000"
            )
        config = _merge(config, {section: {name: _parse_value(text.strip())}}, where=f"--set {assignment}")
    _check_ranges(config)
    return config


_POSITIVE = (
    *("scene.max_splats", "scene.snapshot_every", "scene.min_radius", "scene.max_radius", "scene.radius_per_edge"),
    *("scene.fill", "scene.final_rate", "occupancy.voxel", "occupancy.max_range"),
    *("occupancy.log_odds_hit", "occupancy.log_odds_limit", "field.voxel", "field.length_scale", "field.error"),
    *("gaussians.max_gaussians", "gaussians.lr_center", "gaussians.lr_center_final", "gaussians.densify_every"),
    *("gaussians.split_shrink", "gaussians.max_screen_radius", "gaussians.max_size_share"),
    *("planner.goal_postures", "planner.contact", "planner.batch", "planner.reach", "planner.shortest"),
    *("planner.shortcut_batch", "planner.max_acceleration", "planner.wait_distance"),
)
_AT_LEAST_ZERO = (
    *("gaussians.iterations", "gaussians.max_degree", "gaussians.degree_every", "gaussians.lr_log_scale"),
    *("gaussians.lr_quat", "gaussians.lr_color", "gaussians.lr_harmonics", "gaussians.lr_logit_opacity"),
    *("gaussians.densify_from", "gaussians.densify_until", "gaussians.densify_gradient", "gaussians.dense_share"),
    *("gaussians.reset_every", "scene.weak_share", "scene.coarse_share"),
    *("scene.lambda_dssim", "scene.lambda_color", "scene.lambda_depth", "scene.lambda_reg", "scene.lambda_opacity"),
    *(
        "scene.lambda_mde",
        "scene.min_depth_error",
        "scene.max_gap",
        "scene.contact_radius",
        "scene.gap_reserve",
        "scene.hole_opacity",
    ),
    *("scene.iterations_per_step", "scene.first_iterations", "scene.refine_iterations", "scene.refine_geometry"),
    *("scene.lr_center", "scene.lr_log_radius", "scene.lr_color", "scene.lr_logit_opacity", "scene.window"),
    *("scene.keyframe_distance", "scene.keyframe_angle", "occupancy.min_range", "occupancy.see_through"),
    *(
        "occupancy.uncertain_patience",
        "scene.snapshot_period",
        "scene.checkpoint_period",
        "occupancy.self_mask_tolerance",
        "occupancy.depth_error",
        "human.memory",
        "field.noise",
        "field.padding",
        "scene.noise",
        "control.stop_acceleration",
        "control.human_margin",
        "control.max_cuts",
        "control.max_detours",
    ),
    *("planner.seed", "planner.max_iterations", "planner.max_time", "planner.shortcut_rounds"),
    *("planner.follow_gain", "planner.limit_tolerance"),
)
_SHARES = (
    *("scene.initial_opacity", "scene.min_opacity"),
    *("gaussians.initial_opacity", "gaussians.min_opacity", "gaussians.reset_opacity"),
    *("occupancy.free_below", "occupancy.occupied_above"),
)
_CHOICES = {
    "scene.depth_loss": ("normalised", "printed"),
    "scene.background": ("median", "black"),
    "scene.when_idle": ("detail", "clone", "leave"),
    "field.unknown": ("free", "obstacle", "nan"),
    "field.probability": ("calibrated", "paper"),
    "control.preset": ("reduced", "paper"),
    "control.coverage": ("report", "margin"),
    "control.solver": ("clarabel", "daqp"),
    "control.velocity_limits": ("urdf", "fr3"),
    "control.distance_rate": ("none", "snapshots"),
}
_AT_MOST_ONE = (
    *("scene.lambda_dssim", "scene.hole_opacity", "scene.gap_reserve", "scene.fill", "scene.final_rate"),
    *("scene.weak_share", "scene.coarse_share"),
)
_ORDERED = (
    ("scene.min_radius", "scene.max_radius"),
    ("scene.min_depth_error", "scene.max_depth_error"),
    ("occupancy.free_below", "occupancy.occupied_above"),
)


def _check_ranges(config: Config) -> None:
    """Raise UsageError for a scene, occupancy or field value that nothing can be made with.

    What a controller can run with is checked where it is made.
    """
    values = {f"{section}.{key}": value for section, keys in config.as_dict().items() for key, value in keys.items()}
    for name, choices in _CHOICES.items():
        if values[name] not in choices:
            raise UsageError(f"{name}: expected {' or '.join(choices)}, got {values[name]!r}")
    for name in _POSITIVE:
        _check(values[name] > 0, name, "above 0", values[name])
    for name in _AT_LEAST_ZERO:
        _check(values[name] >= 0, name, "0 or more", values[name])
    for name in _SHARES:
        _check(0 < values[name] < 1, name, "between 0 and 1", values[name])
    for name in _AT_MOST_ONE:
        _check(values[name] <= 1, name, "at most 1", values[name])
    for low, high in _ORDERED:
        _check(values[low] <= values[high], low, f"at most {high} = {values[high]:g}", values[low])
    _check(config.gaussians.max_degree <= 3, "gaussians.max_degree", "at most 3", config.gaussians.max_degree)
    _check_occupancy(config.occupancy)


def _check_occupancy(config: OccupancyConfig) -> None:
    _check(config.log_odds_miss < 0, "occupancy.log_odds_miss", "below 0", config.log_odds_miss)
    _check(
        config.max_range > config.min_range,
        "occupancy.max_range",
        f"above occupancy.min_range = {config.min_range:g}",
        config.max_range,
    )
    needed = max(
        math.log(config.occupied_above / (1 - config.occupied_above)),
        math.log((1 - config.free_below) / config.free_below),
    )  # a voxel's log-odds must be able to pass both thresholds
    _check(
        config.log_odds_limit > needed,
        "occupancy.log_odds_limit",
        f"above {needed:.3g}, the log-odds of the thresholds",
        config.log_odds_limit,
    )


def _check(holds: bool, name: str, expected: str, value: float) -> None:
    if not holds:
        raise UsageError(f"{name}: expected {expected}, got {value:g}", remedy="see docs/config.md")


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file", remedy="give --config an existing TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not valid TOML: {error}") from None


def _parse_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _merge(target: T, values: dict[str, Any], *, where: str, prefix: str = "") -> T:
    assert is_dataclass(target) and not isinstance(target, type)
    known = {f.name: f for f in fields(target)}
    hints = typing.get_type_hints(type(target))
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
            choices = f"did you mean {prefix}{near[0]}?" if near else f"known here: {_some(known)}"
            raise UsageError(f"{where}: unknown key {prefix}{name}", remedy=choices)
        current = getattr(target, name)
        if is_dataclass(current) and not isinstance(current, type):
            if not isinstance(value, dict):
                raise UsageError(f"{where}: {name}: expected a table, got {value!r}")
            changes[name] = _merge(current, value, where=where, prefix=f"{name}.")
        else:
            changes[name] = _checked(value, hints[name], f"{where}: {prefix}{name}")
    return replace(target, **changes)


def _some(names: typing.Collection[str]) -> str:
    """The first eight; the rest is in docs/config.md."""
    return ", ".join(list(names)[:8]) + (", ... (docs/config.md has all)" if len(names) > 8 else "")


def _checked(value: Any, hint: Any, where: str) -> Any:
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if isinstance(value, list) and tuple[float, ...] in options:
        return tuple(_checked(item, float, f"{where}[{index}]") for index, item in enumerate(value))
    if float in options and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not any(type(value) is option for option in options):
        names = " or ".join(getattr(option, "__name__", str(option)) for option in options)
        raise UsageError(f"{where}: expected {names}, got {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise UsageError(f"{where}: expected a finite number, got {value}")
    return value
