"""Consistency of views of one scene, and the depth scales and camera moves it needs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np

from splatctrl_cli.calibration.evidence import transform_of
from splatctrl_cli.calibration.views import DepthView, landed, overlap_rows, surface_normals
from splatctrl_cli.checks import limits
from splatctrl_cli.checks.finding import ERROR, WARNING, Finding, error, judge, warning
from splatctrl_cli.config.fixed import PLAUSIBLE_DEPTH
from splatctrl_cli.geometry import back_project, invert_transform, strided_lens, transform_points
from splatctrl_cli.records import Bool, Float64, RgbdFrame, spread

SCALES = (0.001, 0.01, 0.1, 0.2, 0.25, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 1.0)
SCALES = (*SCALES, *(1 / s for s in reversed(SCALES[:-1])))
_Posed = TypeVar("_Posed", RgbdFrame, DepthView)
FINE = np.linspace(0.92, 1.08, 17)


@dataclass(frozen=True, kw_only=True)
class Move:
    """Correction T_camera_corrected, its length [m], angle [deg], and mean cut residual [m] before and after."""

    camera: str
    T_camera_corrected: Float64
    distance: float
    angle: float
    before: float
    after: float


def check_views(
    frames: Sequence[RgbdFrame],
    used: Mapping[str, float | None],
    *,
    is_sure: bool = True,
    only_errors: bool = False,
) -> tuple[list[Finding], list[RgbdFrame], list[RgbdFrame]]:
    """Compare views from different places, of one moment or a static scene.

    Returns findings, frames at fitting scales, and those at fitting poses. used: metres per count of depth by camera,
    None for floats. is_sure: False if the unit is doubtful; views must then overlap. only_errors: seek wrong poses
    only if scales are wrong.
    """
    views = [_view(frame) for frame in _chosen(frames)]
    pairs = _pairs(views)
    if not pairs:
        return [], list(frames), list(frames)
    scales = wrong_scales(views, pairs)
    moves = wrong_poses(views, pairs) if scales or not only_errors else []
    scaled = [replace(f, depth=f.depth * np.float32(scales.get(f.camera, 1.0))) for f in frames]
    if scales:
        fitted = [_view(frame) for frame in _chosen(scaled)]
        moved = _moved(views, {move.camera: move.T_camera_corrected for move in moves})
        if _cost(fitted, pairs)[1] > _cost(moved, pairs)[1]:
            moves = wrong_poses(fitted, pairs)
        else:  # moves explain more
            scales, scaled = {}, list(frames)
    findings = _scale_findings(scales, used) if scales else _overlap_findings(views, pairs, used, is_sure=is_sure)
    findings += [_pose_finding(move, sorted(used)) for move in moves]
    return findings, scaled, _moved(scaled, {move.camera: move.T_camera_corrected for move in moves})


def are_far(frames: Sequence[RgbdFrame]) -> bool:
    """True if distances between cameras, relative to depth, suggest another unit."""
    medians = [float(np.median(seen)) for frame in frames if (seen := frame.depth[frame.depth > 0]).size]
    places = np.array([frame.T_world_camera[:3, 3] for frame in frames])
    return bool(medians) and float(np.linalg.norm(np.ptp(places, axis=0))) > limits.VIEWS_FAR * float(
        np.median(medians)
    )


def wrong_scales(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]]) -> dict[str, float]:
    """Depth factors by camera that make views agree; one common factor, if that suffices."""
    cameras = sorted({view.camera for view in views})
    together = _best_scale(views, pairs, cameras)
    if together is not None:
        return dict.fromkeys(cameras, together)
    scales = {}
    plain = {camera: _cost(views, _with(views, pairs, camera))[1] for camera in cameras}
    for camera in cameras if len(cameras) > 1 else []:
        if plain[camera] > max(limits.MOVE_GOOD_SHARE, 0.7 * max(plain.values())):
            continue
        scale = _best_scale(views, _with(views, pairs, camera), [camera])
        if scale is not None:
            scales[camera] = scale
    return scales if 2 * len(scales) <= len(cameras) else {}  # else the factors only chase each other


def wrong_poses(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]]) -> list[Move]:
    """Small moves after which a camera fits the others much better, largest gain first."""
    cameras = sorted({view.camera for view in views})
    moves: list[Move] = []
    for _ in range(max(1, len(cameras) // 2)):
        left = [camera for camera in cameras if camera not in {move.camera for move in moves}]
        fitted = [(camera, T) for camera in left if (T := _fitted(views, pairs, camera)) is not None]
        if not fitted:
            break
        before = _cost(views, pairs)
        costs = [_cost(_moved(views, {camera: T}), pairs) for camera, T in fitted]
        best = int(np.argmin([cost for cost, _ in costs]))
        camera, T = fitted[best]
        its = _with(views, pairs, camera)
        own_before, own_after = _cost(views, its)[0], _cost(_moved(views, {camera: T}), its)
        move = Move(
            camera=camera,
            T_camera_corrected=T,
            distance=float(np.linalg.norm(T[:3, 3])),
            angle=float(np.degrees(np.linalg.norm(cv2.Rodrigues(T[:3, :3])[0]))),
            before=own_before,
            after=own_after[0],
        )
        is_large = move.distance > limits.MOVE_METRES or move.angle > limits.MOVE_DEGREES
        is_dear = move.after > (1 - limits.MOVE_CHEAPER) * move.before
        if not is_large or is_dear or own_after[1] < limits.MOVE_GOOD_SHARE or costs[best][0] >= before[0]:
            break
        moves.append(move)
        views = _moved(views, {camera: T})
    return moves


def _overlap_findings(
    views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], used: Mapping[str, float | None], *, is_sure: bool
) -> list[Finding]:
    """Findings of unusual depths whose views would agree at a tenth or ten times."""
    low, high = limits.TABLE_DEPTH[0], limits.VIEWS_UNUSUAL * limits.TABLE_DEPTH[1]
    depths = np.concatenate([view.points[:, 2] for view in views])
    if not len(depths) or (is_sure and low <= float(np.median(depths)) <= high):
        return []
    median, cameras = float(np.median(depths)), [view.camera for view in views]
    tried = (0.1 if median > high else 10.0,) if is_sure else SCALES
    plain = _fitting(views, pairs, cameras, 1.0)[1]
    (fits, most), scale = max((_fitting(views, pairs, cameras, s), s) for s in tried)
    if most < limits.VIEWS_LANDED or plain > limits.VIEWS_TRUSTED * most or fits < limits.VIEWS_LEAST_FIT * most:
        return []
    text = f"views hardly see each other's surfaces at a median depth of {median:.3g} m, but do at {scale:g} times it"
    remedy = f"if so, {rescale_remedy(used.values(), scale)}"
    return judge(WARNING if is_sure else ERROR, "views-scale", "cameras", text, remedy, value=scale)


def rescale_remedy(units: Iterable[float | None], factor: float) -> str:
    """Remedy: the --depth-scale for depths `factor` times as large.

    units: [m] per count, None for floats in metres.
    """
    read = sorted({unit or 1.0 for unit in units})
    if len(read) != 1:
        return f"record depth {factor:.3g} times as large: cameras differ in their unit, and --depth-scale is of all"
    return f"give --depth-scale {read[0] * factor:.3g} (it is {read[0]:g} m per count)"


def _scale_findings(scales: Mapping[str, float], used: Mapping[str, float | None]) -> list[Finding]:
    shared = set(scales.values())
    is_all = len(scales) == len(used) and len(shared) == 1
    units = {used[camera] or 1.0 for camera in scales}
    if is_all and len(units) == 1:
        factor = shared.pop()
        return [
            error(
                "views-scale",
                "cameras",
                f"views of one scene fit together only where all depths are multiplied by {factor:.3g}",
                f"{rescale_remedy(units, factor)}, or correct the poses' unit",
                value=factor,
            )
        ]
    return [
        error(
            "views-scale",
            f"camera {camera}",
            f"its views fit those of the other cameras only where its depths are multiplied by {factor:.3g}",
            "set the depth unit of its driver as that of the others, or leave it out with --cameras",
            value=factor,
        )
        for camera, factor in sorted(scales.items())
    ]


def _pose_finding(move: Move, cameras: Sequence[str]) -> Finding:
    by = f"{1e3 * move.distance:.0f} mm and {move.angle:.1f} deg"
    where, what = f"camera {move.camera}", f"its views fit those of the other cameras where it is moved by {by}"
    remedy = "calibrate this camera's pose again (splatctrl calibrate), or leave it out with --cameras"
    if len(cameras) == 1:
        what = f"its views fit together where the camera is moved on its mount by {by}"
        remedy = "calibrate the camera on its mount again (splatctrl calibrate)"
    elif len(cameras) == 2:
        where, what = f"cameras {' and '.join(cameras)}", f"their views fit where {move.camera} is moved by {by}"
        remedy = "calibrate both cameras' poses again (splatctrl calibrate): two do not tell which of them is wrong"
    falls = f"points then lie {1e3 * move.after:.1f} mm off surfaces instead of {1e3 * move.before:.1f}"
    return warning(
        "views-pose",
        where,
        f"{what}: {falls} (mean, each counted as {1e3 * limits.MOVE_CUT:.0f} mm at most)",
        remedy,
        value=round(1e3 * move.distance, 1),
        unit="mm",
    )


def _chosen(frames: Sequence[RgbdFrame]) -> list[RgbdFrame]:
    cameras = sorted({frame.camera for frame in frames})
    each = max(2, min(8, limits.VIEWS // max(len(cameras), 1)))
    of_cameras = [[frame for frame in frames if frame.camera == camera] for camera in cameras]
    return [frame for of_camera in of_cameras for frame in spread(of_camera, each)]


def _pairs(views: Sequence[DepthView]) -> list[tuple[int, int]]:
    places = [view.T_world_camera[:3, 3] for view in views]
    pairs = [
        (i, j)
        for i in range(len(views))
        for j in range(len(views))
        if i != j and float(np.linalg.norm(places[i] - places[j])) > limits.VIEWS_BASELINE
    ]
    return spread(pairs, limits.VIEWS_PAIRS)


def _with(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], camera: str) -> list[tuple[int, int]]:
    return [(i, j) for i, j in pairs if camera in (views[i].camera, views[j].camera)]


def _view(frame: RgbdFrame) -> DepthView:
    stride = max(1, frame.depth.shape[0] // limits.VIEWS_ROWS)
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth), 3)[::stride, ::stride]
    lens = strided_lens(frame.intrinsics, stride)
    surface = back_project(lens, depth)
    normals = surface_normals(surface)
    known = np.flatnonzero(np.any(normals != 0, axis=-1))
    if len(known) > limits.VIEWS_POINTS:
        known = known[np.linspace(0, len(known) - 1, limits.VIEWS_POINTS).astype(int)]
    return DepthView(
        camera=frame.camera,
        stamp_ns=frame.stamp_ns,
        lens=lens,
        T_world_camera=frame.T_world_camera,
        surface=surface,
        normals=normals,
        points=surface.reshape(-1, 3)[known],
        point_normals=normals.reshape(-1, 3)[known],
    )


def _landed(
    a: DepthView, b: DepthView, scale_a: float = 1.0, scale_b: float = 1.0
) -> tuple[Float64, Bool, Float64, Float64]:
    """View a's points (K, 3) in b's frame, hits (K,), b's surface and normals."""
    points = transform_points(invert_transform(b.T_world_camera) @ a.T_world_camera, a.points * scale_a)
    lands, surface, normals = landed(points, b)
    return points, lands, surface * scale_b, normals


