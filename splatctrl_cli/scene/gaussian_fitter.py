"""3D Gaussian splatting (Kerbl et al. 2023) on RGB-D views: the baseline of the fixed-budget method.

It shares seeds, targets, loss and rasteriser with `SceneFitter`; what differs is the method.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import Config, GaussianConfig, SceneConfig
from splatctrl_cli.errors import InputError
from splatctrl_cli.kernels import num_threads
from splatctrl_cli.kernels.gaussians import GaussianArrays, GaussianRasteriser, GaussianRates, gaussian_step
from splatctrl_cli.kernels.raster import ImageLoss, LossTerms, empty_planes
from splatctrl_cli.records import Box, Float32, GaussianSet, RgbdFrame
from splatctrl_cli.scene.buffer import Seeds
from splatctrl_cli.scene.densify import Densified, densify, fresh, reset_opacity
from splatctrl_cli.scene.gaussians import gaussians_of, seeded
from splatctrl_cli.scene.keyframes import View, make_view, seen_through
from splatctrl_cli.scene.mounted import background_color, mounted_pixels, spread_views
from splatctrl_cli.scene.render import loss_weights, mean_loss, psnr_of
from splatctrl_cli.scene.seeding import candidates, density_for, inside_workspace, seeds_at, world_points

NOTHING_DONE = Densified(cloned=0, split=0, unmet=0, pruned=dict.fromkeys(("broken", "opacity", "screen", "size"), 0))


@dataclass(frozen=True, kw_only=True)
class GaussianAuditRow:
    """What happened up to `iteration`: number of Gaussians then, loss (image part of eq. 4) and PSNR [dB] over the
    iterations since the row before, and what densification did. The last row's figures are of the finished set over
    all views.
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
    """Fits a growing set of anisotropic Gaussians to views of a scene that stands still.

    The same views and seed give the same bytes at any thread count. Raises InputError where no view has a depth
    inside the workspace: the first Gaussians come from there.
    """

    def __init__(
        self, config: Config, workspace: Box, frames: Sequence[RgbdFrame], *, seed: int = 0, threads: int = 0
    ) -> None:
        self.config = config
        self.seed = seed
        self.num_threads = num_threads(threads)
        self.views = _views(frames, workspace, config.occupancy.min_range)
        self.background = _background(self.views, config.scene)
        self.extent = scene_extent(frames)
        seeds = first_seeds(self.views, config)
        if not len(seeds):
            raise InputError(
                "no pixel of any view has a depth inside the workspace",
                remedy="give a --box that holds what the cameras saw; 'splatctrl info' says where they stand",
            )
        self.arrays: GaussianArrays = fresh(seeded(seeds, config.gaussians.initial_opacity))
        self.num_iterations = 0
        self._raster = GaussianRasteriser(self.num_threads)
        self._loss = ImageLoss(self.num_threads)
        self._terms: list[LossTerms] = []
        self._was_reset = False

    @property
    def degree(self) -> int:
        """Of the harmonics in use: it rises with the iterations."""
        g = self.config.gaussians
        return min(int(self.num_iterations / max(g.degree_every * g.iterations, 1.0)), g.max_degree)

    def fit(self, audit: Callable[[GaussianAuditRow], None] = lambda _: None) -> GaussianAuditRow:
        """Run all iterations; `audit` gets a row after each round of densification, and the last one, returned."""
        g = self.config.gaussians
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
        plane_gradients = empty_planes(*view.target.depth.shape)
        weights = loss_weights(self.config.scene, self.background)
        self._terms.append(self._loss.evaluate(planes, view.target, weights, plane_gradients))
        gradients = self._raster.backward(planes, plane_gradients)
        gaussian_step(self._raster, gradients, self.arrays, self._rates())
        self.num_iterations += 1

    def _after_iteration(self, rng: np.random.Generator) -> GaussianAuditRow | None:
        """Densify and reset as the schedule says; the audit row of a round that did."""
        g, done = self.config.gaussians, self.num_iterations
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
        g = self.config.gaussians
        return GaussianRates(
            center=self.extent * center_rate(g, self.num_iterations),
            log_scale=g.lr_log_scale,
            quat=g.lr_quat,
            logit_opacity=g.lr_logit_opacity,
            color=g.lr_color,
            harmonics=g.lr_harmonics,
            regulariser=self.config.scene.lambda_reg / max(len(self.arrays), 1),
        )

    def _evaluate(self, view: View) -> LossTerms:
        self._raster.prepare(view.camera, self.arrays.parameters, self.degree)
        planes = self._raster.forward()
        weights = loss_weights(self.config.scene, self.background)
        return self._loss.evaluate(planes, view.target, weights, empty_planes(*view.target.depth.shape))

    def _row(self, what: Densified, *, opacity_reset: bool) -> GaussianAuditRow:
        loss, psnr = mean_loss(self._terms, self.config.scene), psnr_of(self._terms)
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


def center_rate(config: GaussianConfig, iteration: int) -> float:
    """The learning rate of centres, per metre of extent: from `lr_center` to `lr_center_final`, exponentially."""
    done = min(iteration / max(config.iterations, 1), 1.0)
    return float(config.lr_center ** (1.0 - done) * config.lr_center_final**done)


def scene_extent(frames: Sequence[RgbdFrame]) -> float:
    """1.1 times the largest distance [m] of a camera from the cameras' mean, as 3DGS has it.

    Cameras that stand together say nothing about the scene: then half the median depth, where that is more.
    """
    centers = np.array([frame.T_world_camera[:3, 3] for frame in frames])
    spread = 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    depths = np.concatenate([frame.depth[frame.depth > 0][::16] for frame in frames])
    return max(spread, 0.5 * float(np.median(depths)) if len(depths) else 0.0)


def first_seeds(views: Sequence[View], config: Config) -> Seeds:
    """The seeds that the fixed-budget method takes for an empty map, at most `scene.max_splats`."""
    sources = []
    for view in views:
        found = candidates(view.frame, view.mappable)
        sources.append(found.select(~seen_through(found.points, views, config.occupancy.see_through)))
    no_splats: Float32 = np.zeros((0, 3), np.float32)
    if not any(len(source) for source in sources):
        return Seeds(centers=no_splats, radii=np.zeros(0, np.float32), colors=no_splats)
    density = density_for(sources, config.scene.max_splats, config.scene)
    return seeds_at(sources, no_splats, density, config.scene)


def _views(frames: Sequence[RgbdFrame], workspace: Box, min_range: float) -> list[View]:
    """The frames as the fixed-budget method takes them: without what is mounted on the camera."""
    by_camera = {name: [f for f in frames if f.camera == name] for name in sorted({f.camera for f in frames})}
    mounted = {name: mounted_pixels(spread_views(own), min_range) for name, own in by_camera.items()}
    return [
        make_view(frame, inside_workspace(frame, world_points(frame), workspace, min_range), mounted[frame.camera])
        for frame in frames
    ]


def _background(views: Sequence[View], config: SceneConfig) -> tuple[float, float, float]:
    if config.background == "black":
        return (0.0, 0.0, 0.0)
    return background_color([view.frame for view in views], [view.target.counted > 0 for view in views])


def _schedule(views: Sequence[View], num_iterations: int, rng: np.random.Generator) -> Iterator[View]:
    """All views in turn, each round in random order."""
    order: list[int] = []
    for _ in range(num_iterations):
        order = order or rng.permutation(len(views)).tolist()
        yield views[order.pop()]
