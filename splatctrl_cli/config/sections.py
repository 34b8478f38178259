"""Numbers of the method by section: map and distances (III-B to III-D), control, planner and verdict (III-E)."""

import math
from dataclasses import dataclass
from typing import Annotated

from splatctrl_cli.config.ranges import MAX_SEED, OneOf, Section, Within, check

MOST_ITERATIONS = 1_000_000  # of an optimiser: hours


@dataclass(frozen=True, kw_only=True)
class SceneConfig(Section, section="scene"):
    """III-B and III-C: splats, losses, add and relocate."""

    max_splats: Annotated[int, Within(1, 10_000_000, "", "budget of splats (IV-C); ten million take 2 GB")] = 5000
    initial_opacity: Annotated[float, Within(0.001, 0.99, "", "opacity of a new splat (III-C)")] = 0.5
    min_radius: Annotated[float, Within(1e-5, 1, "m", "least radius; finer than a depth camera resolves")] = 0.002
    max_radius: Annotated[float, Within(1e-4, 1, "m", "r_max, one voxel; the paper gives none")] = 0.02
    scale: Annotated[
        float,
        Within(
            1e-3,
            1e6,
            "",
            "factor on the default lengths of the map; 1: a table at arm's length (the paper); 0: chosen by the"
            " recording's depth, with a robot 1",
            or_zero=True,
        ),
    ] = 0.0
    radius_depth: Annotated[
        float,
        Within(
            1e-3,
            1e9,
            "m",
            "depth at which the largest radius is max_radius; it grows with depth; 0: the same at every depth (with"
            " scale 0: the recording's median)",
            or_zero=True,
        ),
    ] = 0.0
    lambda_dssim: Annotated[float, Within(0, 1, "", "share of D-SSIM in the colour loss (eq. 4)")] = 0.2
    lambda_color: Annotated[float, Within(0, 1000, "", "weight of the colour loss")] = 1.0
    lambda_depth: Annotated[float, Within(0, 1000, "", "weight of the depth loss")] = 1.0
    lambda_reg: Annotated[float, Within(0, 100, "", "weight of the mean opacity; the paper's 0.02 costs 0.3 dB")] = (
        0.005
    )
    shell: Annotated[
        float,
        Within(
            0,
            1,
            "",
            "share of max_splats for background, which is only rendered: added to them beyond a robot's reach, part"
            " of them for pixels without depth in still pictures",
        ),
    ] = 0.1
    background: Annotated[
        str, OneOf(("median", "black"), "colour behind the splats: median of pixels without depth nearby, or black")
    ] = "median"
    lambda_opacity: Annotated[
        float, Within(0, 100, "", "weight of the mean transmittance at depth; not in the paper")
    ] = 0.1
    depth_loss: Annotated[
        str,
        OneOf(
            ("normalised", "printed"),
            "depth divided by accumulated opacity, or eq. 3 as printed, which puts surfaces 12 mm too deep",
        ),
    ] = "normalised"
    lambda_mde: Annotated[float, Within(0, 1e6, "", "factor on the median depth error in eq. 5 (SplaTAM: 50)")] = 50.0
    min_depth_error: Annotated[
        float, Within(0, 10, "m", "least threshold of eq. 5, so that a perfect map is left alone")
    ] = 0.02
    max_depth_error: Annotated[
        float, Within(1e-4, 1e9, "m", "largest threshold of eq. 5, so that new objects are seeded; 1e9: no limit")
    ] = 0.04
    hole_opacity: Annotated[float, Within(0, 1, "", "a pixel of less accumulated opacity is a hole in the map")] = 0.5
    min_opacity: Annotated[float, Within(1e-4, 0.9, "", "splats of lower opacity are removed: alpha_min (III-C)")] = (
        0.1
    )
    radius_per_edge: Annotated[float, Within(0.05, 5, "", "radius of a seed, in edges of its cube")] = 0.45
    max_gap: Annotated[
        float,
        Within(0, 1e9, "m", "a measured point farther than this from every splat's sphere gets a splat; 1e9: off"),
    ] = 0.018
    contact_radius: Annotated[
        float,
        Within(
            0.001,
            0.1,
            "m",
            "distance between splats on objects within 2 cm of the moving robot; twice their radius",
        ),
    ] = 0.010
    gap_reserve: Annotated[float, Within(0, 1, "", "share of the budget kept for gaps (max_gap)")] = 0.02
    when_idle: Annotated[
        str,
        OneOf(
            ("detail", "clone", "leave"),
            "when all surface has splats: add some where colours are wrong, clone some, or leave the budget unused",
        ),
    ] = "detail"
    weak_share: Annotated[
        float, Within(0, 1, "", "share of the least visible splats that each refinement block replaces")
    ] = 0.03
    fill: Annotated[float, Within(1e-3, 1, "", "share of the budget for the first of several time steps")] = 0.85
    iterations_per_step: Annotated[int, Within(0, MOST_ITERATIONS, "", "K, optimiser steps per time step")] = 30
    first_iterations: Annotated[int, Within(0, MOST_ITERATIONS, "", "optimiser steps on the first time step")] = 300
    refine_iterations: Annotated[
        int, Within(0, MOST_ITERATIONS, "", "further steps, at falling rates, for recordings without a clock")
    ] = 2000
    lr_center: Annotated[float, Within(0, 1, "m", "learning rate of centres")] = 2e-4
    lr_log_radius: Annotated[float, Within(0, 1, "", "learning rate of log radii")] = 6e-3
    lr_color: Annotated[float, Within(0, 1, "", "learning rate of colours, which go from 0 to 1")] = 1e-2
    lr_logit_opacity: Annotated[float, Within(0, 10, "", "learning rate of opacity logits")] = 5e-2
    refine_geometry: Annotated[float, Within(0, 1000, "", "factor on rates of centre and radius in refining")] = 5.0
    refine_depth: Annotated[float, Within(0, 1000, "", "factor on lambda_depth at the end of refining")] = 3.0
    final_rate: Annotated[float, Within(1e-6, 1, "", "share of the learning rates left at the end of refining")] = 0.1
    noise: Annotated[float, Within(0, 1e9, "", "lambda_noise of 3DGS-MCMC; a step is at most half a radius")] = 5e5
    window: Annotated[int, Within(0, 1000, "", "keyframes besides the newest frames; 1000 take 3 GB")] = 12
    keyframe_distance: Annotated[float, Within(0, 100, "m", "a camera that moved farther makes a keyframe")] = 0.05
    keyframe_angle: Annotated[float, Within(0, 180, "deg", "a camera that turned farther makes a keyframe")] = 5.0
    snapshot_every: Annotated[
        int, Within(1, 1_000_000, "", "time steps between snapshots; what shows something new leaves one, too")
    ] = 1
    snapshot_period: Annotated[
        float, Within(0, 86_400, "s", "least time of the log between snapshots; 0: only snapshot_every counts")
    ] = 0.0
    checkpoint_period: Annotated[
        float,
        Within(
            0, 86_400, "s", "time between checkpoints, at least 50 times what one takes to write; 0: every time step"
        ),
    ] = 10.0

    ordered = (("min_radius", "max_radius"), ("min_depth_error", "max_depth_error"))


