"""The views that the optimiser looks at: the newest frame of each camera, and keyframes of cameras that move."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.kernels.raster import TargetView
from splatctrl_cli.records import Bool, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.removal import nearest_depth
from splatctrl_cli.scene.render import camera_array


@dataclass(frozen=True, kw_only=True)
class View:
    """A frame as the optimiser takes it, with the pixels (H, W) that the map has to explain."""

    frame: RgbdFrame
    camera: Float64
    target: TargetView
    mappable: Bool

    @cached_property
    def nearest(self) -> Float32:
        """`nearest_depth` of the frame."""
        return nearest_depth(self.frame)


def make_view(frame: RgbdFrame, mappable: Bool) -> View:
    """A view of `frame`; `mappable` (H, W) are its pixels with a depth inside the workspace.

    Pixels without depth count in the colour loss; pixels whose depth lies outside the workspace do not count at all.
    """
    color = np.ascontiguousarray(np.moveaxis(frame.color, 2, 0).astype(np.float32) / np.float32(255.0))
    target = TargetView(
        color=color,
        depth=np.where(mappable, frame.depth, np.float32(0.0)).astype(np.float32),
        counted=(mappable | (frame.depth <= 0)).astype(np.uint8),
    )
    camera = camera_array(frame.intrinsics, frame.T_world_camera)
    return View(frame=frame, camera=camera, target=target, mappable=mappable)


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
