"""A baked field beside the depth of cameras that did not train.

What a depth pixel says is sound in one direction: its point p is on a surface, so the true distance at any x is at
most ``|x - p|``, and the ray up to p is free. A field that reads more than the distance to the nearest measured point
over-estimates, whatever else there is. A field that reads less may know a surface that no held-out pixel shows; it
can be called an error only where the ball around x, up to the nearest measured point, was itself seen to be free.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatctrl_cli.config import fixed
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import (
    BandAccuracy,
    FieldAccuracy,
    GridDistance,
    band_accuracy,
    field_accuracy,
    grid_distances,
    median_radius,
)
from splatctrl_cli.geometry import back_project, invert_transform, project, transform_points
from splatctrl_cli.kernels.field import interpolate
from splatctrl_cli.records import Bool, Box, DistanceGrid, Float64, RgbdFrame

REFERENCE = "nearest measured depth point"
REACH = fixed.BANDS[-1][1]  # [m] before the surface that points are put on a ray


@dataclass(frozen=True, kw_only=True)
class HeldOutComparison:
    """Errors [m] against held-out depth, and how many points went into them.

    on_surface: the fields at measured points, where the distance is 0 by what the camera says. before: at points on
    the rays before them; `seen` are those whose ball, up to the nearest measured point, was seen to be free, where
    under-estimates count as well; over all points only over-estimates are sound, and those beyond the allowance are
    counted over all. num_edges pixels were left out as they may lie between two surfaces, num_outside drawn points
    because they lie outside the grid, num_unknown because a corner of their cell has no distance.
    """

    on_surface: dict[str, BandAccuracy]
    before: FieldAccuracy
    reference: str
    num_frames: int
    num_measured: int
    num_edges: int
    num_drawn: int
    num_outside: int
    num_unknown: int

    def as_dict(self) -> dict[str, Any]:
        counts = {name: value for name, value in vars(self).items() if name not in {"on_surface", "before"}}
        on_surface = {name: asdict(band) for name, band in self.on_surface.items()}
        return {**counts, "on_surface": on_surface, "before": self.before.as_dict()}


def compare_with_held_out_depth(
    grid: DistanceGrid,
    frames: Sequence[RgbdFrame],
    *,
    seed: int,
    counted: Sequence[Bool] | None = None,
    max_points: int = 20_000,
) -> HeldOutComparison:
    """Errors of the grid's distances, interpolated, on `max_points` held-out rays drawn with the seed.

    frames: of cameras that did not train, at the stamp of the bake, in the grid's frame. counted: per frame (H, W),
    False where a pixel shows what the field leaves out (the robot), None where there is nothing of the kind. Raises
    InputError for masks that do not fit, NotEvaluableError where no measured point lies in the grid.
    """
    distances = grid_distances(grid)
    upper = grid.origin + grid.voxel * (np.array(grid.channels["sdf"].shape) - 1)
    box = Box(lower=grid.origin, upper=upper)
    measured, eyes, num_edges = _measured(frames, counted, Box(lower=box.lower - REACH, upper=box.upper + REACH))
    if not box.contains(measured).any():
        raise NotEvaluableError(
            f"held-out depth: no pixel of {len(frames)} frames shows a point in the grid",
            remedy="give frames that look at the box of the grid, with poses in its frame",
        )
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.choice(len(measured), min(len(measured), max_points), replace=False))
    ray = measured[drawn] - eyes[drawn]
    length = np.linalg.norm(ray, axis=1)
    back = np.minimum(rng.uniform(0.0, REACH, len(drawn)), length)
    points = measured[drawn] - (back / length)[:, None] * ray
    at_surface = _interpolated(grid, distances, measured[drawn][box.contains(measured[drawn])])
    values = _interpolated(grid, distances, points[box.contains(points)])
    points = points[box.contains(points)]
    is_known = np.isfinite(values["sdf"])
    points, values = points[is_known], {name: value[is_known] for name, value in values.items()}
    reference = np.asarray(cKDTree(measured).query(points)[0])
    radius = median_radius(grid)
    return HeldOutComparison(
        on_surface={name: band_accuracy(value[np.isfinite(value)], 0.0, 0.0) for name, value in at_surface.items()},
        before=replace(
            field_accuracy(values, reference, _ball_is_free(points, reference, frames), median_radius=radius),
            over_estimate=field_accuracy(values, reference, None, median_radius=radius).over_estimate,
        ),
        reference=REFERENCE,
        num_frames=len(frames),
        num_measured=len(measured),
        num_edges=num_edges,
        num_drawn=len(drawn),
        num_outside=len(drawn) - len(is_known),
        num_unknown=int(np.count_nonzero(~is_known)),
    )


def counted_pixels(frame: RgbdFrame, workspace: Box | None, spheres: tuple[Float64, Float64] | None) -> Bool:
    """(H, W) False where a pixel's point lies outside the scene's box, or in one of the robot's spheres or near it.

    spheres: their centres (S, 3) and radii (S,) [m], world.
    """
    is_deep = frame.depth > 0
    points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[is_deep])
    is_wanted = np.ones(len(points), np.bool_) if workspace is None else workspace.contains(points)
    for center, radius in () if spheres is None else zip(*spheres, strict=True):
        is_wanted &= np.square(points - center).sum(axis=1) > (radius + fixed.ROBOT_MARGIN) ** 2
    counted = np.ones(frame.depth.shape, np.bool_)
    counted[is_deep] = is_wanted
    return counted


def _measured(frames: Sequence[RgbdFrame], counted: Sequence[Bool] | None, box: Box) -> tuple[Float64, Float64, int]:
    """The surface points (M, 3) in a box that the frames measured, the eye (M, 3) of each, and the edges left out."""
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
        here = back_project(frame.intrinsics, frame.depth)[is_chosen & ~is_edge]
        points_world = transform_points(frame.T_world_camera, here)
        points.append(points_world[box.contains(points_world)])
        eyes.append(np.broadcast_to(frame.T_world_camera[:3, 3], points[-1].shape))
    return np.concatenate(points), np.concatenate(eyes), num_edges


def depth_edges(depth: NDArray[np.float32]) -> Bool:
    """(H, W) True where a measured neighbour's depth differs by more than a share of the pixel's own."""
    is_edge = np.zeros(depth.shape, dtype=np.bool_)
    for axis in (0, 1):
        here, there = [slice(None)] * 2, [slice(None)] * 2
        here[axis], there[axis] = slice(None, -1), slice(1, None)
        a, b = depth[tuple(here)], depth[tuple(there)]
        steps = (a > 0) & (b > 0) & (np.abs(a - b) > fixed.HELD_OUT_EDGE * np.minimum(a, b))
        is_edge[tuple(here)] |= steps
        is_edge[tuple(there)] |= steps
    return is_edge


def _interpolated(grid: DistanceGrid, distances: dict[str, GridDistance], points: Float64) -> dict[str, Float64]:
    points = np.ascontiguousarray(points)
    found = {}
    for name, distance in distances.items():
        values = np.ascontiguousarray(distance.values, dtype=np.float32)
        found[name] = interpolate(values, grid.origin, grid.voxel, points)[0] + distance.added
    return found


def _ball_is_free(points: Float64, radius: Float64, frames: Sequence[RgbdFrame]) -> Bool:
    """(Q,) True where every probe in the ball about a point was seen to be free."""
    index = np.arange(fixed.FREE_DIRECTIONS)
    height, turn = 1 - (2 * index + 1) / fixed.FREE_DIRECTIONS, index * np.pi * (3 - np.sqrt(5))  # Fibonacci's spiral
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    is_free = np.ones(len(points), dtype=np.bool_)
    for share in fixed.FREE_PROBES:
        for direction in directions:
            asked = np.flatnonzero(is_free)
            is_free[asked] = _seen_free(points[asked] + share * radius[asked, None] * direction, frames)
    return is_free


def _seen_free(points_world: Float64, frames: Sequence[RgbdFrame]) -> Bool:
    """(Q,) True where a point lies before, or just behind, what some frame measured along its ray."""
    is_free = np.zeros(len(points_world), dtype=np.bool_)
    for frame in frames:
        asked = np.flatnonzero(~is_free)
        points_camera = transform_points(invert_transform(frame.T_world_camera), points_world[asked])
        is_before = points_camera[:, 2] > 0
        asked, points_camera = asked[is_before], points_camera[is_before]
        pixels = np.floor(project(frame.intrinsics, points_camera) + 0.5)
        height, width = frame.depth.shape
        inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        u, v = pixels[inside].astype(np.int64).T
        depth = frame.depth[v, u]
        is_free[asked[inside]] = (depth > 0) & (points_camera[inside, 2] <= depth + fixed.FREE_TOLERANCE)
    return is_free