@dataclass(frozen=True, kw_only=True)
class OccupancyConfig(Section, section="occupancy"):
    """III-C: occupancy grid, free-space filter, robot labels."""

    voxel: Annotated[float, Within(0.001, 0.5, "m", "edge of a voxel; at least the largest radius")] = 0.02
    free_below: Annotated[float, Within(0.01, 0.99, "", "occupancy below which a voxel is free (III-C)")] = 0.3
    occupied_above: Annotated[float, Within(0.01, 0.99, "", "occupancy above which a voxel is occupied (III-C)")] = (
        0.7
    )
    rule: Annotated[
        str,
        OneOf(
            ("observed", "literal"), "literal: splats in every voxel below occupied_above are removed, seen or not"
        ),
    ] = "observed"
    log_odds_hit: Annotated[float, Within(0.01, 10, "", "added to a voxel that holds a measured point")] = 0.85
    log_odds_miss: Annotated[float, Within(-10, -0.01, "", "added to a voxel that a ray passes")] = -0.4
    log_odds_limit: Annotated[
        float, Within(0.01, 100, "", "largest log odds of a voxel; three cameras free a full voxel in two time steps")
    ] = 2.0
    min_range: Annotated[float, Within(0, 10, "m", "nearer depth is ignored: a wrist camera's gripper, or noise")] = (
        0.2
    )
    max_range: Annotated[
        float, Within(0.01, 100, "m", "farther depth occupies no voxel, but frees those before it")
    ] = 3.0
    see_through: Annotated[
        float, Within(0, 1e9, "m", "a splat this far before all depth around its pixel is removed; 1e9: off")
    ] = 0.015
    uncertain_patience: Annotated[int, Within(0, 1_000_000, "", "time steps a splat may be in uncertain voxels")] = 10
    self_mask_tolerance: Annotated[
        float, Within(0, 0.1, "m", "distance between the robot's measured and modelled surface that is accepted")
    ] = 0.004
    depth_error: Annotated[
        float, Within(0, 0.1, "m", "sigma of depth at 1 m, growing with its square: 0.05 px of a D435's disparity")
    ] = 0.0015

    ordered = (("free_below", "occupied_above"),)

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.min_range, self.max_range
        check(low < high, "occupancy.max_range", f"above occupancy.min_range = {low:g} m", high)
        needed = max(math.log(p / (1 - p)) for p in (self.occupied_above, 1 - self.free_below))
        expected = f"above {needed:.3g}, the log-odds of the thresholds"  # which a voxel must be able to pass
        check(self.log_odds_limit > needed, "occupancy.log_odds_limit", expected, self.log_odds_limit)


