"""Offset between a robot's clock and its cameras', by the motion both record.

Image changes between frames are compared with changes that a moving robot of spheres predicts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.checks import limits
from splatctrl_cli.checks.check_images import thumbnail_lens
from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Float32, Float64, Index, Intrinsics, JointState, RgbdFrame, Stamps, UInt8

_NEAR = 0.05  # [m] in front of the camera


@dataclass(kw_only=True)
class CameraMotion:
    """A camera's stamps (K + 1) [ns], and changes (K, h, w) in [0, 1]."""

    intrinsics: Intrinsics
    T_world_camera: Float64
    is_fixed: bool = True
    stamps_ns: list[int] = field(default_factory=list)
    changes: list[Float32] = field(default_factory=list)


@dataclass(kw_only=True)
class ImageMotion:
    cameras: dict[str, CameraMotion] = field(default_factory=dict)
    _last: dict[str, tuple[Float32, UInt8]] = field(default_factory=dict)

    def add(self, frame: RgbdFrame) -> None:
        camera = self.cameras.get(frame.camera)
        if camera is None:
            camera = CameraMotion(intrinsics=thumbnail_lens(frame.intrinsics), T_world_camera=frame.T_world_camera)
            self.cameras[frame.camera] = camera
        if len(camera.stamps_ns) == limits.MOTION_FRAMES:
            return
        size = (camera.intrinsics.width, camera.intrinsics.height)
        gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        now = (
            np.asarray(cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32),
            np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.uint8),
        )
        camera.is_fixed &= bool(np.abs(frame.T_world_camera - camera.T_world_camera).max() < limits.MOTION_FIXED)
        camera.stamps_ns.append(frame.stamp_ns)
        if frame.camera in self._last:
            camera.changes.append(_change(*self._last[frame.camera], *now))
        self._last[frame.camera] = now


def _change(depth_a: Float32, gray_a: UInt8, depth_b: Float32, gray_b: UInt8) -> Float32:
    both = (depth_a > 0) & (depth_b > 0)
    of_depth = np.minimum(np.abs(depth_b - depth_a) / limits.MOTION_DEPTH_STEP, 1.0)
    of_gray = np.minimum(np.abs(gray_b.astype(np.float32) - gray_a) / limits.MOTION_COLOR_STEP, 1.0)
    return np.asarray(np.where(both, of_depth, of_gray), dtype=np.float32)


def silhouettes(centers_world: Float64, radii: Float64, camera: CameraMotion) -> Float32:
    """Depth (T, h, w) [m] of spheres (T, S, 3); 0 where none is.

    A sphere of radius (S,) is projected in parallel at its distance, exact on the optical axis.
    """
    intrinsics = camera.intrinsics
    centers = transform_points(invert_transform(camera.T_world_camera), centers_world)
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width].reshape(2, -1).astype(np.float32)
    depth = np.zeros((len(centers), u.size), dtype=np.float32)
    for row, spheres in zip(depth, centers, strict=True):
        is_ahead = spheres[:, 2] - radii > _NEAR
        x, y, z = spheres[is_ahead].astype(np.float32).T
        dx = (u[None] - intrinsics.cx) * (z / intrinsics.fx)[:, None] - x[:, None]
        dy = (v[None] - intrinsics.cy) * (z / intrinsics.fy)[:, None] - y[:, None]
        above = np.square(radii[is_ahead].astype(np.float32))[:, None] - dx * dx - dy * dy
        nearest = np.where(above > 0, z[:, None] - np.sqrt(np.maximum(above, 0)), np.float32(np.inf)).min(
            axis=0, initial=np.inf
        )
        row[:] = np.where(np.isfinite(nearest), nearest, 0)
    return depth.reshape(len(centers), intrinsics.height, intrinsics.width)


def predicted_change(depth_a: Float32, depth_b: Float32) -> Float32:
    """Change (K, h, w) of silhouettes; 1 where only one image shows the robot."""
    a, b = depth_a > 0, depth_b > 0
    of_depth = np.minimum(np.abs(depth_b - depth_a) / np.float32(limits.MOTION_DEPTH_STEP), np.float32(1.0))
    return np.where(a & b, of_depth, (a ^ b).astype(np.float32)).astype(np.float32)


def correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Pearson correlation by sums, the same at any thread count; 0 for constant input."""
    x, y = np.asarray(a, dtype=np.float64).ravel(), np.asarray(b, dtype=np.float64).ravel()
    x, y = x - x.mean(), y - y.mean()
    length = float(np.sqrt(np.sum(x * x)) * np.sqrt(np.sum(y * y)))
    return float(np.sum(x * y)) / length if length > 0 else 0.0


RobotPoints = tuple[Float64, Float64]
"""A robot's spheres by joint state: centers (T, S, 3) and radii (S,) [m], world."""


