"""Numbers of the map and of the distances to it: III-B to III-D."""

import math
from dataclasses import dataclass
from typing import Annotated

from splatctrl_cli.config.declared import OneOf, Section, Within, check

MOST_ITERATIONS = 1_000_000  # of an optimiser: hours


@dataclass(frozen=True, kw_only=True)
class SceneConfig(Section, section="scene"):
    """III-B and III-C: splats, losses, add and relocate."""

    max_splats: Annotated[int, Within(1, 10_000_000, "", "IV-C; ten million take 2 GB")] = 5000
    initial_opacity: Annotated[float, Within(0.001, 0.99, "", "III-C; its logit must be finite")] = 0.5
    min_radius: Annotated[float, Within(1e-5, 1, "m", "finer than a depth camera resolves")] = 0.002
    max_radius: Annotated[
        float, Within(1e-4, 1, "m", "r_max; the paper gives none, one voxel; a metre suits a building at most")
    ] = 0.02
    lambda_dssim: Annotated[float, Within(0, 1, "", "III-C, eq. 4: a share")] = 0.2
    lambda_color: Annotated[float, Within(0, 1000, "", "weight of the colour loss")] = 1.0
    lambda_depth: Annotated[float, Within(0, 1000, "", "weight of the depth loss")] = 1.0
    lambda_reg: Annotated[
        float, Within(0, 100, "", "of the mean opacity; 0.02 in the paper loses 0.3 dB on views held out")
    ] = 0.005
    background: Annotated[
        str, OneOf(("median", "black"), "behind the splats: the colour of what has no depth, or black")
    ] = "median"
    lambda_opacity: Annotated[
        float, Within(0, 100, "", "of the mean transmittance where there is depth; 0 in the paper")
    ] = 0.1
    depth_loss: Annotated[
        str,
        OneOf(
            ("normalised", "printed"), "by accumulated opacity; the printed one (eq. 3) sets surfaces 12 mm too deep"
        ),
    ] = "normalised"
    lambda_mde: Annotated[
        float, Within(0, 1e6, "", "III-C eq. 5 gives none; its source (SplaTAM) uses 50; the ceiling below limits it")
    ] = 50.0
    min_depth_error: Annotated[
        float, Within(0, 10, "m", "floor of lambda_mde * MDE, so that a perfect map is not re-seeded")
    ] = 0.02
    max_depth_error: Annotated[
        float, Within(1e-4, 1e9, "m", "ceiling of it: above, a box on a table would never be added; 1e9: none")
    ] = 0.04
    hole_opacity: Annotated[
        float, Within(0, 1, "", "accumulated opacity below which a pixel is a hole in the map")
    ] = 0.5
    min_opacity: Annotated[float, Within(1e-4, 0.9, "", "III-C, alpha_min; 1/255 shows no more")] = 0.1
    radius_per_edge: Annotated[
        float, Within(0.05, 5, "", "of a seed, in edges of its cube; far from 1/2 cubes are bare, or one is a scene")
    ] = 0.45
    max_gap: Annotated[
        float,
        Within(0, 1e9, "m", "from a measured point to the nearest splat's sphere; beyond, one is added; 1e9: none"),
    ] = 0.018
    contact_radius: Annotated[
        float, Within(0.001, 0.1, "m", "of objects' splats within 2 cm of the moving robot, which hides contact")
    ] = 0.010
    gap_reserve: Annotated[float, Within(0, 1, "", "share of the budget that only such gaps may use")] = 0.02
    when_idle: Annotated[
        str,
        OneOf(("detail", "clone", "leave"), "refining with nothing to add: seed where colours are wrong, or as said"),
    ] = "detail"
    weak_share: Annotated[
        float, Within(0, 1, "", "of the splats, those that show least, given up for such detail after each block")
    ] = 0.03
    fill: Annotated[
        float,
        Within(1e-3, 1, "", "share of the budget that the first time step may use; all where nothing comes later"),
    ] = 0.85
    iterations_per_step: Annotated[int, Within(0, MOST_ITERATIONS, "", "K optimiser steps per time step")] = 30
    first_iterations: Annotated[int, Within(0, MOST_ITERATIONS, "", "optimiser steps on the first time step")] = 300
    coarse_share: Annotated[float, Within(0, 1, "", "of them, on images of half the size")] = 0.0
    refine_iterations: Annotated[
        int,
        Within(0, MOST_ITERATIONS, "", "more of them, with annealed rates, where nothing moves (an image folder)"),
    ] = 2000
    lr_center: Annotated[float, Within(0, 1, "m", "of one optimiser step")] = 2e-4
    lr_log_radius: Annotated[float, Within(0, 1, "", "of one optimiser step")] = 6e-3
    lr_color: Annotated[float, Within(0, 1, "", "of one optimiser step; colours go from 0 to 1")] = 1e-2
    lr_logit_opacity: Annotated[float, Within(0, 10, "", "of one optimiser step")] = 5e-2
    refine_geometry: Annotated[
        float, Within(0, 1000, "", "factor on the rates of centre and radius while refining")
    ] = 5.0
    final_rate: Annotated[float, Within(1e-6, 1, "", "share of the learning rates left at the end of refining")] = 0.1
    noise: Annotated[float, Within(0, 1e9, "", "lambda_noise of 3DGS-MCMC; a step is capped at half a radius")] = 5e5
    window: Annotated[
        int, Within(0, 1000, "", "keyframes kept beside the newest frame of each camera; 3 GB at the most")
    ] = 12
    keyframe_distance: Annotated[
        float, Within(0, 100, "m", "a camera that moved further than this makes a keyframe")
    ] = 0.05
    keyframe_angle: Annotated[float, Within(0, 180, "deg", "or turned further than this")] = 5.0
    snapshot_every: Annotated[int, Within(1, 1_000_000, "", "time steps between snapshots")] = 1
    snapshot_period: Annotated[
        float, Within(0, 86_400, "s", "of the log between snapshots, beside snapshot_every; 0: no matter")
    ] = 0.0
    checkpoint_period: Annotated[
        float,
        Within(0, 86_400, "s", "between checkpoints, or 50 times what one takes to write; 0: each time step"),
    ] = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.min_radius, self.max_radius
        check(low <= high, "scene.min_radius", f"at most scene.max_radius = {high:g} m", low)
        low, high = self.min_depth_error, self.max_depth_error
        check(low <= high, "scene.min_depth_error", f"at most scene.max_depth_error = {high:g} m", low)