@dataclass(frozen=True, kw_only=True)
class HumanConfig(Section, section="human"):
    """People, whom masks of the images show."""

    memory: Annotated[float, Within(0, 3600, "s", "how long a human label lasts where no camera looks")] = 5.0


@dataclass(frozen=True, kw_only=True)
class FieldConfig(Section, section="field"):
    """III-D: distance field."""

    distance: Annotated[
        str,
        OneOf(
            ("safe", "safe_gpdf", "hard", "se", "gpdf"),
            "min(se, hard), min(gpdf, hard), or a single one; gpdf is the paper's",
        ),
    ] = "safe"
    weights: Annotated[
        str,
        OneOf(
            ("rowsum", "voxel", "cg"), "row sums (eq. 15), density on a voxel grid (III-D), or the full GP (eq. 8)"
        ),
    ] = "rowsum"
    length_scale: Annotated[float, Within(1e-10, 1000, "m", "l of the kernel (IV-C); Table I ends at 1e-10")] = 0.02
    noise: Annotated[float, Within(0, 1, "", "epsilon of eq. 8")] = 1e-6
    truncation: Annotated[
        float, Within(1e-12, 0.01, "m", "largest error of a kernel distance by leaving out or merging small terms")
    ] = 5e-5
    unknown: Annotated[str, OneOf(("free", "obstacle", "nan"), "what never-seen space counts as")] = "free"
    probability: Annotated[
        str,
        OneOf(
            ("calibrated", "paper"),
            "collision probability: Phi((error_mean - sdf) / error), or the score of eq. 13 and 14",
        ),
    ] = "calibrated"
    error_mean: Annotated[float, Within(-0.1, 0.1, "m", "mean error of sdf near solids (calibrated form)")] = 0.0015
    error: Annotated[
        float,
        Within(1e-5, 1, "m", "standard deviation of that error; measured for splats 1 to 2 cm apart, 2 mm of noise"),
    ] = 0.002
    voxel: Annotated[float, Within(1e-6, 10, "m", "edge of a cell (IV-B)")] = 0.02
    padding: Annotated[
        float, Within(0, 10, "m", "space around the splats in the grid, without a given workspace")
    ] = 0.20
    max_loss: Annotated[float, Within(1e-3, 1, "m", "largest loss by interpolation; 2 cm cells keep it")] = 0.04


