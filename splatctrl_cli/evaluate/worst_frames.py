"""Moments of least clearance, drawn over the camera image."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import WriteError
from splatctrl_cli.kernels import Int32
from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame, UInt8

NEAR = 0.05  # [m] in front of a camera below which nothing is drawn
HIDDEN = 0.03  # [m] by which a surface must stand before a sphere to hide it
OUTLINE, SHIFT = np.linspace(0.0, 2.0 * np.pi, 49), 4
FONT, FONT_SCALE, LINE_HEIGHT, EDGE = cv2.FONT_HERSHEY_DUPLEX, 0.52, 24, 10
BODY, STILL, WORST, POINT = (253, 214, 150), (190, 190, 190), (0, 94, 213), (66, 228, 240)  # BGR
INK, PAPER = (34, 34, 34), (255, 255, 255)


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Spheres to draw, and the worst one: centers (S, 3), radii (S,) [m], world.

    obstacle (3,): nearest surface point, or NaN. is_moving (S,): moved by a joint.
    """

    stamp_ns: int
    centers: Float64
    radii: Float64
    is_moving: NDArray[np.bool_]
    worst: int
    obstacle: Float64
    caption: tuple[str, ...]


Sight = tuple[Moment, RgbdFrame]
"""A moment, and the image that shows it best."""


def worst_moments(stamp_ns: NDArray[np.int64], clearance: Float64, num: int) -> list[int]:
    """Indices of at most `num` states with least clearance (T,), the least first.

    Each is the least within 0.5 s. NaN does not count.
    """
    values = np.where(np.isnan(clearance), np.inf, clearance)
    padded = np.concatenate([[np.inf], values, [np.inf]])
    lowest = np.flatnonzero((values < padded[:-2]) & (values <= padded[2:]) & np.isfinite(values))
    apart_ns = round(0.5 * 1e9)  # [s] between the moments of two events
    chosen: list[int] = []
    for index in lowest[np.argsort(values[lowest], kind="stable")]:
        if len(chosen) == num:
            break
        stamp = stamp_ns[index]
        first, last = np.searchsorted(stamp_ns, (stamp - apart_ns + 1, stamp + apart_ns))
        is_new = all(abs(int(stamp_ns[other]) - int(stamp)) >= apart_ns for other in chosen)
        if is_new and values[index] <= values[first:last].min():
            chosen.append(int(index))
    return chosen


def sights_of(moments: Sequence[Moment], frames: Iterable[RgbdFrame]) -> list[Sight | None]:
    """Image that best shows each moment's worst sphere, or None.

    frames: by rising stamp, read once.
    """
    sights: list[Sight | None] = [None] * len(moments)
    waiting = sorted(range(len(moments)), key=lambda i: -moments[i].stamp_ns)
    newest: dict[str, RgbdFrame] = {}
    for frame in frames:
        while waiting and moments[waiting[-1]].stamp_ns < frame.stamp_ns:
            index = waiting.pop()
            sights[index] = _best(moments[index], newest)
        if not waiting:
            return sights
        newest[frame.camera] = frame
    for index in waiting:
        sights[index] = _best(moments[index], newest)
    return sights


