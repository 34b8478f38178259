"""Views of the optimiser: newest frames, and keyframes of moving cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import SceneConfig, fixed
from splatctrl_cli.geometry import compare_poses
from splatctrl_cli.kernels import points
from splatctrl_cli.kernels.raster import TargetView
from splatctrl_cli.records import Bool, Float32, Float64, Label, RgbdFrame
from splatctrl_cli.scene.removal import nearest_depth
from splatctrl_cli.scene.render import camera_array
from splatctrl_cli.scene.self_mask import least_within, pixels_at

_STEPS = np.array([step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)], np.float32) - 1
DIRECTIONS = _STEPS / np.linalg.norm(_STEPS, axis=1, keepdims=True)  # (26, 3), to points of a sphere's edge


@dataclass(frozen=True, kw_only=True)
class View:
    """A frame for the optimiser.

    nearest, nearest_object: its `nearest_depth` (H, W) [m], with and without the robot.
    """

    frame: RgbdFrame
    camera: Float64
    target: TargetView
    nearest: Float32
    nearest_object: Float32

    @property
    def mappable(self) -> Bool:
        """Pixels (H, W) with depth to explain."""
        return np.asarray((self.target.counted != 0) & (self.target.depth > 0))


def make_view(
    frame: RgbdFrame,
    mappable: Bool,
    mounted: Bool | None = None,
    *,
    is_robot: Bool | None = None,
    reach: float = fixed.NEAREST_REACH,
) -> View:
    """View of `frame`; `mappable` (H, W): pixels with depth in the workspace.

    The colour loss counts pixels without depth, but none that are invalid, `mounted`, or outside the workspace.
    """
    counted = mappable | (frame.depth <= 0)
    counted &= frame.is_in_view
    if mounted is not None:
        counted &= ~mounted
    target = TargetView(
        color=np.ascontiguousarray(np.moveaxis(frame.color, 2, 0)),
        depth=np.ascontiguousarray(frame.depth, np.float32),
        counted=counted.astype(np.uint8),
    )
    nearest, nearest_object = nearest_depth(frame, reach, is_robot)
    return View(
        frame=frame,
        camera=camera_array(frame.intrinsics, frame.T_world_camera),
        target=target,
        nearest=nearest,
        nearest_object=nearest_object,
    )


def seen_through(
    centers: Float32, views: Sequence[View], tolerance: float, num_threads: int = 1, label: int = Label.OBJECT
) -> Bool:
    """True (N,) for splats that float: some view measures only farther depth around their pixel.

    "Farther" is by over `tolerance` [m]. The depth is `View.nearest` for the label ROBOT, else `View.nearest_object`.
    """
    cameras = [view.camera for view in views]
    nearest = [view.nearest if label == Label.ROBOT else view.nearest_object for view in views]
    return points.seen_through(centers, cameras, nearest, tolerance, num_threads)


def move_to_surface(centers: Float32, views: Sequence[View], most: float) -> Float32:
    """Move centres (N, 3) [m], world, that float by up to `most` [m], onto the measured surface.

    A centre floats if all views that see it measure more depth at and around its pixel. It moves along the ray of the
    view with the smallest step to that depth. Views that measure depth over `most` before the centre do not count.
    """
    least, towards = np.full(len(centers), np.inf, np.float32), np.zeros_like(centers)
    for view in views:
        pixel, z = pixels_at(view.frame, centers)
        depth = least_within(np.where(view.frame.depth > 0, view.frame.depth, np.float32(np.inf)), 1).ravel()[pixel]
        step = np.where((pixel >= 0) & (depth >= z - most), depth - z, np.inf).astype(np.float32)
        is_less = step < least
        least[is_less] = step[is_less]
        ray = centers[is_less] - view.frame.T_world_camera[:3, 3]
        towards[is_less] = ray / z[is_less, None]
    is_off = (least > 0) & (least <= most)
    return np.asarray(centers + np.where(is_off, least, np.float32(0.0))[:, None] * towards, np.float32)


def shrink_radii(
    centers: Float32, radii: Float32, views: Sequence[View], tolerance: float, least: float, num_threads: int = 1
) -> Float32:
    """Radii (N,) [m], shrunk to `least` [m] or more, of spheres behind measured depth.

    A sphere shrinks while a view sees through its edge, or its point nearest to the camera, by over `tolerance` [m].
    """
    cameras = [view.camera for view in views]
    depths = [np.where(view.frame.depth > 0, view.frame.depth, np.float32(np.inf)) for view in views]
    nearest = [least_within(depth, 1) for depth in depths]
    places = np.array([view.frame.T_world_camera[:3, 3] for view in views], np.float32).reshape(-1, 3)
    towards = places - centers[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    shrunk = np.array(radii, np.float32)
    left = np.arange(len(shrunk))
    while len(left):
        edge = centers[left, None] + shrunk[left, None, None] * DIRECTIONS
        edge = np.ascontiguousarray(edge.reshape(-1, 3))
        floats = points.seen_through(edge, cameras, nearest, tolerance, num_threads).reshape(len(left), -1)
        is_out = floats.any(axis=1)
        for number, camera in enumerate(cameras):  # by the depth of the point's own pixel
            before = np.ascontiguousarray(centers[left] + shrunk[left, None] * towards[left, number])
            is_out |= points.seen_through(before, [camera], [depths[number]], tolerance, num_threads)
        left = left[is_out & (shrunk[left] > least)]
        shrunk[left] = np.maximum(fixed.SHRINK * shrunk[left], np.float32(least))
    return shrunk


class Window:
    """Newest views and up to `config.window` keyframes; the oldest keyframes drop first."""

    def __init__(self, config: SceneConfig) -> None:
        self.config = config
        self.newest: list[View] = []
        self.keyframes: list[View] = []

    def advance(self, views: Sequence[View]) -> None:
        """Make `views` the newest; replaced views of moved cameras become keyframes."""
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
        metres, degrees = compare_poses(a.T_world_camera, b.T_world_camera)
        return metres > self.config.keyframe_distance or degrees > self.config.keyframe_angle

    def schedule(self, num_iterations: int, rng: np.random.Generator) -> list[View]:
        """Views by iteration: shuffled rounds of newest views and at most equally many keyframes."""
        views: list[View] = []
        while len(views) < num_iterations:
            count = min(len(self.keyframes), max(len(self.newest), 1))
            chosen = rng.permutation(len(self.keyframes))[:count]
            round_ = [*self.newest, *(self.keyframes[i] for i in chosen)]
            if not round_:
                return []
            views.extend(round_[i] for i in rng.permutation(len(round_)))
        return views[:num_iterations]