@dataclass(frozen=True, kw_only=True)
class GaussianConfig(Section, section="gaussians"):
    """The baseline, `reconstruct --method 3dgs`: 3D Gaussian splatting (Kerbl et al. 2023), with its numbers. Shares
    are of `iterations`, of which it had 30,000.
    """

    iterations: Annotated[int, Within(0, MOST_ITERATIONS, "", "optimiser steps")] = 3000
    max_gaussians: Annotated[int, Within(1, 10_000_000, "", "3DGS has no limit; ten million take 7 GB")] = 500_000
    max_degree: Annotated[int, Within(0, 3, "", "of the spherical harmonics")] = 3
    degree_every: Annotated[
        float, Within(0, 1, "", "share of the iterations after which the degree rises by one")
    ] = 1 / 30
    initial_opacity: Annotated[float, Within(0.001, 0.99, "", "its logit must be finite")] = 0.1
    lr_center: Annotated[float, Within(1e-12, 1, "", "times the extent of the scene")] = 1.6e-4
    lr_center_final: Annotated[float, Within(1e-12, 1, "", "at the end; falls exponentially")] = 1.6e-6
    lr_log_scale: Annotated[float, Within(0, 1, "", "of one optimiser step")] = 5e-3
    lr_quat: Annotated[float, Within(0, 1, "", "of one optimiser step")] = 1e-3
    lr_color: Annotated[float, Within(0, 1, "", "of the constant harmonic")] = 2.5e-3
    lr_harmonics: Annotated[float, Within(0, 1, "", "of the others, a twentieth")] = 1.25e-4
    lr_logit_opacity: Annotated[float, Within(0, 10, "", "of one optimiser step")] = 5e-2
    densify_from: Annotated[
        int, Within(0, MOST_ITERATIONS, "", "iterations before the first round of adding and removing")
    ] = 500
    densify_until: Annotated[float, Within(0, 1, "", "share of the iterations after which their number is fixed")] = (
        0.5
    )
    densify_every: Annotated[int, Within(1, MOST_ITERATIONS, "", "iterations between rounds")] = 100
    densify_gradient: Annotated[
        float,
        Within(0, 1, "", "mean screen gradient, in half images, from which a Gaussian is cloned or split"),
    ] = 2e-4
    dense_share: Annotated[
        float,
        Within(0, 1, "", "of the scene's extent: a Gaussian up to this size is cloned, a larger one split"),
    ] = 0.01
    split_shrink: Annotated[
        float, Within(1, 10, "", "the sigmas of a split Gaussian's parts are divided by this")
    ] = 1.6
    min_opacity: Annotated[float, Within(1e-4, 0.9, "", "a fainter one is removed")] = 0.005
    max_screen_radius: Annotated[
        float, Within(1, 100_000, "px", "a larger one is removed once opacities have been reset")
    ] = 20.0
    max_size_share: Annotated[float, Within(1e-3, 100, "", "of the scene's extent: the same for sigmas")] = 0.1
    reset_every: Annotated[
        float,
        Within(0, 1, "", "share of the iterations after which opacities are reset; 0.1 of few costs over 1 dB"),
    ] = 0.0
    reset_opacity: Annotated[float, Within(1e-4, 0.9, "", "what they are reset to")] = 0.01