def _distances(a: DepthView, b: DepthView, scale_a: float = 1.0, scale_b: float = 1.0) -> tuple[Float64, Float64]:
    """Distances (K,) [m] of view a's points from view b's planes, and depths (K,) [m]."""
    points, lands, surface, normals = _landed(a, b, scale_a, scale_b)
    lands &= np.any(normals != 0, axis=1)
    return np.abs(np.einsum("ki,ki->k", points - surface, normals))[lands], points[lands, 2]


def _best_scale(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], cameras: Sequence[str]) -> float | None:
    medians = [float(np.median(v.points[:, 2])) for v in views if v.camera in cameras and len(v.points)]
    if not medians:
        return None
    low, high = PLAUSIBLE_DEPTH
    tried = [s for s in SCALES if s == 1.0 or low <= s * float(np.median(medians)) <= high]
    counts = np.array([_fitting(views, pairs, cameras, s) for s in tried], dtype=np.float64)
    most = counts[:, 1].max()
    if most < limits.VIEWS_LANDED:
        return None
    plain = tried.index(1.0)
    shares = counts[:, 0] / np.maximum(counts[:, 1], limits.VIEWS_FEW_LANDED * most)
    fit = counts[:, 0] / np.maximum(counts[:, 1], 1.0)
    best = int(np.argmax(shares))
    if counts[plain, 1] > limits.VIEWS_TRUSTED * most and fit[plain] > limits.VIEWS_SAME_FIT * fit[best]:
        return None
    more = shares[plain] + limits.VIEWS_MORE_FIT, limits.VIEWS_TIMES_FIT * shares[plain]
    if shares[best] < max(*more, limits.VIEWS_LEAST_FIT):
        return None
    neighbours = [_fitting(views, pairs, cameras, tried[best] * factor) for factor in limits.VIEWS_BESIDE]
    least = min(num_fit / max(num, 1) for num_fit, num in neighbours if num > limits.VIEWS_LANDED // 10)
    if least > limits.VIEWS_SAME_FIT * fit[best]:
        return None  # a flat wall fits at any scale
    near = [tried[best] * factor for factor in FINE]
    scale = float(near[int(np.argmax([_fitting(views, pairs, cameras, s, 1 / 4)[0] for s in near]))])
    return scale if abs(np.log(scale)) > limits.VIEWS_OTHER_SCALE else None


def _fitting(
    views: Sequence[DepthView],
    pairs: Sequence[tuple[int, int]],
    cameras: Sequence[str],
    scale: float,
    share: float = 1.0,
) -> tuple[int, int]:
    """Numbers of points within `share` of `VIEWS_FIT` at a scale, and of all that land."""
    num_fit = num = 0
    for i, j in pairs:
        a, b = views[i], views[j]
        off, depth = _distances(a, b, *[scale if view.camera in cameras else 1.0 for view in (a, b)])
        num_fit += int((off < limits.VIEWS_FIT * share * depth).sum())
        num += len(off)
    return num_fit, num


def _fitted(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], camera: str) -> Float64 | None:
    is_far = _cost(views, _with(views, pairs, camera))[1] < limits.MOVE_GOOD_SHARE
    starts = [limits.MOVE_WIDTHS, (*limits.MOVE_WIDE, *limits.MOVE_WIDTHS)] if is_far else [limits.MOVE_WIDTHS]
    poses = [T for widths in starts if (T := _descend(views, pairs, camera, widths)) is not None]
    return min(poses, key=lambda T: _cost(_moved(views, {camera: T}), pairs)[0], default=None)


