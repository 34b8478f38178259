"""The views that the optimiser looks at: the newest frame of each camera, and keyframes of cameras that move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.config.fixed import NEAREST_REACH
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.kernels import points
from splatctrl_cli.kernels.raster import TargetView
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.removal import nearest_depth
from splatctrl_cli.scene.render import camera_array


@dataclass(frozen=True, kw_only=True)
class View:
    """A frame as the optimiser takes it; `nearest` (H, W) [m] is its `nearest_depth`."""

    frame: RgbdFrame
    camera: Float64
    target: TargetView
    nearest: Float32

    @property
    def mappable(self) -> Bool:
        """Pixels (H, W) whose depth the map has to explain."""
        return np.asarray((self.target.counted != 0) & (self.target.depth > 0))


def make_view(frame: RgbdFrame, mappable: Bool, mounted: Bool | None = None, *, reach: float = NEAREST_REACH) -> View:
    """A view of `frame`; `mappable` (H, W) are its pixels with a depth inside the workspace.

    Pixels without depth count in the colour loss; pixels that are not valid, whose depth lies outside the workspace,
    or that show what is `mounted` on the camera, do not count at all.
    """
    counted = mappable | (frame.depth <= 0)
    if frame.valid is not None:
        counted &= frame.valid
    if mounted is not None:
        counted &= ~mounted
    target = TargetView(
        color=np.ascontiguousarray(np.moveaxis(frame.color, 2, 0)),
        depth=np.ascontiguousarray(frame.depth, np.float32),
        counted=counted.astype(np.uint8),
    )
    camera = camera_array(frame.intrinsics, frame.T_world_camera)
    return View(frame=frame, camera=camera, target=target, nearest=nearest_depth(frame, reach))


def seen_through(centers: Float32, views: Sequence[View], tolerance: float, num_threads: int = 1) -> Bool:
    """Splats (N,) that float before what one of the views measured: nearer than every valid depth around their pixel.

    "Around" is what `nearest_depth` says, and "nearer" by more than `tolerance` [m], so that neither a silhouette nor
    the sensor's noise takes a splat off its surface. Finer than the voxels: a voxel that holds both a surface and the
    air before it stays occupied.
    """
    cameras, nearest = [view.camera for view in views], [view.nearest for view in views]
    return points.seen_through(centers, cameras, nearest, tolerance, num_threads)


class Window:
    """Newest views, and up to `config.window` keyframes, oldest dropped first."""

    def __init__(self, config: SceneConfig) -> None:
        self.config = config
        self.newest: list[View] = []
        self.keyframes: list[View] = []

    def advance(self, views: Sequence[View]) -> None:
        """Make `views` the newest; those they replace become keyframes if their camera has moved since the last."""
        fresh = {view.frame.camera for view in views}
        for old in self.newest:
            if old.frame.camera not in fresh:
                continue
            kin = [k for k in [*self.keyframes, *views] if k.frame.camera == old.frame.camera]
            if all(self._has_moved(old.frame, k.frame) for k in kin):
                self.keyframes.append(old)
        self.keyframes = self.keyframes[-self.config.window :] if self.config.window else []
        self.newest = [v for v in self.newest if v.frame.camera not in fresh] + list(views)

    def _has_moved(self, a: RgbdFrame, b: RgbdFrame) -> bool:
        T = invert_transform(a.T_world_camera) @ b.T_world_camera
        cosine = np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
        return bool(
            np.linalg.norm(T[:3, 3]) > self.config.keyframe_distance
            or np.degrees(np.arccos(cosine)) > self.config.keyframe_angle
        )

    def schedule(self, num_iterations: int, rng: np.random.Generator) -> list[View]:
        """The view of each iteration: newest views and keyframes in turn, each round in random order.

        With keyframes, every round shows all newest views and as many keyframes.
        """
        views: list[View] = []
        while len(views) < num_iterations:
            count = min(len(self.keyframes), max(len(self.newest), 1))
            chosen = rng.permutation(len(self.keyframes))[:count]
            round_ = [*self.newest, *(self.keyframes[i] for i in chosen)]
            if not round_:
                return []
            views.extend(round_[i] for i in rng.permutation(len(round_)))
        return views[:num_iterations]