@dataclass(frozen=True, kw_only=True)
class ClockOffset:
    """The offset of two clocks, and its certainty.

    offset_s [s]: a frame's stamp minus the joint state's at that instant; None if unknown, for `reason`.
    uncertainty_s: the larger of camera disagreement and the method's error. correlation: at the best peak.
    """

    offset_s: float | None
    uncertainty_s: float | None
    correlation: float
    num_intervals: int
    reason: str = ""

    @property
    def sentence(self) -> str:
        if self.offset_s is None or self.uncertainty_s is None:
            return f"clocks of cameras and robot: cannot tell their offset: {self.reason}"
        return (
            f"clocks of cameras and robot: frames are stamped {1e3 * self.offset_s:+.0f} ms against the joint states "
            f"(+-{1e3 * self.uncertainty_s:.0f} ms, correlation {self.correlation:.2f})"
        )


def estimate_clock_offset(
    states: Sequence[JointState], motion: ImageMotion, robot: RobotPoints | None = None
) -> ClockOffset:
    """The offset at which robot and image motion correlate best.

    states: by stamp. With `robot` and stationary cameras, pixel changes are compared with the spheres' silhouette.
    Otherwise, coarser, whole images are compared with joint motion. The offset is the parabolic peak of the mean over
    cameras. It is unknown without motion, at low correlation, with a rival peak, or at the search's end.
    """
    cameras = [motion.cameras[name] for name in sorted(motion.cameras) if motion.cameras[name].changes]
    num = sum(len(camera.changes) for camera in cameras)
    if len(states) < 3 or num < limits.MOTION_INTERVALS:
        return _unknown(num, f"expected at least {limits.MOTION_INTERVALS} times between frames and 3 states")
    first, last = _span(cameras)
    near = [index for index, state in enumerate(states) if first <= state.stamp_ns <= last]
    states = [states[index] for index in near]
    robot = None if robot is None else (robot[0][near], robot[1])
    if len(states) < 3:
        return _unknown(num, f"no joint states within {limits.OFFSET_REACH:g} s of the frames")
    position = np.array([state.position for state in states])
    if np.ptp(position, axis=0).max() < limits.MOTION_LEAST:
        return _unknown(num, "no joint moves")
    start = states[0].stamp_ns
    seconds = np.array([state.stamp_ns - start for state in states]) * 1e-9
    offsets, step = _offsets(float(seconds[-1]), cameras)
    if not len(offsets):
        return _unknown(num, "the log is too short")
    interval = step * limits.OFFSET_STEPS
    fixed = sorted((c for c in cameras if c.is_fixed), key=lambda c: -float(np.sum(c.changes)))
    if robot is not None and fixed:
        scores = [
            _pixel_scores(seconds, robot, step, camera, start, offsets) for camera in fixed[: limits.MOTION_CAMERAS]
        ]
        return _peak(offsets, np.array(scores), num, limits.PIXEL_CORRELATION, limits.PIXEL_ERROR * interval)
    scores = [_sum_scores(seconds, position, camera, start, offsets) for camera in cameras]
    return _peak(offsets, np.array(scores), num, limits.OFFSET_CORRELATION, limits.OFFSET_SUM_ERROR * interval)


def select_states(stamp_ns: Stamps, motion: ImageMotion) -> Index:
    """Indices (K,) of states that suffice for `estimate_clock_offset`. stamp_ns (T,): ascending."""
    cameras = [camera for camera in motion.cameras.values() if camera.changes]
    if not cameras:
        return np.zeros(0, dtype=np.int64)
    first_ns, last_ns = _span(cameras)
    first = int(np.searchsorted(stamp_ns, first_ns))
    near = stamp_ns[first : int(np.searchsorted(stamp_ns, last_ns, side="right"))]
    if len(near) < 3:
        return np.arange(first, first + len(near))
    seconds = np.asarray((near - near[0]) * 1e-9, dtype=np.float64)
    offsets, step = _offsets(float(seconds[-1]), cameras)
    is_asked = np.zeros(len(near), dtype=np.bool_)
    is_asked[np.linspace(0, len(near) - 1, limits.MOTION_STATES).astype(np.int64)] = True  # whether a joint moves
    for camera in cameras:
        at = _since(camera, int(near[0]))
        for offset in offsets:
            for times in (at - offset, step * np.round((at - offset) / step)):
                after = np.clip(np.searchsorted(seconds, times), 1, len(seconds) - 1)
                is_asked[after] = is_asked[after - 1] = True
    return first + np.flatnonzero(is_asked)


def _span(cameras: Sequence[CameraMotion]) -> tuple[int, int]:
    reach = round(limits.OFFSET_REACH * 1e9)
    return min(c.stamps_ns[0] for c in cameras) - reach, max(c.stamps_ns[-1] for c in cameras) + reach