def _descend(
    views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], camera: str, widths: Sequence[float]
) -> Float64 | None:
    """T_camera_corrected by Gauss-Newton on point-to-plane residuals, with Tukey's biweight."""
    its = _with(views, pairs, camera)
    T = np.eye(4)
    for width in widths:
        moved = _moved(views, {camera: T})
        H, g, total = np.zeros((6, 6)), np.zeros(6), 0.0
        for i, j in its:
            rows, residual = _rows(moved[i], moved[j], camera)
            weight = np.where(np.abs(residual) < width, np.square(1 - np.square(residual / width)), 0.0)
            H += (rows * weight[:, None]).T @ rows
            g += (rows * weight[:, None]).T @ residual
            total += float(weight.sum())
        if total < limits.VIEWS_LANDED / 20:
            return None
        values, vectors = np.linalg.eigh(H / total)
        inverse = np.where(values > limits.MOVE_FLAT, 1 / np.maximum(values, limits.MOVE_FLAT), 0.0)
        T = T @ transform_of(-vectors @ (inverse * (vectors.T @ (g / total))))
    return T


def _rows(a: DepthView, b: DepthView, camera: str) -> tuple[Float64, Float64]:
    """Derivatives (K, 6) by the camera's motion in its frame, and residuals (K,) [m]."""
    points, lands, surface, normals = _landed(a, b)
    lands &= np.any(normals != 0, axis=1) & (np.abs(points[:, 2] - surface[:, 2]) < 3 * limits.MOVE_WIDE[0])
    residual, derivatives = overlap_rows(
        a.points, invert_transform(b.T_world_camera) @ a.T_world_camera, lands, surface, normals
    )
    of_a, of_b = np.hsplit(derivatives, 2)
    return (a.camera == camera) * of_a + (b.camera == camera) * of_b, residual


def _cost(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Mean distance [m], cut at `limits.MOVE_CUT`, and share of points that fit."""
    total = num = num_good = 0.0
    for i, j in pairs:
        off, depth = _distances(views[i], views[j])
        total += float(np.minimum(off, limits.MOVE_CUT).sum())
        num_good += float((off < limits.VIEWS_FIT * depth).sum())
        num += len(off)
    return (total / num, num_good / num) if num >= limits.VIEWS_LANDED else (limits.MOVE_CUT, 0.0)


def _moved(frames: Sequence[_Posed], moves: Mapping[str, Float64]) -> list[_Posed]:
    return [replace(f, T_world_camera=f.T_world_camera @ moves.get(f.camera, np.eye(4))) for f in frames]
