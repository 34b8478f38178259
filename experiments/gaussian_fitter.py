"""3D Gaussian splatting (Kerbl et al. 2023) on RGB-D views: the baseline of the fixed-budget method.

It shares seeds, targets, loss and rasteriser with `SceneFitter`; only the method differs.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.densify import Densified, GaussianSettings, densify, fresh, reset_opacity
from experiments.gaussian_step import (
    CENTER,
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    NUM_PARAMETERS,
    QUAT,
    GaussianArrays,
    GaussianRates,
    TrainingRasteriser,
    gaussian_step,
)
from splatctrl_cli import Box, Config, InputError, Label
from splatctrl_cli.blocks import (
    Float32,
    GaussianSet,
    ImageLoss,
    LossTerms,
    RgbdFrame,
    SceneFitter,
    SplatSet,
    View,
    loss_weights,
    mean_loss,
    num_threads,
    psnr_of,
)

SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant harmonic
PER_CHANNEL = 16  # harmonics
NOTHING_DONE = Densified(cloned=0, split=0, unmet=0, pruned=dict.fromkeys(("broken", "opacity", "screen", "size"), 0))


@dataclass(frozen=True, kw_only=True)
class GaussianAuditRow:
    """State at `iteration`: number of Gaussians, loss (image part of eq. 4) and PSNR [dB] since the previous row, and
    results of densification. The last row's figures are the finished set's over all views.
    """

    iteration: int
    gaussians: int
    degree: int
    loss: float | None
    psnr: float | None
    cloned: int
    split: int
    unmet: int
    pruned: dict[str, int]
    opacity_reset: bool


class GaussianFitter:
    """Fits a growing set of anisotropic Gaussians to views of a static scene.

    The same views and seed give the same bytes at any thread count. Raises InputError if no view has depth inside the
    workspace, because the first Gaussians need it.
    """

    def __init__(
        self,
        config: Config,
        workspace: Box,
        frames: Sequence[RgbdFrame],
        *,
        settings: GaussianSettings | None = None,
        seed: int = 0,
        threads: int = 0,
    ) -> None:
        self.config = config.scene
        self.settings = settings or GaussianSettings()
        self.seed = seed
        self.num_threads = num_threads(threads)
        first = first_map(config, workspace, frames, seed=seed, threads=threads)
        seeds = first.splats()
        if not len(seeds):
            raise InputError(
                "no pixel of any view has a depth inside the workspace",
                remedy="give a box that holds what the cameras saw; 'splatctrl info' says where they stand",
            )
        self.views = first.window.newest
        self.background = first.descent.background or (0.0, 0.0, 0.0)
        self.extent = scene_extent(frames)
        self.arrays: GaussianArrays = fresh(seeded(seeds, self.settings.initial_opacity))
        self.num_iterations = 0
        self._raster = TrainingRasteriser(self.num_threads)
        self._loss = ImageLoss(self.num_threads)
        self._terms: list[LossTerms] = []
        self._was_reset = False

    @property
    def degree(self) -> int:
        """Of the harmonics in use: it rises with the iterations."""
        g = self.settings
        return min(int(self.num_iterations / max(g.degree_every * g.iterations, 1.0)), g.max_degree)

    def fit(self, audit: Callable[[GaussianAuditRow], None] = lambda _: None) -> GaussianAuditRow:
        """Run all iterations; `audit` gets a row after each round of densification, and the last row, which is
        returned.
        """
        g = self.settings
        rng = np.random.default_rng([self.seed, 0])
        for view in _schedule(self.views, g.iterations, rng):
            self._iterate(view)
            row = self._after_iteration(rng)
            if row is not None:
                audit(row)
        self._terms = [self._evaluate(view) for view in self.views if view.target.counted.any()]
        row = self._row(NOTHING_DONE, opacity_reset=False)
        audit(row)
        return row

    def gaussians(self) -> GaussianSet:
        """The set as it is now."""
        return gaussians_of(self.arrays.parameters, self.degree)

    def _iterate(self, view: View) -> None:
        self._raster.prepare(view.camera, self.arrays.parameters, self.degree)
        planes = self._raster.forward()
        plane_gradients = np.empty_like(planes)
        weights = loss_weights(self.config, self.background)
        self._terms.append(self._loss.evaluate(planes, view.target, weights, plane_gradients))
        gradients = self._raster.backward(planes, plane_gradients)
        gaussian_step(self._raster, gradients, self.arrays, self._rates())
        self.num_iterations += 1

    def _after_iteration(self, rng: np.random.Generator) -> GaussianAuditRow | None:
        """Densify and reset by the schedule; return the audit row of a round that did."""
        g, done = self.settings, self.num_iterations
        last = g.densify_until * g.iterations
        is_growing = done < last
        densifies = is_growing and done >= min(g.densify_from, last / 2) and done % g.densify_every == 0
        every = round(g.reset_every * g.iterations)
        resets = is_growing and every > 0 and done % every == 0
        if not densifies and not resets:
            return None
        what = NOTHING_DONE
        if densifies:
            self.arrays, what = densify(self.arrays, g, self.extent, rng, prunes_large=self._was_reset)
        if resets:
            reset_opacity(self.arrays, g.reset_opacity)
            self._was_reset = True
        return self._row(what, opacity_reset=resets)

    def _rates(self) -> GaussianRates:
        g = self.settings
        return GaussianRates(
            center=self.extent * center_rate(g, self.num_iterations),
            log_scale=g.lr_log_scale,
            quat=g.lr_quat,
            logit_opacity=g.lr_logit_opacity,
            color=g.lr_color,
            harmonics=g.lr_harmonics,
            regulariser=self.config.lambda_reg / max(len(self.arrays), 1),
        )

    def _evaluate(self, view: View) -> LossTerms:
        self._raster.prepare(view.camera, self.arrays.parameters, self.degree)
        planes = self._raster.forward()
        weights = loss_weights(self.config, self.background)
        return self._loss.evaluate(planes, view.target, weights, np.empty_like(planes))

    def _row(self, what: Densified, *, opacity_reset: bool) -> GaussianAuditRow:
        loss, psnr = mean_loss(self._terms, self.config), psnr_of(self._terms)
        self._terms = []
        return GaussianAuditRow(
            iteration=self.num_iterations,
            gaussians=len(self.arrays),
            degree=self.degree,
            loss=None if loss is None else round(loss, 6),
            psnr=None if psnr is None else round(psnr, 4),
            cloned=what.cloned,
            split=what.split,
            unmet=what.unmet,
            pruned=what.pruned,
            opacity_reset=opacity_reset,
        )


def center_rate(settings: GaussianSettings, iteration: int) -> float:
    """The learning rate of centres, per metre of extent: from `lr_center` to `lr_center_final`, exponentially."""
    done = min(iteration / max(settings.iterations, 1), 1.0)
    return float(settings.lr_center ** (1.0 - done) * settings.lr_center_final**done)


def scene_extent(frames: Sequence[RgbdFrame]) -> float:
    """1.1 times the largest distance [m] of a camera from the cameras' mean, as 3DGS has it.

    Cameras close together do not show the scene's size; then it is half the median depth, if larger.
    """
    centers = np.array([frame.T_world_camera[:3, 3] for frame in frames])
    spread = 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    depths = np.concatenate([frame.depth[frame.depth > 0][::16] for frame in frames])
    return max(spread, 0.5 * float(np.median(depths)) if len(depths) else 0.0)


def first_map(
    config: Config, workspace: Box, frames: Sequence[RgbdFrame], *, seed: int = 0, threads: int = 0
) -> SceneFitter:
    """The fixed-budget method after a time step without iterations: seeds for all of `scene.max_splats`, the views as
    it takes them, and the background.
    """
    scene = config.scene.derived(first_iterations=0, fill=1.0, gap_reserve=0.0, max_gap=1e9)
    fitter = SceneFitter(scene, config.occupancy, workspace, seed=seed, threads=threads)
    fitter.step(frames)
    return fitter


def seeded(seeds: SplatSet, opacity: float) -> Float32:
    """Parameters (N, 59) of isotropic seeds as Gaussians of one colour."""
    rows = np.zeros((len(seeds), NUM_PARAMETERS), np.float32)
    rows[:, CENTER] = seeds.centers
    rows[:, LOG_SCALE] = np.log(seeds.radii)[:, None]
    rows[:, QUAT.start] = 1.0
    rows[:, LOGIT] = np.log(opacity / (1.0 - opacity))
    rows[:, HARMONICS.start :: PER_CHANNEL] = (seeds.colors - 0.5) / SH_C0
    return rows


def gaussians_of(parameters: Float32, degree: int) -> GaussianSet:
    """The splats of parameters (N, 59), with harmonics up to `degree`; all have the label object."""
    quats = parameters[:, QUAT].astype(np.float64)
    harmonics = parameters[:, HARMONICS].reshape(-1, 3, PER_CHANNEL)[:, :, : (degree + 1) ** 2]
    return GaussianSet(
        centers=parameters[:, CENTER].copy(),
        scales=np.exp(parameters[:, LOG_SCALE]),
        quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacities=(1.0 / (1.0 + np.exp(-parameters[:, LOGIT].astype(np.float64)))).astype(np.float32),
        harmonics=np.ascontiguousarray(np.moveaxis(harmonics, 1, 2)),
        labels=np.full(len(parameters), Label.OBJECT, np.uint8),
    )


def _schedule(views: Sequence[View], num_iterations: int, rng: np.random.Generator) -> Iterator[View]:
    """All views in turn, each round in random order."""
    order: list[int] = []
    for _ in range(num_iterations):
        order = order or rng.permutation(len(views)).tolist()
        yield views[order.pop()]