@dataclass(frozen=True, kw_only=True)
class ControlConfig(Section, section="control"):
    """III-E: QP inverse kinematics with control barrier functions."""

    program: Annotated[
        str, OneOf(("reduced", "printed"), "reduced form, or that of III-E as printed, without checking the step")
    ] = "reduced"
    solver: Annotated[str, OneOf(("clarabel", "daqp"), "solver of the QP; daqp is several times as fast")] = (
        "clarabel"
    )
    margin: Annotated[float, Within(0, 1, "m", "epsilon, the clearance to keep (IV-C)")] = 0.02
    human_margin: Annotated[float, Within(0, 2, "m", "clearance to keep from people, if larger than margin")] = 0.0
    coverage: Annotated[
        str,
        OneOf(("report", "margin"), "robot surface outside the spheres: report it, or keep that much more clearance"),
    ] = "report"
    period: Annotated[float, Within(1e-4, 0.1, "s", "dt of a step; the paper solves at more than 100 Hz")] = 0.01
    barrier_gain: Annotated[
        float,
        Within(1e-3, 10_000, "1/s", "alpha of every limit and barrier row; the printed 1 takes 1.4 times as long"),
    ] = 10.0
    self_margin: Annotated[float, Within(0, 0.5, "m", "clearance of the self-collision rows (III-E)")] = 0.02
    weight_linear: Annotated[float, Within(1e-9, 1e9, "", "Q of III-E, linear part; the paper gives no weights")] = (
        10.0
    )
    weight_angular: Annotated[float, Within(1e-9, 1e9, "", "Q of III-E, angular part")] = 1.0
    weight_kinematics: Annotated[float, Within(1e-6, 1e9, "", "R of III-E in Q: (1/Q + 1/R)^-1 is 0.99 Q")] = 100.0
    weight_slack: Annotated[float, Within(1e-6, 1e9, "", "S of III-E")] = 100.0
    slack_cost: Annotated[
        float,
        Within(1e-3, 1e9, "1/(m/s)", "linear cost of a slack; above every multiplier met, so the slack is exact"),
    ] = 1e3
    self_slack_cost: Annotated[
        float, Within(1e-3, 1e9, "1/(m/s)", "linear cost of a slack of self-collision rows, which are relaxed last")
    ] = 1e5
    posture_weight: Annotated[
        float, Within(1e-9, 1e3, "", "lambda, weight on joint velocity (7 joints, 6-D task)")
    ] = 1e-3
    smoothness_weight: Annotated[float, Within(0, 1e3, "", "weight on the change of joint velocity per step")] = 0.0
    posture_gain: Annotated[float, Within(0, 1000, "1/s", "gain towards the home posture")] = 0.5
    pose_gain: Annotated[float, Within(0, 1000, "1/s", "gain from pose error to end-effector velocity")] = 2.0
    max_linear_speed: Annotated[
        float, Within(1e-4, 20, "m/s", "largest speed of the end effector, usual near people")
    ] = 0.25
    max_angular_speed: Annotated[float, Within(1e-4, 50, "rad/s", "largest angular speed of the end effector")] = 1.0
    twist_timeout: Annotated[float, Within(1e-3, 60, "s", "time that a logged twist lasts; then the arm stops")] = 0.5
    max_acceleration: Annotated[
        float | tuple[float, ...],
        Within(
            0.01,
            1000,
            "rad/s^2",
            "largest acceleration of every joint, or one number for each; 0: no limit",
            or_zero=True,
        ),
    ] = 0.0
    velocity_limits: Annotated[
        str, OneOf(("urdf", "fr3"), "fr3: also the published position-dependent limits of the Franka Research 3")
    ] = "urdf"
    distance_rate: Annotated[str, OneOf(("snapshots", "none"), "dd/dt: from the two newest maps, or 0")] = "snapshots"
    max_distance_rate: Annotated[float, Within(0, 20, "m/s", "fastest approach that counts: a walking person")] = 1.6
    max_residual: Annotated[float, Within(1e-12, 1e-2, "", "largest relative KKT residual that is accepted")] = 1e-5
    slack_tolerance: Annotated[float, Within(0, 0.1, "m/s", "a row with more slack counts as relaxed")] = 1e-4
    promise_tolerance: Annotated[
        float,
        Within(0, 0.1, "m", "shortfall of a distance against its row's prediction before the step is scaled back"),
    ] = 1e-4
    limit_tolerance: Annotated[
        float, Within(0, 0.1, "rad", "excess of the start over a joint limit that counts as encoder noise")
    ] = 1e-3
    goal_position: Annotated[float, Within(1e-6, 0.1, "m", "the goal is reached within this distance")] = 0.01
    goal_rotation: Annotated[float, Within(1e-6, 3.15, "rad", "the goal is reached within this angle (1 degree)")] = (
        0.0175
    )
    max_time: Annotated[float, Within(1e-4, 86_400, "s", "longest closed-loop replay")] = 30.0
    stall_time: Annotated[
        float, Within(1e-4, 86_400, "s", "time below stall_speed after which the arm counts as stuck")
    ] = 2.0
    stall_speed: Annotated[float, Within(0, 10, "rad/s", "mean joint speed of a stuck arm")] = 2e-3
    max_cuts: Annotated[
        int, Within(0, 1000, "", "rounds in which rows are added for obstacles that the step would approach")
    ] = 3
    max_detours: Annotated[int, Within(0, 1000, "", "planned paths out of local minima in one closed loop")] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("barrier_gain", "pose_gain", "posture_gain"):  # a gain above 1 / dt overshoots
            gain = getattr(self, name)
            expected = f"at most 1 / control.period = {1 / self.period:g} 1/s"
            check(gain * self.period <= 1 + 1e-9, f"control.{name}", expected, gain)
        own, external = self.self_slack_cost, self.slack_cost
        check(own >= external, "control.self_slack_cost", f"at least control.slack_cost = {external:g} 1/(m/s)", own)
        for name in ("max_time", "stall_time"):
            check(
                getattr(self, name) >= self.period, f"control.{name}", "at least control.period", getattr(self, name)
            )


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(Section, section="planner"):
    """IV: the sampling-based planner (BiRRT), which finds the controller's ways out of local minima."""

    seed: Annotated[int, Within(0, MAX_SEED, "", "seed of samples and shortcuts")] = 0
    goal_postures: Annotated[
        int, Within(1, 1000, "", "configurations searched for a goal pose; a path ends in any of them")
    ] = 8
    contact: Annotated[float, Within(1e-7, 0.1, "m", "clearance above the margin that a configuration needs")] = 1e-4
    batch: Annotated[int, Within(1, 10_000, "", "samples per iteration, whose edges are checked together")] = 8
    reach: Annotated[float, Within(1e-3, 100, "rad", "longest edge towards a sample, in joint space")] = 1.5
    shortest: Annotated[float, Within(1e-6, 10, "rad", "shortest edge worth a node")] = 0.1
    max_iterations: Annotated[
        int, Within(0, 10_000_000, "", "iterations after which a search ends as out-of-iterations")
    ] = 4000
    max_time: Annotated[
        float,
        Within(
            0,
            86_400,
            "s",
            "time after which a search ends as out-of-time; the only limit that depends on the machine",
        ),
    ] = 10.0
    shortcut_rounds: Annotated[int, Within(0, 10_000, "", "rounds of random shortcuts, after the greedy ones")] = 4
    shortcut_batch: Annotated[int, Within(1, 10_000, "", "shortcuts tried per round")] = 8
    max_acceleration: Annotated[
        float, Within(0.01, 1000, "rad/s^2", "acceleration of every joint: the least of the Panda's")
    ] = 7.5
    wait_distance: Annotated[float, Within(1e-4, 10, "m", "the reference waits for an arm this far behind")] = 0.05
    limit_tolerance: Annotated[
        float, Within(0, 0.1, "rad", "excess of a start or goal over a joint limit that counts as encoder noise")
    ] = 1e-3

    ordered = (("shortest", "reach"),)


@dataclass(frozen=True, kw_only=True)
class VerdictConfig(Section, section="verdict"):
    """The evidence that a verdict needs."""

    confidence: Annotated[
        float, Within(0.5, 0.999999, "", "confidence of the bound on the map's error, given enough evidence")
    ] = 0.99
    evidence_reach: Annotated[
        float, Within(0.001, 10, "m", "held-out surface within this distance of the moving spheres is evidence")
    ] = 0.1
    unjudged: Annotated[float, Within(0, 1, "", "share of the requested time that may be unjudged")] = 0.0
    lead_in: Annotated[
        float, Within(0, 10, "s", "time before the first map that may be left out, as logs have joints before images")
    ] = 0.5
    longest_interval: Annotated[
        float, Within(0.001, 10, "s", "longest gap between states over which the arm is assumed to move straight")
    ] = 0.1