def _offsets(span_s: float, cameras: Sequence[CameraMotion]) -> tuple[Float64, float]:
    """Offsets [s] to try over `span_s`, and their step [s]; none if it is too short."""
    step = min(float(np.median(np.diff(camera.stamps_ns))) * 1e-9 for camera in cameras) / limits.OFFSET_STEPS
    count = int(min(limits.OFFSET_REACH, limits.OFFSET_SHARE * span_s) / step) if step > 0 else 0
    if count < 2 * limits.OFFSET_STEPS:
        return np.zeros(0), step
    return np.asarray(step * np.arange(-count, count + 1), dtype=np.float64), step


def _since(camera: CameraMotion, start: int) -> Float64:
    return np.array([stamp - start for stamp in camera.stamps_ns]) * 1e-9


def _pixel_scores(
    seconds: Float64, robot: RobotPoints, step: float, camera: CameraMotion, start: int, offsets: Float64
) -> Float64:
    number = np.round((_since(camera, start) - offsets[:, None]) / step).astype(np.int64)  # (O, K + 1)
    is_inside = (number >= 0) & (number * step < seconds[-1] + step / 2)
    pixels = np.unique(number[is_inside])
    depth = silhouettes(
        _at(seconds, robot[0].reshape(len(seconds), -1), pixels * step).reshape(len(pixels), -1, 3), robot[1], camera
    )
    changes = np.array(camera.changes)
    scores = np.zeros(len(offsets))
    for i, inside in enumerate(is_inside):
        keep = _trim(inside)
        if keep.any():
            of = np.searchsorted(pixels, number[i])
            a, b = depth[of[:-1][keep]], depth[of[1:][keep]]
            scores[i] = correlation(predicted_change(a, b), changes[keep])
    return scores


def _sum_scores(seconds: Float64, position: Float64, camera: CameraMotion, start: int, offsets: Float64) -> Float64:
    at = _since(camera, start)
    change = np.array([image.mean() for image in camera.changes])
    scores = np.zeros(len(offsets))
    for i, offset in enumerate(offsets):
        keep = _trim((at - offset >= 0) & (at - offset <= seconds[-1]))
        if keep.any():
            moved = np.abs(np.diff(_at(seconds, position, at - offset), axis=0)).mean(axis=1)
            scores[i] = correlation(moved[keep], change[keep])
    return scores


def _trim(is_inside: "np.ndarray[tuple[int], np.dtype[np.bool_]]") -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    keep = is_inside[1:] & is_inside[:-1]
    return keep if keep.sum() >= max(limits.MOTION_INTERVALS // 2, len(keep) // 2) else np.zeros_like(keep)


def _at(seconds: Float64, curve: Float64, at: Float64) -> Float64:
    after = np.clip(np.searchsorted(seconds, at), 1, len(seconds) - 1)
    before = after - 1
    share = np.clip((at - seconds[before]) / (seconds[after] - seconds[before]), 0.0, 1.0)[:, None]
    return np.asarray((1 - share) * curve[before] + share * curve[after])


def _peak(offsets: Float64, scores: Float64, num: int, least: float, error: float) -> ClockOffset:
    score = scores.mean(axis=0)
    best = int(np.argmax(score))
    inner = score[1:-1]
    peaks = np.flatnonzero((inner >= score[:-2]) & (inner > score[2:])) + 1
    others = score[peaks[np.abs(peaks - best) > limits.OFFSET_STEPS]]
    top, runner_up = float(score[best]), float(others.max(initial=0.0))
    reason = ""
    if top < least:
        reason = f"images and joints do not move alike (correlation {top:.2f})"
    elif best in {0, len(score) - 1}:
        reason = f"it exceeds the {offsets[-1]:.2f} s that are searched"
    elif top - runner_up < limits.OFFSET_LEAD:
        reason = f"the motion repeats: offsets of {offsets[best]:+.2f} s and another fit alike"
    if reason:
        return _unknown(num, reason, top)
    single = np.array([_vertex(offsets, row, int(np.argmax(row))) for row in scores])
    return ClockOffset(
        offset_s=_vertex(offsets, score, best),
        uncertainty_s=max(float(single.std() / np.sqrt(len(single))), error),
        correlation=top,
        num_intervals=num,
    )


def _vertex(offsets: Float64, score: Float64, best: int) -> float:
    reach = min(max(limits.OFFSET_STEPS // 2, 2), best, len(score) - 1 - best)
    if reach == 0:
        return float(offsets[best])
    near = slice(best - reach, best + reach + 1)
    width = float(offsets[best + reach] - offsets[best])
    a, b, _ = np.polyfit((offsets[near] - offsets[best]) / width, score[near], 2)
    return float(offsets[best]) + (float(np.clip(-b / (2 * a), -1.0, 1.0)) if a < 0 else 0.0) * width


def _unknown(num: int, reason: str, top: float = 0.0) -> ClockOffset:
    return ClockOffset(offset_s=None, uncertainty_s=None, correlation=top, num_intervals=num, reason=reason)