def draw_sight(path: Path, moment: Moment, frame: RgbdFrame) -> None:
    """Write the image with the arm's silhouette, a line to the obstacle, and the caption."""
    zoom = max(1, -(-960 // frame.intrinsics.width))  # a picture is at least 960 px wide
    image = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
    picture = np.asarray(cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    T_camera_world = np.linalg.inv(frame.T_world_camera)
    centers = moment.centers @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    rings = [_ring(*ball, frame.intrinsics, zoom) for ball in zip(centers, moment.radii, strict=True)]
    for color, is_drawn in ((STILL, ~moment.is_moving), (BODY, moment.is_moving)):
        _fill(picture, [rings[index] for index in np.flatnonzero(is_drawn)], color)
    worst = centers[moment.worst]
    for color, thickness in ((INK, 5), (WORST, 3)):
        cv2.polylines(picture, rings[moment.worst], True, color, thickness, cv2.LINE_AA, SHIFT)
    obstacle = T_camera_world[:3, :3] @ moment.obstacle + T_camera_world[:3, 3]
    if np.isfinite(obstacle).all() and min(obstacle[2], worst[2]) > NEAR:
        _join(
            picture,
            *(_pixel(point, frame.intrinsics, zoom) for point in (_surface(worst, obstacle, moment), obstacle)),
        )
    if not cv2.imwrite(str(path), np.vstack([picture, _add_caption(moment.caption, picture.shape[1])])):
        raise WriteError(f"{path}: could not be written")


def _best(moment: Moment, newest: dict[str, RgbdFrame]) -> Sight | None:
    frames = [newest[camera] for camera in sorted(newest)]
    return (moment, max(frames, key=lambda frame: _view(moment, frame))) if frames else None


def _view(moment: Moment, frame: RgbdFrame) -> tuple[int, int, float]:
    """Rank: sphere and obstacle in view, not occluded, size [px]."""
    R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
    sphere, obstacle = ((point - t) @ R for point in (moment.centers[moment.worst], moment.obstacle))
    radius = float(moment.radii[moment.worst])
    is_in = [_cell(point, frame.intrinsics) is not None for point in (sphere, obstacle)]
    cell = _cell(sphere, frame.intrinsics)
    if cell is None:
        return 0, 0, 0.0
    is_hidden = 0.0 < float(frame.depth[cell]) < sphere[2] - radius - HIDDEN
    return sum(is_in), int(not is_hidden), frame.intrinsics.fx * radius / float(sphere[2])


def _cell(point: Float64, intrinsics: Intrinsics) -> tuple[int, int] | None:
    if not np.isfinite(point).all() or point[2] <= NEAR:
        return None
    column, row = (round(float(v)) for v in _pixel(point, intrinsics, 1))
    return (row, column) if 0 <= row < intrinsics.height and 0 <= column < intrinsics.width else None


def _pixel(point: Float64, intrinsics: Intrinsics, zoom: int) -> Float64:
    """(2,) column and row of a point, enlarged by `zoom`."""
    plane = np.array([intrinsics.fx, intrinsics.fy]) * point[:2] / point[2] + [intrinsics.cx, intrinsics.cy]
    return np.asarray((plane + 0.5) * zoom - 0.5)


def _ring(center: Float64, radius: float, intrinsics: Intrinsics, zoom: int) -> list[Int32]:
    """Outline (49, 2) [px / 2^SHIFT] of a sphere; empty if not wholly before the camera."""
    away = float(np.linalg.norm(center))
    if center[2] - radius <= NEAR:
        return []
    share = 1.0 - (radius / away) ** 2
    first = np.cross(center, [0.0, 1.0, 0.0] if abs(center[1]) < 0.9 * away else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(center, first) / away
    ring = center * share + radius * np.sqrt(share) * (
        np.cos(OUTLINE)[:, None] * first + np.sin(OUTLINE)[:, None] * second
    )
    pixels = np.array([_pixel(point, intrinsics, zoom) for point in ring])
    return [np.round(2**SHIFT * pixels).astype(np.int32)]


def _fill(picture: UInt8, rings: Sequence[list[Int32]], color: tuple[int, int, int]) -> None:
    mask = np.zeros(picture.shape[:2], np.uint8)
    for ring in rings:
        cv2.fillPoly(mask, ring, 255, cv2.LINE_8, SHIFT)
    picture[mask > 0] = np.round(0.55 * picture[mask > 0] + 0.45 * np.array(color)).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for shade, thickness in ((INK, 4), (color, 2)):
        cv2.drawContours(picture, outlines, -1, shade, thickness, cv2.LINE_AA)


def _surface(center: Float64, obstacle: Float64, moment: Moment) -> Float64:
    offset = obstacle - center
    length = max(float(np.linalg.norm(offset)), 1e-9)
    return np.asarray(center + offset * (moment.radii[moment.worst] / length))


def _join(picture: UInt8, start: Float64, end: Float64) -> None:
    a, b = (tuple(int(v) for v in np.round(point)) for point in (start, end))
    for color, thickness in ((INK, 4), (POINT, 2)):
        cv2.line(picture, a, b, color, thickness, cv2.LINE_AA)
    for color, thickness in ((INK, 5), (POINT, 2)):
        cv2.drawMarker(picture, b, color, cv2.MARKER_TILTED_CROSS, 16, thickness, cv2.LINE_AA)


def _add_caption(lines: Sequence[str], width: int) -> UInt8:
    strip = np.full((LINE_HEIGHT * len(lines) + 2 * EDGE, width, 3), PAPER, np.uint8)
    for number, line in enumerate(lines):
        (length, _), _ = cv2.getTextSize(line, FONT, FONT_SCALE, 1)
        scale = FONT_SCALE * min(1.0, (width - 2 * EDGE) / max(length, 1))
        cv2.putText(strip, line, (EDGE, EDGE + LINE_HEIGHT * number + 16), FONT, scale, INK, 1, cv2.LINE_AA)
    return strip
