"""A baked field against held-out depth, and a scene's surface against reference points.

A depth pixel at point p bounds the distance at x by ``|x - p|``, and the ray up to p is free. A field above the
distance to the nearest measured point over-estimates. A lower field errs only if the ball up to that point was seen
free; else it may know another surface.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatctrl_cli.config import fixed
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.evaluate.field_accuracy import (
    GridDistance,
    band_accuracy,
    field_accuracy,
    grid_distances,
    median_radius,
)
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, Better, Scale
from splatctrl_cli.evaluate.views import measured_along
from splatctrl_cli.formats.mesh import TriangleMesh
from splatctrl_cli.geometry import back_project, face_normals, transform_points
from splatctrl_cli.kernels.field import interpolate
from splatctrl_cli.records import Bool, Box, DistanceGrid, Float64, RgbdFrame


def cloud_score(
    points: Float64,
    reference: Float64,
    seen: Bool,
    *,
    max_distance: float = fixed.CLOUD_DISTANCE,
    counts: Bool | None = None,
    unit: float = 1.0,
    threads: int = 1,
) -> dict[str, float]:
    """Distances [m] between points (P, 3) of a surface and a reference (R, 3), world.

    As in DTU's evaluation and jzhangbs/DTUeval-python, eval.py: means of distances below `max_distance`; larger
    distances count only in the `*_beyond` shares. accuracy: surface points, of counts (P,) or all, to the reference.
    completeness: the reference to the surface. chamfer: the mean of accuracy and completeness. completeness_seen: of
    reference points seen (R,) by a training camera. nan without points. unit: metres per unit of the reference's
    file. Raises NotEvaluableError without near points, or if another unit fits better.
    """
    refuse_if(
        not max_distance > 0, f"--cloud-max: expected a distance above 0 m, got {max_distance:g}", error=UsageError
    )
    counted = points if counts is None else points[counts]
    for name, some in (("scene's surface", counted), ("reference cloud", reference)):
        refuse_if(not len(some), f"the {name}: expected points to compare, got none", error=NotEvaluableError)
    _check_unit(points, reference, max_distance, unit)
    to_reference = _nearest(counted, reference, max_distance, threads)
    to_surface = _nearest(reference, points, max_distance, threads)
    refuse_if(
        to_reference.min() >= max_distance,
        f"the reference cloud: expected points within {1e3 * max_distance:g} mm of the scene's surface, got none;"
        f" it spans {_box(reference)} m, the surface {_box(points)} m",
        remedy="is it the same scene, in the same frame? give the cloud's unit as --cloud-unit",
        error=NotEvaluableError,
    )
    of = {"accuracy": to_reference, "completeness": to_surface, "completeness_seen": to_surface[seen]}
    scores = {name: _mean_below(distances, max_distance) for name, distances in of.items()}
    return {
        **{name: mean for name, (mean, _) in scores.items()},
        "chamfer": (scores["accuracy"][0] + scores["completeness"][0]) / 2,
        **{f"{name}_beyond": beyond for name, (_, beyond) in scores.items()},
        "num_points": float(len(counted)),
        "num_reference": float(len(reference)),
    }


def _check_unit(points: Float64, reference: Float64, margin: float, unit: float) -> None:
    some, others = (p[:: max(1, len(p) // 20_000)] for p in (points, reference))
    factors = (1.0, 1e3, 1e-3, 1e2, 1e-2, 10.0, 0.1)  # m, cm, dm and mm, mistaken for each other
    fits = {factor: _overlap(some, factor * others, margin) for factor in factors}
    best = max(fits, key=lambda factor: fits[factor])
    refuse_if(
        fits[1.0] < fixed.CLOUD_NO_OVERLAP and fits[best] > fixed.CLOUD_GOOD_OVERLAP,
        f"the reference cloud: expected the size of the scene's surface, which spans {_box(points)} m, got"
        f" {_box(reference)} m; {best:g} times as large it overlaps by {100 * fits[best]:.0f}%",
        remedy=f"give the cloud's unit as --cloud-unit {unit * best:g}",
        error=NotEvaluableError,
    )


def _overlap(points: Float64, others: Float64, margin: float) -> float:
    """Intersection over union of boxes from percentile 1 to 99, widened by `margin` [m]."""
    (low, high), (low_other, high_other) = (np.percentile(p, (1, 99), axis=0) for p in (points, others))
    sides = np.minimum(high, high_other) - np.maximum(low, low_other) + 2 * margin
    shared = float(np.prod(np.maximum(sides, 0.0)))
    each = [float(np.prod(sides + 2 * margin)) for sides in (high - low, high_other - low_other)]
    return shared / (sum(each) - shared)


CLOUD_SCALES = {  # by the names of `cloud_score`
    **dict.fromkeys(
        ("accuracy", "completeness", "completeness_seen", "chamfer"),
        Scale(unit="m", better=Better.LOWER, absolute=2e-4, relative=0.02),
    ),
    **dict.fromkeys(("accuracy_beyond", "completeness_beyond", "completeness_seen_beyond"), BAD_SHARE),
    **dict.fromkeys(("num_points", "num_reference"), DESCRIBES),
}


def space_out(points: Float64, spacing: float) -> Float64:
    """Points (P, 3), visited in random order, farther than `spacing` [m] from all chosen before.

    As in DTU's thinning (DTUeval-python, eval.py), every layer of a scattered surface counts. First, `thin` leaves a
    point per cube of edge `spacing` / 2, or `spacing` if over 6 million are left.
    """
    _check_spacing(spacing)
    some = thin(points, spacing / 2)
    if len(some) > 6_000_000:
        some = thin(points, spacing)
    some = some[np.random.default_rng(0).permutation(len(some))]
    low, high = (
        cKDTree(some).query_pairs(spacing, output_type="ndarray") if len(some) else np.empty((0, 2), np.int64)
    ).T
    is_open, chosen = np.ones(len(some), np.bool_), np.zeros(len(some), np.bool_)
    while is_open.any():  # points without an earlier open neighbour stay, and their neighbours go, as one by one
        first = is_open.copy()
        first[high] = False
        chosen |= first
        is_open &= ~first
        is_open[high[first[low]]] = False
        waits = is_open[low] & is_open[high]
        low, high = low[waits], high[waits]
    return some[chosen]


def thin(points: Float64, spacing: float) -> Float64:
    """The first of points (P, 3) per cube of edge `spacing` [m].

    Thinning some points beforehand changes nothing.
    """
    _check_spacing(spacing)
    if not len(points):
        return points
    cells = np.floor(points / spacing).astype(np.int64)
    cells -= cells.min(axis=0)
    counts = cells.max(axis=0) + 1
    keys = (cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2]
    return points[np.sort(np.unique(keys, return_index=True)[1])]


def _check_spacing(spacing: float) -> None:
    refuse_if(not spacing > 0, f"--cloud-spacing: expected a distance above 0 m, got {spacing:g}", error=UsageError)


def points_on(mesh: TriangleMesh, spacing: float) -> Float64:
    """Random points (P, 3) [m] on a mesh, four per squared `spacing`, at most 2 million."""
    num = min(math.ceil(4 * 0.5 * np.linalg.norm(face_normals(mesh.corners), axis=1).sum() / spacing**2), 2_000_000)
    return draw_on(mesh, num, np.random.default_rng(0))[0]


def draw_on(mesh: TriangleMesh, num: int, rng: np.random.Generator) -> tuple[Float64, NDArray[np.int64]]:
    """Random points (num, 3) [m] by area, and their triangles (num,)."""
    corners, doubled = mesh.corners, np.linalg.norm(face_normals(mesh.corners), axis=1)
    face = rng.choice(len(corners), num, p=doubled / doubled.sum())
    u, v = rng.random((2, num))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return np.einsum("nk,nka->na", np.stack([1 - u - v, u, v], axis=1), corners[face]), face


def _nearest(points: Float64, others: Float64, limit: float, threads: int) -> Float64:
    """Distance (P,) [m] to the nearest of `others`, inf from `limit` on."""
    return np.asarray(cKDTree(others).query(points, distance_upper_bound=limit, workers=threads)[0])


def _mean_below(distances: NDArray[np.floating], limit: float) -> tuple[float, float]:
    if not len(distances):
        return math.nan, math.nan
    near = distances[distances < limit]
    return float(near.mean()) if len(near) else math.nan, 1.0 - len(near) / len(distances)


def _box(points: Float64) -> str:
    def corner(values: Sequence[float]) -> str:
        return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"

    return f"{corner(points.min(axis=0))} to {corner(points.max(axis=0))}"


REACH = fixed.BANDS[-1][1]  # [m] before the surface, within which points are drawn on a ray


def compare_with_held_out_depth(
    grid: DistanceGrid,
    frames: Sequence[RgbdFrame],
    *,
    seed: int,
    counted: Sequence[Bool] | None = None,
    max_points: int = 20_000,
) -> dict[str, Any]:
    """Errors [m] of interpolated distances on held-out rays sampled by `seed`, as in ``field.json``.

    on_surface: at measured points, whose distance is 0. before: on the rays in front; there, a point is `seen` if the
    ball up to its nearest measured point was seen free, so that under-estimates count, too. over_estimate: over all
    points. num_edges pixels lie at depth edges, num_outside points outside the grid, num_unknown at a corner without
    distance.

    frames: of held-out cameras, in the grid's frame. counted: per frame (H, W), False on objects that the field
    leaves out; None: all count. Raises InputError for masks that do not fit, NotEvaluableError without a measured
    point in the grid.
    """
    distances = grid_distances(grid)
    box = Box(lower=grid.origin, upper=grid.origin + grid.voxel * (np.array(grid.channels["sdf"].shape) - 1))
    measured, eyes, num_edges = _measure(frames, counted, Box(lower=box.lower - REACH, upper=box.upper + REACH))
    refuse_if(
        not box.contains(measured).any(),
        f"held-out depth: no pixel of {len(frames)} frames shows a point in the grid",
        remedy="give frames that look at the box of the grid, with poses in its frame",
        error=NotEvaluableError,
    )
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.choice(len(measured), min(len(measured), max_points), replace=False))
    ray = measured[drawn] - eyes[drawn]
    length = np.linalg.norm(ray, axis=1)
    back = np.minimum(rng.uniform(0.0, REACH, len(drawn)), length)
    points = measured[drawn] - (back / length)[:, None] * ray
    at_surface = _interpolate(grid, distances, measured[drawn][box.contains(measured[drawn])])
    values = _interpolate(grid, distances, points[box.contains(points)])
    points = points[box.contains(points)]
    is_known = np.isfinite(values["sdf"])
    points, values = points[is_known], {name: value[is_known] for name, value in values.items()}
    reference = np.asarray(cKDTree(measured).query(points)[0])
    radius = median_radius(grid)
    accuracy = field_accuracy(values, reference, _ball_is_free(points, reference, frames), median_radius=radius)
    of_all = field_accuracy(values, reference, None, median_radius=radius)
    return {
        "reference": "nearest measured depth point",
        "num_frames": len(frames),
        "num_measured": len(measured),
        "num_edges": num_edges,
        "num_drawn": len(drawn),
        "num_outside": len(drawn) - len(is_known),
        "num_unknown": int(np.count_nonzero(~is_known)),
        "on_surface": {n: asdict(band_accuracy(v[np.isfinite(v)], 0.0, 0.0)) for n, v in at_surface.items()},
        "before": accuracy | {name: of_all[name] for name in ("over_estimate", "holds")},
    }


def counted_pixels(frame: RgbdFrame, workspace: Box | None, spheres: tuple[Float64, Float64] | None) -> Bool:
    """Mask (H, W), False on points outside the scene's box, or near a robot sphere.

    spheres: centres (S, 3) and radii (S,) [m], world.
    """
    is_deep = frame.depth > 0
    points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[is_deep])
    is_wanted = np.ones(len(points), np.bool_) if workspace is None else workspace.contains(points)
    for center, radius in () if spheres is None else zip(*spheres, strict=True):
        is_wanted &= np.square(points - center).sum(axis=1) > (radius + fixed.ROBOT_MARGIN) ** 2
    counted = np.ones(frame.depth.shape, np.bool_)
    counted[is_deep] = is_wanted
    return counted


def _measure(frames: Sequence[RgbdFrame], counted: Sequence[Bool] | None, box: Box) -> tuple[Float64, Float64, int]:
    """Measured points (M, 3) in a box, their camera centres, and number of omitted edge pixels."""
    if counted is not None and [mask.shape for mask in counted] != [frame.depth.shape for frame in frames]:
        raise InputError(
            f"counted: expected a mask of the size of each of {len(frames)} frames, got {len(counted)} masks"
        )
    points, eyes, num_edges = [np.empty((0, 3))], [np.empty((0, 3))], 0
    for index, frame in enumerate(frames):
        is_chosen = frame.depth > 0
        if counted is not None:
            is_chosen &= counted[index]
        is_edge = depth_edges(frame.depth)
        num_edges += int(np.count_nonzero(is_chosen & is_edge))
        points_world = transform_points(
            frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[is_chosen & ~is_edge]
        )
        points.append(points_world[box.contains(points_world)])
        eyes.append(np.broadcast_to(frame.T_world_camera[:3, 3], points[-1].shape))
    return np.concatenate(points), np.concatenate(eyes), num_edges


def depth_edges(depth: NDArray[np.float32]) -> Bool:
    """True (H, W) where a neighbour's depth differs by more than HELD_OUT_EDGE, a share."""
    is_edge = np.zeros(depth.shape, dtype=np.bool_)
    for axis in (0, 1):
        here, there = [slice(None)] * 2, [slice(None)] * 2
        here[axis], there[axis] = slice(None, -1), slice(1, None)
        a, b = depth[tuple(here)], depth[tuple(there)]
        steps = (a > 0) & (b > 0) & (np.abs(a - b) > fixed.HELD_OUT_EDGE * np.minimum(a, b))
        is_edge[tuple(here)] |= steps
        is_edge[tuple(there)] |= steps
    return is_edge


