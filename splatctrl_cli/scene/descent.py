"""Descent of the loss (eq. 4) over the splats of a buffer."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.kernels.cuda.fit import DeviceFit
from splatctrl_cli.kernels.raster import (
    ImageLoss,
    LossTerms,
    LossWeights,
    OptimiserSettings,
    Rasteriser,
    empty_planes,
    optimiser_step,
    unpack_parameters,
)
from splatctrl_cli.records import Float32, Float64
from splatctrl_cli.scene.buffer import SplatBuffer
from splatctrl_cli.scene.keyframes import View
from splatctrl_cli.scene.removal import Misfit
from splatctrl_cli.scene.render import BLACK, Color, Rendering, loss_weights


class Descent:
    """Optimiser of a buffer's M splats, with noise drawn from seed and iteration.

    background: colour behind the splats, None until chosen. heard: called after each iteration. device: computes
    `run` and `rendering`, or raises DeviceError; None: the processor computes them.
    """

    def __init__(
        self, config: SceneConfig, buffer: SplatBuffer, seed: int, num_threads: int, device: DeviceFit | None = None
    ) -> None:
        self.num_iterations = 0
        self.background: Color | None = None
        self.heard: Callable[[], None] = lambda: None
        self._config, self._buffer, self._seed, self._num_threads = config, buffer, seed, num_threads
        self.device = device
        self._raster = Rasteriser(num_threads)
        self._loss = ImageLoss(num_threads)
        self._gradients: Float32 = np.empty((config.max_splats, 10), np.float32)

    def run(self, views: Sequence[View], settings: OptimiserSettings, depth: float = 1.0) -> dict[int, LossTerms]:
        """Run an iteration on each view; return each view's last losses, by its id.

        depth: factor of the depth loss.
        """
        weights = loss_weights(self._config, self.background or BLACK)
        weights = replace(weights, depth=depth * weights.depth)
        if self.device is not None and views:
            return self._run_on(self.device, views, weights, settings)
        terms = {}
        for view in views:
            planes = self.planes(view)
            plane_gradients = empty_planes(*view.target.depth.shape)
            terms[id(view)] = self._loss.evaluate(planes, view.target, weights, plane_gradients)
            self._raster.backward(planes, plane_gradients, self._gradients)
            optimiser_step(
                self._raster,
                self._gradients,
                self._buffer.parameters,
                self._buffer.moments,
                settings,
                (self._seed << 32) + self.num_iterations,
            )
            self.num_iterations += 1
            self.heard()
        return terms

    def keep(self, views: Sequence[View]) -> None:
        """Drop images of all other views from the device."""
        if self.device is not None:
            self.device.keep([view.target for view in views])

    def _run_on(
        self, device: DeviceFit, views: Sequence[View], weights: LossWeights, settings: OptimiserSettings
    ) -> dict[int, LossTerms]:
        different = {id(view): view for view in views}
        numbers = {key: device.number_of(view.camera, view.target) for key, view in different.items()}
        device.put(self._buffer.parameters, self._buffer.moments)
        seed = (self._seed << 32) + self.num_iterations
        terms = device.run([numbers[id(view)] for view in views], weights, settings, seed)
        device.take(self._buffer.parameters, self._buffer.moments)
        for _ in views:
            self.num_iterations += 1
            self.heard()
        return {key: terms[number] for key, number in numbers.items()}

    def planes(self, view: View) -> Float32:
        """Planes (5, H, W) of a view, as in `kernels.raster`."""
        centers, radii, colors, opacities = unpack_parameters(self._buffer.parameters, self._num_threads)
        self._raster.prepare(view.camera, centers, radii, opacities, colors)
        return self._raster.forward()

    def rendering(self, view: View) -> Rendering:
        if self.device is None:
            planes = self.planes(view)
        else:
            self.device.put(self._buffer.parameters)
            planes = self.device.planes(self.device.number_of(view.camera, view.target))
        return Rendering(color=np.moveaxis(planes[:3], 0, 2), depth=planes[3], opacity=planes[4])

    def evaluate(self, view: View) -> LossTerms:
        weights = loss_weights(self._config, self.background or BLACK)
        return self._loss.evaluate(self.planes(view), view.target, weights, empty_planes(*view.target.depth.shape))

    def settings(self, rate: float = 1.0, geometry: float = 1.0) -> OptimiserSettings:
        """Settings with rates of centre and radius times `geometry`, other rates and noise times `rate`."""
        c = self._config
        return OptimiserSettings(
            lr_center=c.lr_center * geometry,
            lr_log_radius=c.lr_log_radius * geometry,
            lr_color=c.lr_color * rate,
            lr_logit_opacity=c.lr_logit_opacity * rate,
            regulariser=c.lambda_reg / max(int(self._buffer.is_alive.sum()), 1),
            noise=c.noise * rate,
            min_opacity=c.min_opacity,
            min_radius=c.min_radius,
            max_radius=c.max_radius,
            radius_depth=c.radius_depth,
        )

    def misfits(self, views: Sequence[View]) -> tuple[list[Misfit], Float64]:
        """Colour error of each view where mappable, and each slot's summed blended opacity (M,).

        This sum is the derivative of a summed colour plane by a splat's colour.
        """
        background = np.array(self.background, np.float32)[:, None, None]
        misfits: list[Misfit] = []
        shown = np.zeros(self._config.max_splats)
        for view in views:
            planes = self.planes(view)
            color = planes[:3] + (1.0 - planes[4]) * background
            error = np.abs(color - view.target.color / np.float32(255.0)).mean(axis=0)
            misfits.append((view.frame, np.where(view.mappable, error, np.float32(0.0))))
            ones = np.zeros_like(planes)
            ones[0] = view.target.counted
            self._raster.backward(planes, ones, self._gradients)
            shown += self._gradients[:, 7]
        return misfits, shown
