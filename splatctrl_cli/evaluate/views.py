"""The views of a recording that are scored, what the training cameras had seen by then, and which points a camera
saw.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.geometry import back_project, invert_transform, project, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, Index, RecordSource, RgbdFrame


@dataclass(frozen=True, kw_only=True)
class View:
    """A frame to score, its name, and the training frames that count as known at its time.

    The name is the camera and a number: with a clock among the camera's frames, without one among all views, or the
    stamp where stamps are the views' own numbers.
    """

    name: str
    frame: RgbdFrame
    training: tuple[RgbdFrame, ...]


def views_to_score(
    source: RecordSource,
    *,
    scoring: Collection[str],
    training: Collection[str],
    has_clock: bool,
    numbered_by_stamp: bool = False,
    corrected: Callable[[RgbdFrame], RgbdFrame] = lambda frame: frame,
) -> Iterator[View]:
    """The frames of the `scoring` cameras in time order.

    With a clock, what counts is the newest frame of each training camera not later than the view (a frame of the same
    stamp counts); without one, every training frame of the recording, which is then read twice. corrected: a frame at
    the pose, exposure and depth that the scene was trained with.
    """
    if not has_clock:
        known = tuple(corrected(frame) for frame in frames_of(source) if frame.camera in training)
        for number, frame in enumerate(frames_of(source)):
            if frame.camera in scoring:
                name = _name(frame.camera, frame.stamp_ns if numbered_by_stamp else number)
                yield View(name=name, frame=frame, training=known)
        return
    counts: Counter[str] = Counter()
    newest: dict[str, RgbdFrame] = {}
    for recorded in _moments(source):
        moment = [corrected(frame) for frame in recorded]
        newest |= {frame.camera: frame for frame in moment if frame.camera in training}
        for frame in moment:
            if frame.camera in scoring:
                name = _name(frame.camera, counts[frame.camera])
                yield View(name=name, frame=frame, training=tuple(newest.values()))
                counts[frame.camera] += 1


def _name(camera: str, number: int) -> str:
    """``cam3-0000``: fit for a file name."""
    return f"{camera.strip('/').replace('/', '_')}-{number:04d}"


def frames_of(source: RecordSource) -> Iterator[RgbdFrame]:
    """The frames among a source's records."""
    return (record for record in source.records() if isinstance(record, RgbdFrame))


def _moments(source: RecordSource) -> Iterator[list[RgbdFrame]]:
    """Frames of the same stamp, together."""
    moment: list[RgbdFrame] = []
    for frame in frames_of(source):
        if moment and frame.stamp_ns != moment[0].stamp_ns:
            yield moment
            moment = []
        moment.append(frame)
    if moment:
        yield moment


def seen_by(points_world: NDArray[np.floating], frames: Iterable[RgbdFrame], tolerance: float = 0.02) -> Bool:
    """(Q,) True where a point (Q, 3) [m] is on a surface that one of the frames measured.

    The point falls on a pixel of the frame (the nearest), and that pixel has a depth within `tolerance` [m] of the
    point's own depth: neither hidden behind something else, nor in the free space before it.
    """
    seen = np.zeros(len(points_world), dtype=np.bool_)
    for frame in frames:
        unseen = np.flatnonzero(~seen)
        if not len(unseen):
            break
        seen[unseen] = _agrees(points_world[unseen], frame, tolerance)
    return seen


def surface_points(frame: RgbdFrame) -> tuple[Float64, Bool]:
    """The world points (Q, 3) [m] of a frame's pixels that have a depth, and where those pixels are (H, W)."""
    valid = frame.depth > 0
    return transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[valid]), valid


def seen_pixels(frame: RgbdFrame, others: Sequence[RgbdFrame], tolerance: float = 0.02) -> Bool:
    """(H, W) True where the frame's own depth lies on a surface that one of the `others` measured.

    The nearest cameras are asked first: they saw most of it, and what was seen is not asked again.
    """
    points_world, seen = surface_points(frame)
    center = frame.T_world_camera[:3, 3]
    nearest = sorted(others, key=lambda other: float(np.linalg.norm(other.T_world_camera[:3, 3] - center)))
    seen[seen] = seen_by(points_world, nearest, tolerance)
    return seen


def _agrees(points_world: NDArray[np.floating], frame: RgbdFrame, tolerance: float) -> Bool:
    agrees = np.zeros(len(points_world), dtype=np.bool_)
    landing, own, measured = measured_along(points_world, frame)
    agrees[landing] = (measured > 0) & (np.abs(measured - own) <= tolerance)
    return agrees


def measured_along(points_world: NDArray[np.floating], frame: RgbdFrame) -> tuple[Index, Float64, Float32]:
    """The points (K,) of Q that land on the frame's image, their own depth (K,) [m], and what was measured there."""
    points_camera = transform_points(invert_transform(frame.T_world_camera), points_world)
    landing = np.flatnonzero(points_camera[:, 2] > 1e-6)
    pixels = np.floor(project(frame.intrinsics, points_camera[landing]) + 0.5)
    height, width = frame.depth.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    u, v = pixels[inside].astype(np.int64).T
    landing = landing[inside]
    return landing, points_camera[landing, 2], frame.depth[v, u]
