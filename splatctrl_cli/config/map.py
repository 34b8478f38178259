"""Numbers of the map and of the distances to it: III-B to III-D."""

import math
from dataclasses import dataclass
from typing import Annotated

from splatctrl_cli.config.ranges import OneOf, Section, Within, check

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
            "of the map's lengths at their defaults; 1: the paper's table at arm's length; 0: from the recording's"
            " depth, 1 with a robot",
            or_zero=True,
        ),
    ] = 0.0
    radius_depth: Annotated[
        float,
        Within(
            1e-3,
            1e9,
            "m",
            "depth at which a splat may be max_radius large, in proportion elsewhere; 0: everywhere (with scale 0,"
            " the recording's median)",
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
        Within(0, 1, "", "share of max_splats, beside these, for what lies beyond a robot's reach: rendered only"),
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
    lambda_mde: Annotated[float, Within(0, 1e6, "", "factor on the median depth error in eq. 5; 50 is SplaTAM's")] = (
        50.0
    )
    min_depth_error: Annotated[
        float, Within(0, 10, "m", "least threshold of eq. 5, so that a perfect map is left alone")
    ] = 0.02
    max_depth_error: Annotated[
        float, Within(1e-4, 1e9, "m", "largest threshold of eq. 5, so that new objects are seeded; 1e9: no limit")
    ] = 0.04
    hole_opacity: Annotated[float, Within(0, 1, "", "a pixel of less accumulated opacity is a hole in the map")] = 0.5
    min_opacity: Annotated[float, Within(1e-4, 0.9, "", "alpha_min (III-C): fainter splats are removed")] = 0.1
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
            "apart of splats on objects within 2 cm of the moving robot, twice their radius",
        ),
    ] = 0.010
    gap_reserve: Annotated[float, Within(0, 1, "", "share of the budget kept for such gaps")] = 0.02
    when_idle: Annotated[
        str,
        OneOf(
            ("detail", "clone", "leave"),
            "when refining has nothing to add: seed where colours are wrong, clone, or leave dead",
        ),
    ] = "detail"
    weak_share: Annotated[float, Within(0, 1, "", "share of least visible splats that a block seeds anew")] = 0.03
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
    refine_depth: Annotated[float, Within(0, 1000, "", "factor on lambda_depth at the end of refining")] = 2.0
    final_rate: Annotated[float, Within(1e-6, 1, "", "share of the learning rates left at the end of refining")] = 0.1
    noise: Annotated[float, Within(0, 1e9, "", "lambda_noise of 3DGS-MCMC; a step is at most half a radius")] = 5e5
    window: Annotated[int, Within(0, 1000, "", "keyframes kept beside the newest frames; 1000 take 3 GB")] = 12
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

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.min_radius, self.max_radius
        check(low <= high, "scene.min_radius", f"at most scene.max_radius = {high:g} m", low)
        low, high = self.min_depth_error, self.max_depth_error
        check(low <= high, "scene.min_depth_error", f"at most scene.max_depth_error = {high:g} m", low)


@dataclass(frozen=True, kw_only=True)
class OccupancyConfig(Section, section="occupancy"):
    """III-C: occupancy grid, free-space filter, robot labels."""

    voxel: Annotated[float, Within(0.001, 0.5, "m", "edge of a voxel; at least the largest radius")] = 0.02
    free_below: Annotated[float, Within(0.01, 0.99, "", "occupancy below which a voxel is free (III-C)")] = 0.3
    occupied_above: Annotated[float, Within(0.01, 0.99, "", "occupancy above which a voxel is occupied (III-C)")] = (
        0.7
    )
    rule: Annotated[
        str, OneOf(("observed", "literal"), "literal: splats in every voxel below occupied_above go, seen or not")
    ] = "observed"
    log_odds_hit: Annotated[float, Within(0.01, 10, "", "added to a voxel that holds a measured point")] = 0.85
    log_odds_miss: Annotated[float, Within(-10, -0.01, "", "added to a voxel that a ray passes")] = -0.4
    log_odds_limit: Annotated[
        float, Within(0.01, 100, "", "of a voxel's log odds; three cameras free a full voxel in two time steps")
    ] = 2.0
    min_range: Annotated[float, Within(0, 10, "m", "nearer depth is ignored: the camera's own gripper, or noise")] = (
        0.2
    )
    max_range: Annotated[float, Within(0.01, 100, "m", "farther depth is no hit, but frees what is nearer")] = 3.0
    see_through: Annotated[
        float, Within(0, 1e9, "m", "a splat this far before all depth around its pixel is removed; 1e9: off")
    ] = 0.015
    uncertain_patience: Annotated[int, Within(0, 1_000_000, "", "time steps a splat may be in uncertain voxels")] = 10
    self_mask_tolerance: Annotated[float, Within(0, 0.1, "m", "how far off its joints the robot may be seen")] = 0.004
    depth_error: Annotated[
        float, Within(0, 0.1, "m", "sigma of depth at 1 m, growing with its square: 0.05 px of a D435's disparity")
    ] = 0.0015

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.free_below, self.occupied_above
        check(low <= high, "occupancy.free_below", f"at most occupancy.occupied_above = {high:g}", low)
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
        float, Within(1e-12, 0.01, "m", "largest change of a kernel distance by small terms left out or merged")
    ] = 5e-5
    unknown: Annotated[str, OneOf(("free", "obstacle", "nan"), "what never-seen space counts as")] = "free"
    probability: Annotated[
        str,
        OneOf(
            ("calibrated", "paper"), "of collision: Phi((error_mean - sdf) / error), or the score of eq. 13 and 14"
        ),
    ] = "calibrated"
    error_mean: Annotated[float, Within(-0.1, 0.1, "m", "mean error of sdf near solids (calibrated form)")] = 0.0015
    error: Annotated[
        float,
        Within(1e-5, 1, "m", "standard deviation of that error; measured for splats 1 to 2 cm apart, 2 mm of noise"),
    ] = 0.002
    voxel: Annotated[float, Within(1e-6, 10, "m", "edge of a cell (IV-B)")] = 0.02
    padding: Annotated[float, Within(0, 10, "m", "around the splats, where no workspace is given")] = 0.20
    max_loss: Annotated[float, Within(1e-3, 1, "m", "largest loss by interpolation; 2 cm cells keep it")] = 0.04