@dataclass(frozen=True, kw_only=True)
class OccupancyConfig(Section, section="occupancy"):
    """III-C: occupancy grid, free-space filter, robot labels."""

    voxel: Annotated[
        float, Within(0.001, 0.5, "m", "at least the largest radius; larger than an arm is thick, all would be known")
    ] = 0.02
    free_below: Annotated[float, Within(0.01, 0.99, "", "III-C")] = 0.3
    occupied_above: Annotated[float, Within(0.01, 0.99, "", "III-C")] = 0.7
    rule: Annotated[str, OneOf(("observed", "literal"), "literal: all below occupied_above goes, seen or not")] = (
        "observed"
    )
    log_odds_hit: Annotated[float, Within(0.01, 10, "", "of a ray that ends; 10 is as good as certain")] = 0.85
    log_odds_miss: Annotated[float, Within(-10, -0.01, "", "of a ray that passes")] = -0.4
    log_odds_limit: Annotated[
        float, Within(0.01, 100, "", "three cameras turn a full voxel free in two time steps")
    ] = 2.0
    min_range: Annotated[float, Within(0, 10, "m", "nearer depth is what carries the camera, or noise")] = 0.2
    max_range: Annotated[
        float, Within(0.01, 100, "m", "farther depth is no hit, it frees what is nearer; no camera sees further")
    ] = 3.0
    see_through: Annotated[
        float,
        Within(0, 1e9, "m", "by which a splat must stand before all depth around its pixel to float; 1e9: none does"),
    ] = 0.015
    uncertain_patience: Annotated[
        int, Within(0, 1_000_000, "", "time steps a splat may stand in uncertain voxels")
    ] = 10
    self_mask_tolerance: Annotated[
        float, Within(0, 0.1, "m", "of calibration: how far the robot may be from where its joints put it")
    ] = 0.004
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

    memory: Annotated[
        float, Within(0, 3600, "s", "a human label lasts where nobody looks; at 1.6 m/s a person is 8 m further")
    ] = 5.0


@dataclass(frozen=True, kw_only=True)
class FieldConfig(Section, section="field"):
    """III-D: distance field."""

    distance: Annotated[
        str,
        OneOf(
            ("safe", "safe_gpdf", "hard", "se", "gpdf"), "min(se, hard), min(gpdf, hard), or one; gpdf the paper's"
        ),
    ] = "safe"
    weights: Annotated[
        str,
        OneOf(("rowsum", "voxel", "cg"), "eq. 15; density on a voxel grid (III-D); the full GP of eq. 8"),
    ] = "rowsum"
    length_scale: Annotated[
        float,
        Within(1e-10, 1000, "m", "l, IV-C; Table I goes down to 1e-10, and a kilometre is wider than any scene"),
    ] = 0.02
    noise: Annotated[float, Within(0, 1, "", "epsilon of eq. 8; 1 is as much as a splat weighs")] = 1e-6
    truncation: Annotated[
        float,
        Within(1e-12, 0.01, "m", "by how much leaving out or merging small terms may change a kernel distance"),
    ] = 5e-5
    unknown: Annotated[str, OneOf(("free", "obstacle", "nan"), "never-seen space")] = "free"
    probability: Annotated[
        str,
        OneOf(("calibrated", "paper"), "of collision, Phi((error_mean - sdf) / error); or eq. 13 and 14, a score"),
    ] = "calibrated"
    error_mean: Annotated[
        float,
        Within(-0.1, 0.1, "m", "what the calibrated form takes off sdf, measured near solids as error was"),
    ] = 0.0015
    error: Annotated[
        float, Within(1e-5, 1, "m", "sigma of the calibrated form: splats 1 to 2 cm apart, 2 mm of noise")
    ] = 0.002
    voxel: Annotated[
        float, Within(1e-6, 10, "m", "IV-B; 10 m suits a hall; `max_loss` refuses what is too coarse to judge an arm")
    ] = 0.02
    padding: Annotated[float, Within(0, 10, "m", "around the splats where no workspace is given")] = 0.20
    max_loss: Annotated[
        float,
        Within(1e-3, 1, "m", "baking refuses cells whose largest loss by interpolation is above; 2 cm cells keep it"),
    ] = 0.04