def _interpolate(grid: DistanceGrid, distances: dict[str, GridDistance], points: Float64) -> dict[str, Float64]:
    points = np.ascontiguousarray(points)
    return {
        name: added + interpolate(np.ascontiguousarray(values, dtype=np.float32), grid.origin, grid.voxel, points)[0]
        for name, (values, added) in distances.items()
    }


def _ball_is_free(points: Float64, radius: Float64, frames: Sequence[RgbdFrame]) -> Bool:
    """(Q,) True if all probes in the ball were seen free."""
    index = np.arange(fixed.FREE_DIRECTIONS)
    height, turn = 1 - (2 * index + 1) / fixed.FREE_DIRECTIONS, index * np.pi * (3 - np.sqrt(5))  # Fibonacci's spiral
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    is_free = np.ones(len(points), dtype=np.bool_)
    for share in fixed.FREE_PROBES:
        for direction in directions:
            candidates = np.flatnonzero(is_free)
            is_free[candidates] = _find_seen_free(
                points[candidates] + share * radius[candidates, None] * direction, frames
            )
    return is_free


def _find_seen_free(points_world: Float64, frames: Sequence[RgbdFrame]) -> Bool:
    """(Q,) True before, or just behind, measured depth."""
    is_free = np.zeros(len(points_world), dtype=np.bool_)
    for frame in frames:
        rest = np.flatnonzero(~is_free)
        landing, own, measured = measured_along(points_world[rest], frame)
        is_free[rest[landing]] = (measured > 0) & (own <= measured + fixed.FREE_TOLERANCE)
    return is_free
